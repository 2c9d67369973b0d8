"""Points as text, ``.xyz`` and ``.txt``: one point a line, numbers between spaces or commas.

A first line of names (``x y z red green blue``, with or without ``#`` or ``//``) names the columns;
without it :func:`torchrg.io.fields.name_numbered` does. A line of one number before the first point
is the count of points that some programs write, and is skipped. The rows of numbers in ASCII files
of other formats are read here, too.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.columns import Spelling, flatten_cloud
from torchrg.io.fields import Columns, naming_of, number_columns
from torchrg.io.files import atomic_path, check_promise
from torchrg.io.stream import CloudStream, Table

LINES_AT_ONCE = 65_536
"""Lines that are parsed or formatted together; bounds memory."""
_COUNTED_BYTES = 1 << 16
"""How much of a file is read to tell how long its lines are."""
_COMMENTS = ("#", "//")


def open_text(path: Path, size: int) -> Table:
    """Open points as text, always in float64."""
    with _open_lines(path) as stream:
        opening = _read_opening(path, stream)
    dtype = np.dtype([("row", "f8", (opening.num_columns,))])

    def read(chunk_size: int) -> Iterator[Columns]:
        with _open_lines(path) as stream:
            before = opening.line_number - 1
            for rows in _read_table(
                path,
                islice(stream, before, None),
                dtype,
                chunk_size,
                first_line=opening.line_number,
                delimiter=opening.delimiter,
                comments=_COMMENTS[0],
            ):
                table = rows["row"]
                if opening.names is None:
                    yield number_columns(table)
                else:
                    yield {name: table[:, i] for i, name in enumerate(opening.names)}

    naming = naming_of(opening.num_columns) if opening.names is None else None
    return Table(read, None, LINES_AT_ONCE, naming)


def _open_lines(path: Path) -> TextIO:
    """Open a file whose letters matter only in the names of columns."""
    return path.open(encoding="utf-8-sig", errors="replace")


def write_text(path: Path, stream: CloudStream) -> None:
    """Write points as text that reads back to the same values, names of fields in a comment."""
    spelling = Spelling()
    with atomic_path(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as file:
        for number, chunk in enumerate(stream):
            columns = flatten_cloud(path, chunk, spelling)
            if number == 0 and chunk.fields:
                file.write(f"# {' '.join(columns)}\n")
            file.writelines(_format_table(columns.values()))


def count_text(path: Path, stream: BinaryIO, size: int) -> int:
    """Return about the number of lines, by the length of the first."""
    sample = stream.read(_COUNTED_BYTES)
    return round(sample.count(b"\n") * size / max(len(sample), 1))


def read_ascii(
    path: Path,
    stream: BinaryIO,
    dtype: np.dtype[Any],
    chunk_size: int,
    *,
    start: int,
    num_rows: int,
    size: int,
    num_lines: int,
    skipped: int = 0,
    content: str,
) -> Iterator[NDArray[np.void]]:
    """Read rows of a structured type from an ASCII file of ``size`` bytes, chunk by chunk.

    The header has ``num_lines`` lines and ends before byte ``start``; ``skipped`` lines come before
    the rows, of which the header promises ``num_rows``. ``content`` is what rows are, for messages.
    """
    # A digit and what separates it from the next; the last may end with the file.
    least = num_rows * _num_columns(dtype) * 2 - 1
    content = f"{num_rows:,} {content}"
    check_promise(path, start, least, content, available=size - start, at_least=True)
    stream.seek(start)
    lines = (raw.decode("latin-1") for raw in stream)
    first_line = num_lines + 1 + sum(1 for _ in islice(lines, skipped))
    return _read_table(path, lines, dtype, chunk_size, first_line=first_line, num_rows=num_rows)


def _read_table(
    path: Path,
    lines: Iterator[str],
    dtype: np.dtype[Any],
    chunk_size: int,
    *,
    first_line: int,
    num_rows: int | None = None,
    delimiter: str | None = None,
    comments: str | None = None,
) -> Iterator[NDArray[np.void]]:
    """Read rows of numbers, all by default, a few lines at a time; blank ones do not count.

    Lines are read only as far as needed, the first of them being number ``first_line`` of the file.
    """
    count, line_number, at_once = 0, first_line, min(chunk_size, LINES_AT_ONCE)
    while num_rows is None or count < num_rows:
        limit = at_once if num_rows is None else min(at_once, num_rows - count)
        block = list(islice(lines, limit))
        if not block:
            break
        rows = _parse(path, block, dtype, line_number, delimiter, comments)
        if len(rows) > 0:
            yield rows
        count += len(rows)
        line_number += len(block)
    if num_rows is not None and count < num_rows:
        raise FormatError(
            f"{path}: line {line_number}: expected {num_rows:,} rows of numbers, got {count:,}; "
            "the file is cut off or its header is wrong, fetch it again."
        )
    if count == 0:
        yield np.empty(0, dtype)


def _parse(
    path: Path,
    block: Sequence[str],
    dtype: np.dtype[Any],
    line_number: int,
    delimiter: str | None,
    comments: str | None,
) -> NDArray[np.void]:
    """Parse a block of lines, and name the first one that is wrong."""

    def parse(lines: list[str]) -> NDArray[np.void]:
        return np.loadtxt(lines, dtype, delimiter=delimiter, comments=comments, ndmin=1)

    numbered = [
        (number, line)
        for number, line in enumerate(block, start=line_number)
        if (text := line.strip()) and (comments is None or not text.startswith(comments))
    ]
    if not numbered:
        return np.empty(0, dtype)
    try:
        return parse([line for _, line in numbered])
    except (ValueError, OverflowError):
        pass
    for number, line in numbered:
        try:
            parse([line])
        except (ValueError, OverflowError) as error:
            text = line.strip()
            shown = text if len(text) <= 60 else f"{text[:57]}..."
            raise FormatError(
                f"{path}: line {number}: expected {_num_columns(dtype)} numbers, got {shown!r}; "
                "repair or delete this line."
            ) from error
    raise FormatError(f"{path}: line {line_number}: expected rows of numbers; write it again.")


def _num_columns(dtype: np.dtype[Any]) -> int:
    """Return the number of columns of a row."""
    return sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())


class _Opening(NamedTuple):
    """What the lines up to the first point say, and the number of that point's line, from one.

    Names are None without a header, the delimiter is None for white space.
    """

    names: list[str] | None
    delimiter: str | None
    num_columns: int
    line_number: int


def _read_opening(path: Path, lines: Iterable[str]) -> _Opening:
    """Read up to the first line of numbers."""
    names: list[str] | None = None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        is_comment = text.startswith(_COMMENTS)
        bare = text.lstrip("#/") if is_comment else text.split(_COMMENTS[0])[0]
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
            return _Opening(names, delimiter, len(words), number)
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


def _format_table(columns: Iterable[NDArray[np.generic]]) -> Iterator[str]:
    """Yield columns as text that reads back to the same values, a block of lines at a time."""
    kept = list(columns)
    # Nine digits identify a float32; the shortest text of a Python float identifies a float64.
    marks = {"f4": "%.9g", "f8": "%r"}
    row = " ".join(marks.get(column.dtype.str[1:], "%d") for column in kept) + "\n"
    for start in range(0, len(kept[0]), LINES_AT_ONCE):
        block = [column[start : start + LINES_AT_ONCE].tolist() for column in kept]
        values = tuple(chain.from_iterable(zip(*block, strict=True)))
        yield row * len(block[0]) % values
