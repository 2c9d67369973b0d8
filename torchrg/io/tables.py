"""Tables of numbers as text, the part that .xyz, .txt and the ASCII forms of .ply and .pcd share.

NumPy's reader in C, fed a block of lines at a time: memory grows with what is really there, and a
line that is not numbers is named.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from torchrg.errors import FormatError

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
