"""From a cloud to the columns of a file, by the format's own names and types."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.colors import narrow_colors
from torchrg.io.fields import LARGEST_WHOLE, LEFT_OUT, Columns, Values, name_aside
from torchrg.io.files import atomic_path
from torchrg.structures import Cloud

_RECORDS_AT_ONCE = 1 << 20
"""Records that are made and written together, which bounds the memory beside the cloud."""
_LABELS = ("labels", name_aside("labels"))


class Spelling(NamedTuple):
    """How a format spells torchrg's names.

    Attributes:
        normals: Names of the three components.
        color: Names of the three channels.
        curvature: Name of the curvature.
        color_bits: Width of a channel, 8 or 16; colours of 16 bits are rounded to 8, not widened.
        vectors: Whether other fields of several columns stay one, shape ``(N, C)``.
        blanks: Whether names keep their blanks, which become ``_`` elsewhere.
    """

    normals: tuple[str, str, str] = ("nx", "ny", "nz")
    color: tuple[str, str, str] = ("red", "green", "blue")
    curvature: str = "curvature"
    color_bits: int = 8
    vectors: bool = False
    blanks: bool = False


def flatten_cloud(path: Path, cloud: Cloud, spelling: Spelling) -> dict[str, Values]:
    """Spread a cloud over columns by the format's names: ``x y z`` first, then its fields.

    Labels are int32 where that holds them, colours uint8 (or uint16 if the format holds it), truth
    values uint8, half precision float32. A field of several columns is ``name_0``, ``name_1`` and
    so on, unless the format has ``vectors``.
    """
    columns: dict[str, Values] = {axis: cloud.coordinates[:, i] for i, axis in enumerate("xyz")}
    for name, values in cloud.fields.items():
        if name == LEFT_OUT:
            raise FormatError(f"{path}: expected names of fields, got {name!r}; rename it.")
        values = _storable(path, name, values, spelling)
        if name in _LABELS:
            values = narrow_integers(values, ("i4",))
        for column_name, column in _spread(name, values, spelling).items():
            if column_name in columns:
                raise FormatError(
                    f"{path}: expected fields of different names, got {column_name!r} twice; "
                    "rename one."
                )
            columns[column_name] = column
    return columns


def check_length(path: Path, name: str, values: Values, num_points: int) -> None:
    """Check that a field has a value for each point."""
    if values.shape[:1] != (num_points,):
        raise FormatError(
            f"{path}: expected field {name} of shape ({num_points}, ...), got {values.shape}; "
            "give one row a point."
        )


def _storable(path: Path, name: str, values: Values, spelling: Spelling) -> Values:
    """Return a field as real numbers that files hold."""
    if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8:
        raise FormatError(
            f"{path}: expected field {name} to be real numbers of at most 64 bits, got "
            f"{values.dtype}; leave it out or write .npz."
        )
    if values.ndim > 2 or 0 in values.shape[1:]:
        raise FormatError(
            f"{path}: expected field {name} of shape (N,) or (N, C), got {values.shape}; "
            "leave it out or write .npz."
        )
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    if values.dtype == np.float16:
        return values.astype(np.float32)
    if name != "color" or values.dtype == np.uint8:
        return values
    if values.dtype != np.uint16:
        raise FormatError(
            f"{path}: expected field color of uint8 or uint16, got {values.dtype}; convert it."
        )
    return values if spelling.color_bits == 16 else narrow_colors(values)


def _spread(name: str, values: Values, spelling: Spelling) -> dict[str, Values]:
    """Cut a field into named columns."""
    word = (name if spelling.blanks else "_".join(name.split())) or "field"
    if values.shape[1:] in ((), (1,)):
        word = {"labels": "label", "curvature": spelling.curvature}.get(name, word)
        return {word: values.reshape(-1)}
    triples = {"normals": spelling.normals, "color": spelling.color}
    if name in triples and values.shape[1] == 3:
        return dict(zip(triples[name], values.T, strict=True))
    if spelling.vectors:
        return {word: values}
    return {f"{word}_{i}": column for i, column in enumerate(values.T)}


def check_exact(path: Path, columns: Columns) -> None:
    """Check that float64, and so text, holds all 64-bit integers exactly."""
    for name, column in columns.items():
        if _is_wide(column) and max(-int(column.min()), int(column.max())) >= LARGEST_WHOLE:
            raise FormatError(
                f"{path}: expected field {name} within 2^53, got 64-bit integers beyond; "
                "leave it out or write .npz."
            )


def _is_wide(values: Values) -> bool:
    """Whether values are integers of 64 bits, one of them at least."""
    return values.dtype.kind in "iu" and values.dtype.itemsize == 8 and values.size > 0


def narrow_integers(values: Values, codes: Collection[str]) -> Values:
    """Return 64-bit integers in the first of the types, as ``("i4", "u4")``, that holds them all.

    Values that none of them holds, and values that are no 64-bit integers, stay as they are.

    Example:
        >>> narrow_integers(np.array([0, 2**31]), ("i4", "u4")).dtype
        dtype('uint32')
    """
    if not _is_wide(values):
        return values
    low, high = int(values.min()), int(values.max())
    for code in codes:
        held = np.iinfo(code)
        if held.min <= low and high <= held.max:
            return values.astype(code)
    return values


def to_records(columns: Columns, rows: slice = slice(None)) -> Values:
    """Return rows of columns as one structured array, little-endian, shape ``(n,)``."""
    parts = {name: column[rows] for name, column in columns.items()}
    types = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in parts.items()]
    records = np.empty(len(next(iter(parts.values()))), types)
    for name, column in parts.items():
        records[name] = column
    return records


def write_records(path: Path, header: Sequence[str], columns: Columns) -> None:
    """Write the lines of a header, and columns as binary records."""
    num_rows = len(next(iter(columns.values())))
    with atomic_path(path) as beside, beside.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in header).encode())
        for rows in slices(num_rows, _RECORDS_AT_ONCE):
            to_records(columns, rows).tofile(stream)


def slices(num_rows: int, at_once: int) -> Iterator[slice]:
    """Cut so many rows into pieces of at most so many."""
    for start in range(0, num_rows, at_once):
        yield slice(start, min(start + at_once, num_rows))
