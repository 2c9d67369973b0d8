"""Points as text, ``.xyz`` and ``.txt``: one point a line, numbers between spaces or commas.

A first line of names (``x y z red green blue``, with or without ``#`` or ``//``) names the columns;
without it :func:`torchrg.io.fields.name_columns` does. A line of one number before the first point
is the count of points that some programs write, and is skipped.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import Spelling, assemble_cloud, flatten_cloud, name_columns
from torchrg.io.files import atomic_path, check_file
from torchrg.structures import Cloud

LINES_AT_ONCE = 65_536


def read_table(
    path: Path,
    lines: Iterator[str],
    dtype: DTypeLike,
    *,
    first_line: int,
    num_rows: int | None = None,
    delimiter: str | None = None,
    comments: str | None = None,
) -> NDArray[np.void]:
    """Read rows of numbers; blank lines do not count.

    Args:
        path: The file, for messages.
        lines: Its lines from the first row on; read only as far as needed.
        dtype: A structured type; the lengths of its subarrays add up to the columns of a row.
        first_line: Number of the first line, counted from one, for messages.
        num_rows: Rows to read. Default: all.
        delimiter: What stands between two numbers. Default: white space.
        comments: What starts a comment. Default: nothing does.

    Returns:
        The rows, shape ``(num_rows,)``.

    Raises:
        FormatError: If a line does not hold the numbers of a row, or there are too few lines.
    """
    dtype = np.dtype(dtype)
    blocks, count, line_number = [np.empty(0, dtype)], 0, first_line
    while num_rows is None or count < num_rows:
        limit = LINES_AT_ONCE if num_rows is None else min(LINES_AT_ONCE, num_rows - count)
        block = list(islice(lines, limit))
        if not block:
            break
        rows = _parse(path, block, dtype, line_number, delimiter, comments)
        blocks.append(rows)
        count += len(rows)
        line_number += len(block)
    if num_rows is not None and count < num_rows:
        raise FormatError(
            f"{path}: line {line_number}: expected {num_rows:,} rows of numbers, got {count:,}; "
            "the file is cut off or its header is wrong, fetch it again."
        )
    return np.concatenate(blocks)


def _parse(
    path: Path,
    block: Sequence[str],
    dtype: np.dtype[np.void],
    line_number: int,
    delimiter: str | None,
    comments: str | None,
) -> NDArray[np.void]:
    """Parse a block of lines, and name the first one that is wrong."""
    filled = [line for line in block if not _is_blank(line, comments)]
    if not filled:
        return np.empty(0, dtype)
    try:
        return np.loadtxt(filled, dtype, delimiter=delimiter, comments=comments, ndmin=1)
    except (ValueError, OverflowError):
        pass
    for number, line in enumerate(block, start=line_number):
        if _is_blank(line, comments):
            continue
        try:
            np.loadtxt([line], dtype, delimiter=delimiter, comments=comments, ndmin=1)
        except (ValueError, OverflowError) as error:
            columns = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
            text = line.strip()
            shown = text if len(text) <= 60 else f"{text[:57]}..."
            raise FormatError(
                f"{path}: line {number}: expected {columns} numbers, got {shown!r}; "
                "repair or delete this line."
            ) from error
    raise FormatError(f"{path}: line {line_number}: expected rows of numbers; write it again.")


def _is_blank(line: str, comments: str | None) -> bool:
    """Whether a line holds no row."""
    text = line.strip()
    return not text or (comments is not None and text.startswith(comments))


def format_table(columns: Iterable[NDArray[np.generic]]) -> Iterator[str]:
    r"""Format columns of numbers as text that reads back to the same values.

    Args:
        columns: Columns of equal length ``N``, of whole numbers or floating point.

    Yields:
        Rows separated by newlines, a block at a time.

    Example:
        >>> "".join(format_table([np.array([0.1, 2.0]), np.array([3, 4], dtype=np.uint8)]))
        '0.1 3\n2.0 4\n'
    """
    kept = list(columns)
    # Nine digits identify a float32; the shortest text of a Python float identifies a float64.
    marks = {"f4": "%.9g", "f8": "%r"}
    row = " ".join(marks.get(column.dtype.str[1:], "%d") for column in kept) + "\n"
    for start in range(0, len(kept[0]), LINES_AT_ONCE):
        block = [column[start : start + LINES_AT_ONCE].tolist() for column in kept]
        values = tuple(chain.from_iterable(zip(*block, strict=True)))
        yield row * len(block[0]) % values


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
