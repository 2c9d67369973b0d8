"""Points as text, ``.xyz .txt .asc .pts .csv``: one point a line, numbers between spaces or marks.

Marks are commas, semicolons or tabs; decimals may begin with a comma where that is not the mark. A
first line of names (``x y z red green blue``, with or without ``#`` or ``//``) names the columns,
unless names are given; without either :data:`torchrg.io.fields.COLUMNS_RULE` does. A line of one
number before the first point is the count of points, as Leica's ``.pts`` begins; its further scans
begin with theirs. Plain numbers are parsed by pyarrow where it is installed; what it does not take
is parsed here, which gives the same bits and says what is wrong. The rows of numbers in ASCII files
of other formats are read here, too.
"""

import csv
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TextIO

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.arrow import parse_numbers
from torchrg.io.columns import Spelling, check_exact, flatten_cloud, slices
from torchrg.io.fields import LEFT_OUT, Values, assemble_table, check_names
from torchrg.io.files import atomic_path, check_promise
from torchrg.structures import Cloud

LINES_AT_ONCE = 65_536
"""Lines that are parsed or formatted together; bounds memory."""
CHARACTERS_AT_ONCE = 1 << 22
"""Characters of a file that are read together; bounds memory, and gives each core some lines."""
_COUNTED_BYTES = 1 << 16
"""How much of a file is read to tell how long its lines are."""
_COMMENTS = ("#", "//")
_COLMAP = "POINT3D_ID, X, Y, Z"
"""Comment of COLMAP above its points, which are followed by the images that see them, in
``points3D.txt``."""
_MAX_DIGITS = 18
"""Most digits of a number of points; no file has room for more points."""


class _Form(NamedTuple):
    """How the numbers of a line are written.

    Attributes:
        delimiter: What is between them; None for white space.
        decimal: What their decimals begin with.
    """

    delimiter: str | None = None
    decimal: str = "."

    def split(self, text: str) -> list[str]:
        """Return the words of a line, decimals after a point."""
        words = [word.strip().strip("\"'") for word in text.split(self.delimiter)]
        return [word.replace(self.decimal, ".") for word in words]


_FORMS = (_Form(";"), _Form(";", ","), _Form(","), _Form(), _Form(None, ","))
"""The first that makes numbers of all words of a line is its form."""
_MARKS = {None: "blanks", ",": "commas", ";": "semicolons"}
"""Names of what is between numbers, for people."""


def read_text(path: Path, size: int, columns: Sequence[str] | None = None) -> Cloud:
    """Read points as text, always in float64; ``columns`` are names in place of the file's own."""
    # Letters matter only in the names of columns.
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        opening = _read_opening(path, stream, columns)
        table = np.concatenate(list(_parse_blocks(path, stream, opening)))
    promised = sum(opening.counts)
    if len(table) < promised:
        raise FormatError(
            f"{path}: expected {promised:,} points, as the line before them says, got "
            f"{len(table):,}; the file is cut off or the line is wrong, copy it again, or delete "
            "that line."
        )
    notes: tuple[str, ...] = ()
    if opening.form.decimal == ",":
        notes += ("its commas are taken as decimal points",)
    if opening.counts and len(table) > promised:
        notes += (f"the line before its points says {promised:,}, but {len(table):,} follow",)
    return assemble_table(path, table, opening.names, notes, opening.integers)


