"""Places of results and pictures: each its own, and checked before the work begins."""

from collections.abc import Sequence
from pathlib import Path

from torchrg.datasets.folder import folded_name
from torchrg.errors import FormatError
from torchrg.io import FORMATS, check_output
from torchrg.io.files import check_place, make_folder
from torchrg.render.page import check_library

DRAWINGS = (".png", ".html")
"""Suffixes of pictures and pages."""


def output_paths(inputs: Sequence[Path], out: Path, *, suffix: str = ".npz") -> list[Path]:
    """Return where the result of each input goes.

    One input goes to the file ``out``, a cloud or of the given suffix, or under its own name into
    an existing directory; several need a directory, which is made. With an empty suffix each result
    is a directory.

    Raises:
        FormatError: If there is no input, two results would share a name, or one cannot be
            written.
    """
    if not inputs:
        raise FormatError("expected at least one input file, got none.")
    ending = out.suffix.lower()
    if suffix and len(inputs) == 1 and not out.is_dir():
        check_place(out) if ending == suffix else check_output(out)
        return [out]
    if ending and ending in (suffix, *FORMATS) and not out.is_dir():
        raise FormatError(f"{out}: expected a directory for {len(inputs)} inputs, got a file name.")
    results = [out / f"{path.stem}{suffix}" for path in inputs]
    first: dict[str, Path] = {}
    for result, source in zip(results, inputs, strict=True):
        other = first.setdefault(folded_name(result.name), source)
        if other is not source:
            raise FormatError(
                f"{source}: another input has the same name, {other}, and {out / result.name} is "
                "one place; give them different directories."
            )
    make_folder(out)
    for result in results if suffix else []:
        check_place(result)
    return results


def check_apart(results: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise FormatError if a result would take the place of an input or of another result."""
    taken = {str(path.resolve()) for path in inputs}
    files = {_file_number(path) for path in inputs} - {None}
    for path in results:
        place = str(path.resolve())
        if not taken.isdisjoint((place, folded_name(place))) or _file_number(path) in files:
            raise FormatError(
                f"{path}: expected a place of its own for each result, got one of an input or of "
                "another result; choose another."
            )
        taken.add(folded_name(place))


def _file_number(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from others, whatever the case of its name; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def picture_paths(
    results: Sequence[Path], picture: Path | None, *, suffixes: Sequence[str] = DRAWINGS
) -> Sequence[Path | None]:
    """Return where the picture of each result goes, by the rules of :func:`output_paths`."""
    if picture is None:
        return [None] * len(results)
    if not picture.is_dir():
        if len(results) == 1 and picture.suffix:
            check_drawing(picture, suffixes=suffixes)
            return [picture]
        if picture.suffix.lower() in suffixes:
            raise FormatError(
                f"{picture}: expected a directory for {len(results)} pictures, got a file name."
            )
    make_folder(picture)
    pictures = [picture / f"{path.stem}.png" for path in results]
    for path in pictures:
        check_place(path)
    return pictures


def check_drawing(path: Path, *, suffixes: Sequence[str] = DRAWINGS) -> None:
    """Raise before long work if a picture or page has no place, or cannot be made."""
    if path.suffix.lower() not in suffixes:
        raise FormatError(f"{path}: expected a file that ends in {' or '.join(suffixes)}.")
    check_place(path)
    if is_page(path):
        check_library()


def is_page(path: Path) -> bool:
    """Return whether a drawing is a page."""
    return path.suffix.lower() == ".html"


def is_archive(path: Path) -> bool:
    """Return whether a result goes to the format that holds it alone, without a cloud's fields."""
    return path.suffix.lower() == ".npz"
