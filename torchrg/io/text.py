"""Text files (``.xyz .txt .asc .pts .csv``), one point per line.

The delimiter is a comma, semicolon, tab or blanks; the decimal separator may be a comma if that is
not the delimiter. A first line of names (``x y z red green blue``, with or without ``#`` or ``//``)
names the columns unless the caller does; otherwise :data:`torchrg.io.tables.COLUMNS_RULE` applies.
A line of one number before the first point is the point count, as in Leica's ``.pts``. Further
scans begin with their count. pyarrow, if installed, parses plain numbers. The slower
parser here handles the remaining cases with bit-identical results and reports errors. It also
reads the rows of other ASCII formats.
"""

import csv
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import numpy as np

from torchrg import scratch
from torchrg._parallel import split_rows
from torchrg.errors import FormatError, warn
from torchrg.io.arrow import parse_numbers
from torchrg.io.columns import FieldNames, check_exact, flatten_cloud
from torchrg.io.fields import SKIPPED, assemble_table, check_names
from torchrg.io.files import atomic_path, check_available, find_encoding, parse_count
from torchrg.structures import Cloud
from torchrg.structures.points import Array

LINES_PER_CHUNK = 65_536
"""Lines parsed or formatted together, which bounds the memory."""
CHARACTERS_PER_READ = 1 << 22
"""Characters read together, which bounds the memory and still occupies all cores."""
_SAMPLE_BYTES = 1 << 16
"""Bytes read to estimate the line length."""
_COMMENTS = ("#", "//", "BEGIN", "END")
"""Beginnings of lines without points. Words alone separate the scans of a file."""
_WINDOWS_NAN = re.compile(r"1[.,]#[A-Z]+[0-9]*|nan\([a-z]*\)", re.IGNORECASE)
"""Numbers that are not finite, as Windows prints them: ``-1.#IND``, ``1.#QNAN0``, ``-nan(ind)``."""


class _Dialect(NamedTuple):
    """Number format of a line.

    Attributes:
        delimiter: Delimiter; None for white space.
        decimal: Decimal separator.
    """

    delimiter: str | None = None
    decimal: str = "."

    def split(self, text: str) -> list[str]:
        """Split a line into words, with decimal points."""
        words = [word.strip().strip("\"'") for word in text.split(self.delimiter)]
        return [word.replace(self.decimal, ".") for word in words]


_DIALECTS = (_Dialect(";"), _Dialect(";", ","), _Dialect(","), _Dialect(), _Dialect(None, ","))
"""Candidates; the first one that parses all words of a line as numbers is used."""
_DELIMITER_NAMES = {None: "blanks", ",": "commas", ";": "semicolons"}
"""Names of delimiters in messages."""


def read_text(path: Path, size: int, columns: Sequence[str] | None = None) -> Cloud:
    """Read a text file in float64; ``columns`` overrides the file's column names."""
    # Decoding errors matter only in column names.
    with path.open(encoding=find_encoding(path), errors="replace") as stream:
        preamble = _read_preamble(path, map(_standardize, stream), columns)
        table = scratch.join([*map(scratch.store, _parse_blocks(path, stream, preamble))])
    num_points = sum(preamble.counts)
    if len(table) < num_points:
        raise FormatError(
            f"{path}: expected {num_points:,} points by the count before them, got {len(table):,}; "
            "the file is truncated or the count is wrong, copy it again, or delete that line."
        )
    notes: tuple[str, ...] = ()
    if preamble.dialect.decimal == ",":
        notes += ("its commas are read as decimal points",)
    if preamble.counts and len(table) > num_points:
        notes += (f"the count before its points is {num_points:,}, but {len(table):,} follow",)
    return assemble_table(path, table, preamble.names, notes, preamble.integers)


def write_text(path: Path, cloud: Cloud) -> None:
    """Write text that reads back to identical values, with the field names in a comment."""
    columns = flatten_cloud(path, cloud, FieldNames())
    check_exact(path, columns)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as out:
        if cloud.fields:
            out.write(f"# {' '.join(columns)}\n")
        # Nine digits identify a float32; Python's shortest repr identifies a float64.
        formats = {"f4": "%.9g", "f8": "%r"}
        row = " ".join(formats.get(c.dtype.str[1:], "%d") for c in columns.values()) + "\n"
        for rows in split_rows(len(cloud), LINES_PER_CHUNK):
            block = [column[rows].tolist() for column in columns.values()]
            out.write(row * len(block[0]) % tuple(chain.from_iterable(zip(*block, strict=True))))


def count_text(path: Path, size: int) -> int:
    """Estimate the number of lines from the mean line length at the beginning."""
    with path.open("rb") as stream:
        sample = stream.read(_SAMPLE_BYTES)
    return round(sample.count(b"\n") * size / max(len(sample), 1))