def write_text(path: Path, cloud: Cloud) -> None:
    """Write points as text that reads back to the same values, names of fields in a comment."""
    columns = flatten_cloud(path, cloud, Spelling())
    check_exact(path, columns)
    with atomic_path(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as file:
        if cloud.fields:
            file.write(f"# {' '.join(columns)}\n")
        # Nine digits identify a float32; the shortest text of a Python float identifies a float64.
        marks = {"f4": "%.9g", "f8": "%r"}
        row = " ".join(marks.get(c.dtype.str[1:], "%d") for c in columns.values()) + "\n"
        for rows in slices(len(cloud), LINES_AT_ONCE):
            block = [column[rows].tolist() for column in columns.values()]
            file.write(row * len(block[0]) % tuple(chain.from_iterable(zip(*block, strict=True))))


def count_text(path: Path, size: int) -> int:
    """Return about the number of lines, by the length of the first."""
    with path.open("rb") as stream:
        sample = stream.read(_COUNTED_BYTES)
    return round(sample.count(b"\n") * size / max(len(sample), 1))


def read_rows(
    path: Path,
    stream: BinaryIO,
    dtype: np.dtype[Any],
    num_rows: int,
    content: str,
    *,
    line_number: int,
) -> Values:
    """Read rows of a structured type from an ASCII file, the next line of which has this number.

    ``content`` is what rows are, for messages.
    """
    # A digit and what separates it from the next; the last may end with the file.
    least, start = num_rows * _num_columns(dtype) * 2 - 1, stream.tell()
    available = os.fstat(stream.fileno()).st_size - start
    content = f"{num_rows:,} {content}"
    check_promise(path, start, least, content, available=available, at_least=True)
    lines = (raw.decode("latin-1") for raw in stream)
    return _read_table(path, lines, dtype, line_number, num_rows)


def skip_lines(stream: BinaryIO, count: int) -> int:
    """Pass so many lines of an ASCII file that are not blank, and return how many that took."""
    passed = 0
    while count > 0 and (line := stream.readline()):
        passed += 1
        count -= bool(line.strip())
    return passed


def _read_table(
    path: Path, lines: Iterator[str], dtype: np.dtype[Any], line_number: int, num_rows: int
) -> Values:
    """Read rows of numbers; blank lines do not count.

    Lines are read only as far as needed, the first of them has this number in the file.
    """
    parts, count = [np.empty(0, dtype)], 0
    while count < num_rows:
        block = list(islice(lines, min(LINES_AT_ONCE, num_rows - count)))
        if not block:
            raise FormatError(
                f"{path}: line {line_number}: expected {num_rows:,} rows of numbers, got "
                f"{count:,}; the file is cut off or its header is wrong, write or copy it again."
            )
        parts.append(_parse(path, block, dtype, line_number))
        count += len(parts[-1])
        line_number += len(block)
    return np.concatenate(parts)


def _parse_blocks(path: Path, stream: TextIO, opening: "_Opening") -> Iterator[Values]:
    """Parse the first point, and the lines that follow it in a stream, into tables."""
    dtype = np.dtype([("row", "f8", (opening.num_columns,))])
    line, number = opening.line, opening.line_number
    while block := line + stream.read(CHARACTERS_AT_ONCE) + stream.readline():
        table = parse_numbers(block.encode(), opening.num_columns, *opening.form)
        if table is None:
            lines = _without_counts(block.split("\n"), opening.counts)
            table = _parse(path, lines, dtype, number, opening.form, opening.left_out)["row"]
        yield table
        line, number = "", number + block.count("\n")


def _without_counts(lines: list[str], counts: list[int]) -> list[str]:
    """Return lines with blank ones in place of counts of points, which are added to those before.

    Each scan in a file of Cyclone begins with its count. Without one before the first, lines stay.
    """
    if counts:
        for place, line in enumerate(lines):
            if (count := _count_of(line.strip())) is not None:
                counts.append(count)
                lines[place] = ""
    return lines


def _count_of(text: str) -> int | None:
    """Return the count of points that a line is, or None."""
    return int(text) if text.isdecimal() and len(text) <= _MAX_DIGITS else None


def _parse(
    path: Path,
    block: Sequence[str],
    dtype: np.dtype[Any],
    line_number: int,
    form: _Form | None = None,
    left_out: Collection[int] = (),
) -> Values:
    """Parse a block of lines, and name the first one that is wrong.

    Without a form numbers stand between white space, and there are no comments. Columns that are
    left out may hold words.
    """
    delimiter, decimal, comments = (None, ".", None) if form is None else (*form, _COMMENTS[0])
    converters: dict[int | str, Callable[[str], float]] | None
    converters = dict.fromkeys(left_out, lambda word: np.nan) or None

    def parse(lines: list[str]) -> Values:
        if decimal != ".":
            lines = [line.replace(decimal, ".") for line in lines]
        # Before version 2.3 NumPy cuts numbers to fit an integer, and warns that it will not.
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                return np.loadtxt(lines, dtype, comments, delimiter, converters, ndmin=1)
            except DeprecationWarning as warning:
                raise ValueError(str(warning)) from warning

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
                f"{_repair_of(text, _num_columns(dtype), form)}."
            ) from error
    raise FormatError(f"{path}: line {line_number}: expected rows of numbers; write it again.")


def _repair_of(text: str, num_columns: int, form: _Form | None) -> str:
    """Return what to do about a line that is not numbers of this form."""
    expected = form or _Form()
    for other in _FORMS:
        words = other.split(text)
        if other == expected or len(words) != num_columns or not all(map(_is_number, words)):
            continue
        if other.decimal == expected.decimal:
            return f"separate all numbers with {_MARKS[expected.delimiter]}"
        return "write all decimals with points" + (", or all with commas" if form else "")
    words = expected.split(text)
    if form is not None and len(words) == num_columns and not all(map(_is_number, words)):
        return (
            f"repair or delete this line, or leave a column of words out, {LEFT_OUT} in --columns"
        )
    return "repair or delete this line"


