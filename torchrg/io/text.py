"""Points as text, ``.xyz`` and ``.txt``: one point a line, numbers between spaces or commas.

A first line of names (``x y z red green blue``, with or without ``#`` or ``//``) names the columns;
without it :func:`torchrg.io.fields.name_columns` does. A line of one number before the first point
is the count of points that some programs write, and is skipped.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from torchrg.errors import FormatError
from torchrg.io.atomic import atomic_path
from torchrg.io.columns import Spelling, flatten_cloud
from torchrg.io.fields import assemble_cloud, name_columns
from torchrg.io.files import check_file
from torchrg.io.tables import format_table, read_table
from torchrg.structures import Cloud

COMMENTS = ("#", "//")


class Opening(NamedTuple):
    """What the lines up to the first point say.

    Attributes:
        names: Names of the columns, None without a header.
        delimiter: What stands between two numbers, None for white space.
        num_columns: Numbers in a line.
        line: The line of the first point.
        line_number: Its number, counted from one.
    """

    names: list[str] | None
    delimiter: str | None
    num_columns: int
    line: str
    line_number: int


def read_text(path: Path) -> Cloud:
    """Read points as text, always in float64.

    Args:
        path: The file.

    Returns:
        The cloud.

    Raises:
        FormatError: If a line is not numbers, or has not as many as the first.
    """
    check_file(path)
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        lines = iter(stream)
        opening = _read_opening(path, lines)
        table = read_table(
            path,
            itertools.chain([opening.line], lines),
            [("row", "f8", (opening.num_columns,))],
            first_line=opening.line_number,
            delimiter=opening.delimiter,
            comments=COMMENTS[0],
        )["row"]
    if opening.names is None:
        return assemble_cloud(path, name_columns(table))
    return assemble_cloud(path, {name: table[:, i] for i, name in enumerate(opening.names)})


def write_text(path: Path, cloud: Cloud) -> None:
    """Write points as text that reads back to the same values, with the names in a first comment.

    Args:
        path: The file.
        cloud: The cloud. A cloud without fields has no comment.

    Raises:
        FormatError: If a field cannot be a column, or the file cannot be written.
    """
    columns = flatten_cloud(path, cloud, Spelling())
    with atomic_path(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as stream:
        if cloud.fields:
            stream.write(f"# {' '.join(columns)}\n")
        stream.writelines(format_table(columns.values()))


def _read_opening(path: Path, lines: Iterator[str]) -> Opening:
    """Read up to the first line of numbers."""
    names: list[str] | None = None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        is_comment = text.startswith(COMMENTS)
        bare = text.lstrip("#/") if is_comment else text.split(COMMENTS[0])[0]
        delimiter = next((mark for mark in ",;" if mark in bare), None)
        words = [word.strip().strip("\"'") for word in bare.split(delimiter)]
        are_numbers = [_is_number(word) for word in words]
        if is_comment:
            names = words if _are_names(words) else names
        elif not text or (len(words) == 1 and are_numbers[0]):
            continue
        elif not any(are_numbers) and names is None:
            if not _are_names(words):
                raise FormatError(
                    f"{path}: line {number}: expected numbers or names of columns with x, y and z, "
                    f"got {text[:60]!r}; name the columns, or mark the line as a comment with #."
                )
            names = words
        elif len(words) < 3 or (names is not None and len(names) != len(words)):
            expected = "at least 3" if names is None else str(len(names))
            raise FormatError(
                f"{path}: line {number}: expected {expected} numbers, got {text[:60]!r}; "
                "repair or delete this line."
            )
        else:
            return Opening(names, delimiter, len(words), f"{text}\n", number)
    raise FormatError(f"{path}: expected at least one point, got none; fetch the file again.")


def _are_names(words: list[str]) -> bool:
    """Whether words are the names of the columns of points, each once."""
    return {"x", "y", "z"} <= {word.lower() for word in words} and len(set(words)) == len(words)


def _is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