def read_rows(
    path: Path,
    stream: BinaryIO,
    dtype: np.dtype[Any],
    num_rows: int,
    content: str,
    *,
    line_number: int,
) -> Array:
    """Read rows of a structured type from an ASCII file, starting at ``line_number``.

    ``content`` names the rows in messages. Blank lines are ignored, and no further line is read.
    """
    # A digit and a separator per number; the last separator may be missing.
    min_bytes, start = num_rows * _num_columns(dtype) * 2 - 1, stream.tell()
    available = os.fstat(stream.fileno()).st_size - start
    content = f"{num_rows:,} {content}"
    check_available(path, start, min_bytes, content, available=available, at_least=True)
    lines = (_standardize(raw.decode("latin-1")) for raw in stream)
    rows, count = scratch.empty((num_rows,), dtype), 0
    while count < num_rows:
        block = list(islice(lines, min(LINES_PER_CHUNK, num_rows - count)))
        if not block:
            raise FormatError(
                f"{path}: line {line_number}: expected {num_rows:,} rows of numbers, got "
                f"{count:,}; the file is truncated or its header is wrong, write or copy it again."
            )
        parsed = _parse(path, block, dtype, line_number)
        rows[count : count + len(parsed)] = parsed
        count += len(parsed)
        line_number += len(block)
    return rows


def _standardize(text: str) -> str:
    """Return text with Windows' spellings of numbers that are not finite as ``nan``."""
    return _WINDOWS_NAN.sub("nan", text) if "#" in text or "(" in text else text


def skip_lines(stream: BinaryIO, count: int) -> int:
    """Skip ``count`` non-blank lines, and return the number of lines read."""
    passed = 0
    while count > 0 and (line := stream.readline()):
        passed += 1
        count -= bool(line.strip())
    return passed


def _parse_blocks(path: Path, stream: TextIO, preamble: "_Preamble") -> Iterator[Array]:
    """Yield tables of the first point and of the lines that follow it in a stream."""
    dtype = np.dtype([("row", "f8", (preamble.num_columns,))])
    line, number = preamble.line, preamble.line_number
    skipped = [i for i, name in enumerate(preamble.names or ()) if name == SKIPPED]
    while block := line + _standardize(stream.read(CHARACTERS_PER_READ) + stream.readline()):
        table = parse_numbers(block.encode(), preamble.num_columns, *preamble.dialect)
        if table is None:
            lines = block.split("\n")
            # Each scan in a Cyclone file begins with its count. Blank it.
            for index, text in enumerate(lines) if preamble.counts else ():
                if (count := parse_count(text.strip())) is not None:
                    preamble.counts.append(count)
                    lines[index] = ""
            table = _parse(path, lines, dtype, number, preamble.dialect, skipped)["row"]
        yield table
        line, number = "", number + block.count("\n")


def _parse(
    path: Path,
    block: Sequence[str],
    dtype: np.dtype[Any],
    line_number: int,
    dialect: _Dialect | None = None,
    skipped: Collection[int] = (),
) -> Array:
    """Parse a block of lines; an error names the first wrong line.

    Without a dialect, blanks separate numbers, without comments. Skipped columns may hold words.
    """
    delimiter, decimal, comments = (*dialect, _COMMENTS[0]) if dialect else (None, ".", None)
    converters: dict[int | str, Callable[[str], float]] | None
    converters = dict.fromkeys(skipped, lambda word: np.nan) or None

    def parse(lines: list[str]) -> Array:
        if decimal != ".":
            lines = [line.replace(decimal, ".") for line in lines]
        # NumPy before 2.3 truncates numbers to integers, with a deprecation warning.
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                return np.loadtxt(lines, dtype, comments, delimiter, converters, ndmin=1)
            except DeprecationWarning as warning:
                raise ValueError(str(warning)) from warning

    numbered = [
        (number, line)
        for number, line in enumerate(block, start=line_number)
        if (text := line.strip()) and (comments is None or not text.startswith(_COMMENTS))
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
                f"{_suggest_fix(text, _num_columns(dtype), dialect)}."
            ) from error
    raise FormatError(f"{path}: line {line_number}: expected rows of numbers; write it again.")


def _suggest_fix(text: str, num_columns: int, dialect: _Dialect | None) -> str:
    """Return the fix for a line that does not match a number format."""
    expected = dialect or _Dialect()
    for candidate in _DIALECTS:
        words = candidate.split(text)
        if candidate == expected or len(words) != num_columns or not all(map(_is_number, words)):
            continue
        if candidate.decimal == expected.decimal:
            return f"separate all numbers with {_DELIMITER_NAMES[expected.delimiter]}"
        return "write all decimals with points" + (", or all with commas" if dialect else "")
    words = expected.split(text)
    if dialect is not None and len(words) == num_columns and not all(map(_is_number, words)):
        return f"correct or delete this line, or skip a column of words with {SKIPPED} in --columns"
    return "correct or delete this line"


def _num_columns(dtype: np.dtype[Any]) -> int:
    """Return the number of columns per row."""
    return sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())


