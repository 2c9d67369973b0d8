"""Images and viewers of many scans, with an index."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from torchrg.errors import FormatError
from torchrg.io.files import atomic_path, check_writable
from torchrg.io.plane_table import guess_unit
from torchrg.io.result import PAGE_SUFFIXES, Result
from torchrg.render.colors import color_planes
from torchrg.render.legend import Legend
from torchrg.render.page import load_template, make_page, read_library, write_page
from torchrg.render.pictures import render_cloud, write_png
from torchrg.render.surface import sample_rows
from torchrg.structures import PLANE_KINDS, Planes

INDEX = "index.html"
"""File name of the index."""

_MAX_ENTRIES = 13
"""Maximum number of planes in a legend: three rows of five, with the scale and unlabeled points."""


class Entry(NamedTuple):
    """Entry of an index.

    Attributes:
        name: Name of the scan.
        picture: Path of the image relative to the index, with forward slashes.
        page: Path of the viewer, in the same form.
        words: Caption.
    """

    name: str
    picture: str
    page: str
    words: str = ""


def write_planes(path: str | os.PathLike[str], result: Result) -> None:
    """Write the image of :func:`draw_planes` with the default camera."""
    write_png(path, draw_planes(result))


def draw_planes(result: Result, *, by: str | None = None, **settings: Any) -> Tensor:  # noqa: ANN401
    """Draw the superpoints of a result, or its planes without superpoints, with a legend.

    Args:
        result: The result.
        by: Field to color by, ``"labels"`` or ``"superpoint"``. Default: superpoints if known.
        settings: Camera and size, as keyword arguments of :func:`torchrg.render.render_cloud`.

    Returns:
        The image, shape ``(H, W, 3)``, uint8.
    """
    rows, fields = sample_rows(result.cloud.points), result.fields
    points, normals, labels = result.cloud.points[rows], fields.get("normals"), fields.get("labels")
    by = by or ("superpoint" if "superpoint" in fields else "labels")
    parts = (result.labels if by == "labels" else fields[by])[rows]
    colors = color_planes(parts, points)
    planes, title = result.table, Path(result.cloud.source).name
    entries, unit = list[tuple[Tensor, str]](), "units"
    if by == "labels" and planes is not None:
        unit, title = guess_unit(planes) or unit, f"{title}: {len(planes):,} planes"
        entries = _describe_colors(planes, parts, colors)
    return render_cloud(
        points,
        colors,
        normals=None if normals is None else normals[rows].to(points.dtype),
        labels=None if labels is None else labels[rows],
        legend=Legend(title, entries, unit),
        **settings,
    )


def _describe_colors(planes: Planes, labels: Tensor, colors: Tensor) -> list[tuple[Tensor, str]]:
    """Return color, class, ID and area of the largest planes, and the color of unlabeled points."""
    kinds = [None] * len(planes) if planes.kind is None else planes.kind.tolist()
    largest = planes.area.argsort(descending=True, stable=True)[:_MAX_ENTRIES].tolist()
    words, unit = {-1: "unlabeled"}, " m²" if guess_unit(planes) else ""
    for row in largest:
        kind = "plane" if kinds[row] is None else PLANE_KINDS[kinds[row]]
        words[row] = f"{kind} {row}: {float(planes.area[row]):,.2f}{unit}"
    shown = {row: (labels == row).nonzero() for row in (*largest, -1)}
    return [(colors[points[0, 0]], words[row]) for row, points in shown.items() if len(points)]


def check_gallery(folder: Path, names: Sequence[str]) -> None:
    """Raise if viewers or their index cannot be written; call before long computations.

    Raises:
        FormatError: If a file cannot be written, or a scan has the name of the index.
        MissingDependencyError: If viewers cannot be created.
    """
    read_library()
    check_writable(folder / INDEX)
    for name in names:
        page = folder / f"{name}.html"
        if page.parent == folder and page.name.lower() == INDEX:
            raise FormatError(f"{page}: the viewer of {name} would overwrite the index; rename it.")
        if page.parent.is_dir():
            check_writable(page)


def write_entry(folder: Path, name: str, result: Result) -> None:
    """Write the image and viewer of a result; raises like :func:`check_gallery`."""
    picture, page = (folder / f"{name}{suffix}" for suffix in PAGE_SUFFIXES)
    picture.parent.mkdir(parents=True, exist_ok=True)
    write_planes(picture, result)
    write_page(page, make_page(result, title=name))


def write_index(folder: Path, title: str, entries: Sequence[Entry]) -> Path:
    """Write the index of the entries of a folder, and return its path."""
    text = load_template("gallery.html.jinja").render(title=title, entries=entries)
    with atomic_path(folder / INDEX) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
    return folder / INDEX