def _num_columns(dtype: np.dtype[Any]) -> int:
    """Return the number of columns of a row."""
    return sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())


class _Opening(NamedTuple):
    """What the lines up to the first point say, that point's line, and its number, from one.

    Names are None without a header. Counts are numbers of points that follow, one at most so far.
    """

    names: list[str] | None
    form: _Form
    num_columns: int
    counts: list[int]
    line: str
    line_number: int

    @property
    def integers(self) -> list[int]:
        """Columns that the first point has as integers."""
        words = self.form.split(self.line.split(_COMMENTS[0])[0])
        return [i for i, word in enumerate(words) if word.removeprefix("-").isdecimal()]

    @property
    def left_out(self) -> list[int]:
        """Places of the columns that nobody wants."""
        return [i for i, name in enumerate(self.names or ()) if name == LEFT_OUT]


def _read_opening(path: Path, lines: Iterable[str], columns: Sequence[str] | None) -> _Opening:
    """Read up to the first line of numbers."""
    header, counts = "", list[int]()
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        is_comment = text.startswith(_COMMENTS)
        bare = text.lstrip("#/") if is_comment else text.split(_COMMENTS[0])[0]
        form = _form_of(bare)
        words = form.split(bare)
        are_numbers = [_is_number(word) for word in words]
        if is_comment and _COLMAP in text:
            raise FormatError(
                f"{path}: line {number}: expected points, got those of COLMAP with their images; "
                f"colmap model_converter --input_path {path.parent} --output_path points.ply "
                "--output_type PLY writes a file that is read."
            )
        if is_comment:
            header = bare if _name_lists(bare) else header
        elif not bare.strip():
            continue
        elif len(words) == 1 and are_numbers[0]:
            count = _count_of(words[0])
            if count is None:
                raise FormatError(
                    f"{path}: line {number}: expected a count of points or a point, got "
                    f"{text[:60]!r}; correct or delete this line."
                )
            counts.append(count)
            if len(counts) > 1:
                raise FormatError(
                    f"{path}: line {number}: expected a point after the count of points, got a "
                    "second count, as in PTX files; export PTS, E57 or PLY."
                )
        elif not any(are_numbers) and not header:
            if not _name_lists(bare) and columns is None:
                raise FormatError(
                    f"{path}: line {number}: expected numbers or names of columns with x, y and z, "
                    f"got {text[:60]!r}; name the columns there or with --columns, or mark the "
                    "line as a comment with #."
                )
            header = bare
        elif len(words) < 3:
            raise FormatError(
                f"{path}: line {number}: expected at least 3 numbers, got {text[:60]!r}; "
                "repair or delete this line."
            )
        else:
            if columns is not None:
                check_names(path, columns, len(words))
                names: list[str] | None = list(columns)
            else:
                names = _names_of(path, header, words, number) if header else None
            return _Opening(names, form, len(words), counts, line, number)
    raise FormatError(f"{path}: expected at least one point, got none; check where it comes from.")


def _form_of(text: str) -> _Form:
    """Return how the numbers of a line are written, or would be if its words were numbers."""
    for form in _FORMS:
        if all(map(_is_number, form.split(text))):
            return form
    return _Form(next((mark for mark in ";," if mark in text), None))


def _name_lists(text: str) -> list[list[str]]:
    """Return the ways to read a line as names of the columns of points, each name once.

    Names may be in quotes and then hold what is between the others.
    """
    rows = []
    for mark in ";,\t ":
        try:
            (row,) = csv.reader([text.replace("\t", " ") if mark == " " else text], delimiter=mark)
        except csv.Error:
            return []
        words = [word.strip().strip("\"'") for word in row if mark != " " or word]
        if {"x", "y", "z"} <= {word.lower() for word in words} and len(set(words)) == len(words):
            rows.append(words)
    return rows


def _names_of(path: Path, header: str, words: Sequence[str], number: int) -> list[str]:
    """Return the names of the columns by the header, as many as the first point has numbers."""
    lists = _name_lists(header)
    names = next((names for names in lists if len(names) == len(words)), None)
    if names is not None:
        return names
    most, shown = max(map(len, lists), default=0), " ".join(words)[:60]
    message = f"{path}: line {number}: expected {most} numbers, got {shown!r}"
    if most > len(words):
        raise FormatError(
            f"{message}, under names that may hold blanks: {header.strip()[:60]!r}; name the "
            f"{len(words)} columns with --columns, or put _ in place of the blanks."
        )
    raise FormatError(f"{message}; repair or delete this line.")


def _is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
