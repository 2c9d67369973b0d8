"""How a segmentation shows itself in a notebook: a picture, and a table of its planes."""

import base64
import tempfile
from pathlib import Path
from typing import Any

import torch

from torchrg.errors import ConfigError
from torchrg.render.gallery import draw_planes, with_results
from torchrg.render.page import Page, make_page
from torchrg.structures import PLANE_KINDS, Cloud, Segmentation

MOST_ROWS = 12
"""Planes in the table, the largest ones."""


def as_cloud(segmentation: Segmentation) -> Cloud:
    """Return the points of a segmentation with what was found about them as fields.

    Raises:
        ConfigError: If it does not know its points.
    """
    if segmentation.points is None:
        raise ConfigError(
            "Segmentation: expected its points to show them, got none; "
            "use seg._replace(points=points)."
        )
    points = segmentation.points.detach().reshape(-1, 3).numpy(force=True)
    flat = segmentation._replace(
        labels=segmentation.labels.reshape(-1),
        normals=segmentation.normals.reshape(-1, 3),
        curvature=segmentation.curvature.reshape(-1),
        sharp=segmentation.sharp.reshape(-1),
    )
    return with_results(Cloud(points, source="segmentation"), flat)


def show(segmentation: Segmentation, **settings: Any) -> Page:  # noqa: ANN401
    """Return the page of a segmentation; ``settings`` are those of :func:`make_page`."""
    return make_page(as_cloud(segmentation), **settings)


def as_html(segmentation: Segmentation) -> str:
    """Return a picture, where the points are known, and a table of the largest planes."""
    picture = ""
    if segmentation.points is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "planes.png"
            draw_planes(path, as_cloud(segmentation))
            content = base64.b64encode(path.read_bytes()).decode("ascii")
        picture = f'<img src="data:image/png;base64,{content}" style="max-width: 640px" alt="">'
    planes = segmentation.planes
    num_planes, labels = len(planes.count), segmentation.labels
    share = 100 * float((labels >= 0).double().mean()) if labels.numel() else 0.0
    head = f"{labels.numel():,} points, {num_planes:,} planes, {share:.1f} % of the points labelled"
    kinds = torch.zeros_like(planes.count) if planes.kind is None else planes.kind
    rows = [
        [
            f"{number}",
            PLANE_KINDS[int(kinds[number])],
            f"{int(planes.count[number]):,}",
            f"{float(planes.area[number]):.4g}",
            f"{float(planes.rms[number]):.3g}",
            " ".join(f"{value:.3f}" for value in planes.normal[number].tolist()),
            f"{float(planes.offset[number]):.5g}",
        ]
        for number in range(min(num_planes, MOST_ROWS))
    ]
    names = ("plane", "kind", "points", "area", "rms", "normal", "offset")
    cells = "".join(f"<th>{name}</th>" for name in names)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    more = f"<p>and {num_planes - MOST_ROWS:,} more</p>" if num_planes > MOST_ROWS else ""
    table = f"<table><tr>{cells}</tr>{lines}</table>{more}" if rows else ""
    return f"<div><p>{head}</p>{picture}{table}</div>"
