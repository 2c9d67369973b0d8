"""Display of segmentations in notebooks."""

import base64
import tempfile
from pathlib import Path
from typing import Any

from torchrg._optional import require
from torchrg.errors import ConfigError
from torchrg.io.plane_table import describe_planes, tabulate_planes
from torchrg.io.result import Result
from torchrg.render.gallery import write_planes
from torchrg.render.page import Page, make_page
from torchrg.structures import PLANE_KINDS, Cloud, Planes, Segmentation

MAX_ROWS = 12
"""Maximum number of planes in the table, the largest ones."""


def show(segmentation: Segmentation, **settings: Any) -> Page:  # noqa: ANN401
    """Return the viewer of a segmentation; ``settings`` are passed to :func:`make_page`."""
    return make_page(_result_of(segmentation), **settings)


def _result_of(segmentation: Segmentation) -> Result:
    """Return the result of a segmentation; raise if it has no points."""
    if segmentation.points is None:
        raise ConfigError(
            "Segmentation: expected points, got None; use dataclasses.replace(seg, points=points)."
        )
    points = segmentation.points.numpy(force=True).reshape(-1, 3)
    return Result.from_segmentation(Cloud(points, source="segmentation"), segmentation)


def as_frame(planes: Planes) -> Any:  # noqa: ANN401
    """Convert a plane table to a ``pandas.DataFrame``."""
    pandas = require("pandas", extra="report", purpose="create data frames")
    return pandas.DataFrame(tabulate_planes(describe_planes(planes)))


def as_html(segmentation: Segmentation) -> str:
    """Return an image, if the points are known, and a table of the largest planes, as HTML."""
    picture = ""
    if segmentation.points is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "planes.png"
            write_planes(path, _result_of(segmentation))
            content = base64.b64encode(path.read_bytes()).decode("ascii")
        picture = f'<img src="data:image/png;base64,{content}" style="max-width: 640px" alt="">'
    planes, labels = describe_planes(segmentation.planes)["planes"], segmentation.labels
    percent = 100 * float((labels >= 0).double().mean()) if labels.numel() else 0.0
    counts = f"{labels.numel():,} points, {len(planes):,} planes"
    rows = [
        (
            f"{plane['id']}",
            plane.get("kind", PLANE_KINDS[0]),
            f"{plane['count']:,}",
            f"{plane['area']:.4g}",
            f"{plane['rms']:.3g}",
            " ".join(f"{value:.3f}" for value in plane["normal"]),
            f"{plane['offset']:.5g}",
        )
        for plane in planes[:MAX_ROWS]
    ]
    names = ("plane", "kind", "points", "area", "rms", "normal", "offset")
    cells = "".join(f"<th>{name}</th>" for name in names)
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    more = f"<p>and {len(planes) - MAX_ROWS:,} more</p>" if len(planes) > MAX_ROWS else ""
    table = f"<table><tr>{cells}</tr>{lines}</table>{more}" if rows else ""
    return f"<div><p>{counts}, {percent:.1f} % of the points labeled</p>{picture}{table}</div>"