class _Preamble(NamedTuple):
    """Header of a text file, the line of its first point, and the line number, from 1.

    ``names`` is None without a header. ``counts`` are point counts, at most one so far.
    """

    names: list[str] | None
    dialect: _Dialect
    num_columns: int
    counts: list[int]
    line: str
    line_number: int

    @property
    def integers(self) -> list[int]:
        """Indices of columns that are integers in the first point."""
        words = self.dialect.split(self.line.split(_COMMENTS[0])[0])
        return [i for i, word in enumerate(words) if word.removeprefix("-").isdecimal()]


def _read_preamble(path: Path, lines: Iterable[str], columns: Sequence[str] | None) -> _Preamble:
    """Read up to the first line of numbers."""
    header, comment, counts = "", "", list[int]()
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        is_comment = text.startswith(_COMMENTS)
        bare = text.lstrip("#/") if is_comment else text.split(_COMMENTS[0])[0]
        dialect = _detect_dialect(bare)
        words = dialect.split(bare)
        are_numbers = [_is_number(word) for word in words]
        if is_comment:
            header, comment = (bare, "") if _parse_names(bare) else (header, bare)
        elif not bare.strip():
            continue
        elif len(words) == 1 and are_numbers[0]:
            count = parse_count(words[0])
            if count is None:
                raise FormatError(
                    f"{path}: line {number}: expected a point count or a point, got "
                    f"{text[:60]!r}; correct or delete this line."
                )
            counts.append(count)
            if len(counts) > 1:
                raise FormatError(
                    f"{path}: line {number}: expected a point after the point count, got a second "
                    "count, as in PTX files; export PTS, E57 or PLY."
                )
        elif not any(are_numbers) and not header:
            if not _parse_names(bare) and columns is None:
                raise FormatError(
                    f"{path}: line {number}: expected numbers or column names with x, y and z, got "
                    f"{text[:60]!r}; name the columns there or with --columns, or mark the line as "
                    "a comment with #."
                )
            header = bare
        elif len(words) < 3:
            raise FormatError(
                f"{path}: line {number}: expected at least 3 numbers, got {text[:60]!r}; "
                "correct or delete this line."
            )
        else:
            if columns is not None:
                check_names(path, columns, len(words))
                names: list[str] | None = list(columns)
            else:
                names = _match_names(path, header, words, number) if header else None
                if names is None and len(words) > 3:
                    _warn_about_names(path, comment, len(words))
            return _Preamble(names, dialect, len(words), counts, line, number)
    raise FormatError(f"{path}: expected at least one point, got none; check the file's source.")


def _detect_dialect(text: str) -> _Dialect:
    """Detect the number format of a line; for words, guess the delimiter."""
    for dialect in _DIALECTS:
        if all(map(_is_number, dialect.split(text))):
            return dialect
    return _Dialect(next((delimiter for delimiter in ";," if delimiter in text), None))


def _parse_names(text: str) -> list[list[str]]:
    """Return the readings of a line as column names that include x, y and z.

    If there is none, units in brackets, as in ``X [m]``, are left out of the names.
    """
    for line in (text, re.sub(r"\s*[\[(][^\])]*[\])]", "", text)):
        named = [row for row in _split_names(line) if {"x", "y", "z"} <= {*map(str.lower, row)}]
        if named:
            return named
    return []


def _warn_about_names(path: Path, comment: str, num_columns: int) -> None:
    """Warn if a comment before the points names all columns, but no x, y and z."""
    readings = [row for row in _split_names(comment) if len(row) == num_columns]
    if any(not any(map(_is_number, row)) for row in readings):
        warn(
            f"{path}: its comment names columns {comment.strip()[:60]!r}, none of them x, y and z: "
            "the first three are taken; name the columns with --columns."
        )


def _split_names(text: str) -> list[list[str]]:
    """Return all readings of a line as distinct words, one per delimiter.

    Quoted names may contain the delimiter.
    """
    rows = []
    for delimiter in ";,\t ":
        try:
            (row,) = csv.reader(
                [text.replace("\t", " ") if delimiter == " " else text], delimiter=delimiter
            )
        except csv.Error:
            return []
        words = [word.strip().strip("\"'") for word in row if delimiter != " " or word]
        if len(set(words)) == len(words):
            rows.append(words)
    return rows


def _match_names(path: Path, header: str, words: Sequence[str], number: int) -> list[str]:
    """Return the column names in the header if they match the first point."""
    readings = _parse_names(header)
    names = next((names for names in readings if len(names) == len(words)), None)
    if names is not None:
        return names
    max_names, shown = max(map(len, readings), default=0), " ".join(words)[:60]
    message = f"{path}: line {number}: expected {max_names} numbers, got {shown!r}"
    if max_names > len(words):
        raise FormatError(
            f"{message}, for names that may contain blanks: {header.strip()[:60]!r}; name the "
            f"{len(words)} columns with --columns, or replace the blanks with _."
        )
    raise FormatError(f"{message}; correct or delete this line.")


def _is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
