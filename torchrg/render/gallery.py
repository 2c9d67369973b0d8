"""Images and viewers of many scans, with an index."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torchrg.errors import FormatError
from torchrg.io.files import atomic_path, check_writable
from torchrg.io.result import PAGE_SUFFIXES, Result
from torchrg.render.colors import color_planes
from torchrg.render.page import load_template, make_page, read_library, write_page
from torchrg.render.pictures import render_cloud, write_png

INDEX = "index.html"
"""File name of the index."""


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
    """Write an image of the superpoints of a result, or of its planes without superpoints."""
    fields, points = result.fields, result.cloud.points
    normals = fields.get("normals")
    picture = render_cloud(
        points,
        color_planes(fields.get("superpoint", result.labels), points),
        normals=None if normals is None else normals.to(points.dtype),
        labels=fields.get("labels"),
    )
    write_png(path, picture)


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
