"""A picture of each of many scans that links to its page, and an index of them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torchrg.errors import FormatError
from torchrg.io.files import atomic_path, check_place
from torchrg.render.colors import color_planes
from torchrg.render.page import check_library, make_page, template_of, write_page
from torchrg.render.pictures import render_cloud, write_png
from torchrg.result import Result

INDEX = "index.html"
"""Name of the index in its folder."""
_IMAGE_BYTES, _BYTES_PER_POINT = 200_000_000, 200
"""Memory that the pixels of a picture take, and each of its points; a page takes no more."""


class Entry(NamedTuple):
    """A scan of an index.

    Attributes:
        name: Name of the scan.
        picture: A file below the folder of the index, with forward slashes.
        page: Its page, another such file.
        words: What else there is to say.
    """

    name: str
    picture: str
    page: str
    words: str = ""


def draw_planes(path: str | os.PathLike[str], result: Result) -> None:
    """Write a picture of the superpoints of a result or, without any, of its planes."""
    fields, points = result.fields, result.cloud.points
    normals = fields.get("normals")
    picture = render_cloud(
        points,
        color_planes(fields.get("superpoint", result.labels), points),
        normals=None if normals is None else normals.to(points.dtype),
        labels=fields.get("labels"),
    )
    write_png(path, picture)


def memory_of_picture(num_points: int) -> int:
    """Return the bytes that a picture or a page of a result takes.

    Example:
        >>> memory_of_picture(1_000_000)
        400000000
    """
    return _IMAGE_BYTES + _BYTES_PER_POINT * num_points


def check_gallery(folder: Path, names: Sequence[str]) -> None:
    """Raise before long work if pages of scans, or their index, have no place or cannot be made.

    Raises:
        FormatError: If a file cannot be written, or a scan has the name of the index.
        MissingDependencyError: If pages cannot be made.
    """
    check_library()
    check_place(folder / INDEX)
    for name in names:
        page = folder / f"{name}.html"
        if page.parent == folder and page.name.lower() == INDEX:
            raise FormatError(
                f"{page}: the page of {name} would take the place of the index; rename the scan."
            )
        if page.parent.is_dir():
            check_place(page)


def draw_entry(folder: Path, name: str, result: Result, *, words: str = "") -> Entry:
    """Write picture and page of a result under its name, and return its entry of the index.

    Raises:
        FormatError: If a file cannot be written.
        MissingDependencyError: If pages cannot be made.
    """
    entry = Entry(name, f"{name}.png", f"{name}.html", words)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    draw_planes(folder / entry.picture, result)
    write_page(folder / entry.page, make_page(result, title=name))
    return entry


def write_index(folder: Path, title: str, entries: Sequence[Entry]) -> Path:
    """Write the index of the entries of a folder, and return where it is.

    Raises:
        FormatError: If it cannot be written.
        MissingDependencyError: If pages cannot be made.
    """
    text = template_of("gallery.html.jinja").render(title=title, entries=entries)
    with atomic_path(folder / INDEX) as beside:
        beside.write_text(text, encoding="utf-8", errors="backslashreplace")
    return folder / INDEX
