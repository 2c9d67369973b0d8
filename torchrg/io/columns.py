"""Conversion of clouds to file columns."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from torchrg._parallel import split_rows
from torchrg.errors import FormatError
from torchrg.io.fields import MAX_EXACT_INTEGER, SKIPPED, NamedColumns, backup_name
from torchrg.io.files import atomic_path
from torchrg.structures import Cloud
from torchrg.structures.colors import narrow_colors, read_colors
from torchrg.structures.points import Array

_RECORDS_PER_CHUNK = 1 << 20
"""Number of records converted and written at a time, which bounds the memory."""
_MAX_NAME = 255
"""Maximum number of letters of a field name, as of a file name."""


class FieldNames(NamedTuple):
    """Names that a format uses for torchrg's fields.

    Attributes:
        normals: Names of the three components.
        color: Names of the three channels.
        curvature: Name of the curvature.
        color_bits: Bits per channel, 8 or 16; 16-bit colors are rounded to 8, never widened.
        vectors: Whether other multi-column fields stay one column of shape ``(N, C)``.
        blanks: Whether names may contain blanks; otherwise they become ``_``.
    """

    normals: tuple[str, str, str] = ("nx", "ny", "nz")
    color: tuple[str, str, str] = ("red", "green", "blue")
    curvature: str = "curvature"
    color_bits: int = 8
    vectors: bool = False
    blanks: bool = False


def flatten_cloud(path: Path, cloud: Cloud, field_names: FieldNames) -> dict[str, Array]:
    """Convert a cloud to named columns: ``x y z`` first, then its fields.

    Labels become int32 if they fit, colors uint8 (or uint16 if the format supports it), booleans
    uint8, and half precision float32. A multi-column field is split into ``name_0``, ``name_1`` and
    so on, unless the format has ``vectors``.
    """
    columns: dict[str, Array] = {axis: cloud.coordinates[:, i] for i, axis in enumerate("xyz")}
    for name, values in cloud.fields.items():
        if name == SKIPPED:
            raise FormatError(f"{path}: a field cannot be named {name!r}; rename it.")
        values = _to_storable(path, name, values, field_names)
        if name in ("labels", backup_name("labels")):
            values = narrow_integers(values, ("i4",))
        for column_name, column in _split_field(name, values, field_names).items():
            if column_name in columns:
                raise FormatError(f"{path}: duplicate field name {column_name!r}; rename one.")
            columns[column_name] = column
    return columns


def check_field(path: Path, name: str, values: Array, num_points: int) -> None:
    """Check that a field has a name that files can store, and one row per point."""
    if "\0" in name or len(name) > _MAX_NAME:
        raise FormatError(
            f"{path}: expected field names without NUL of at most {_MAX_NAME} letters, got "
            f"{name[:20]!r} of {len(name):,}; rename the field."
        )
    if values.shape[:1] != (num_points,):
        raise FormatError(
            f"{path}: expected field {name} of shape ({num_points}, ...), got {values.shape}; "
            "pass one row per point."
        )


def _to_storable(path: Path, name: str, values: Array, field_names: FieldNames) -> Array:
    """Convert a field to real numbers of a dtype that files can store."""
    if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8:
        raise FormatError(
            f"{path}: expected {name} of real numbers in 64 bits, got {values.dtype}; write .npz."
        )
    if values.ndim > 2 or 0 in values.shape[1:]:
        raise FormatError(
            f"{path}: expected {name} of shape (N,) or (N, C), got {values.shape}; write .npz."
        )
    if name == "color" and values.dtype.kind == "f":
        raise FormatError(f"{path}: expected uint8 or uint16 color, got {values.dtype}; cast it.")
    if name == "color" and values.shape[1:] == (3,):
        color, _ = read_colors(path, values)
        return color if field_names.color_bits == 16 else narrow_colors(color)
    if values.dtype.kind == "b":
        return values.astype(np.uint8)
    return values.astype(np.float32) if values.dtype == np.float16 else values


def _split_field(name: str, values: Array, field_names: FieldNames) -> dict[str, Array]:
    """Split a field into named columns."""
    word = (name if field_names.blanks else "_".join(name.split())) or "field"
    if values.shape[1:] in ((), (1,)):
        word = {"labels": "label", "curvature": field_names.curvature}.get(name, word)
        return {word: values.reshape(-1)}
    triples = {"normals": field_names.normals, "color": field_names.color}
    if name in triples and values.shape[1] == 3:
        return dict(zip(triples[name], values.T, strict=True))
    if field_names.vectors:
        return {word: values}
    return {f"{word}_{i}": column for i, column in enumerate(values.T)}


def check_exact(path: Path, columns: NamedColumns) -> None:
    """Check that float64, and thus text, represents all 64-bit integers exactly."""
    for name, column in columns.items():
        is_integer = column.dtype.kind in "iu"
        if is_integer and max(-int(column.min()), int(column.max())) >= MAX_EXACT_INTEGER:
            raise FormatError(
                f"{path}: {name} has integers above 2^53, which would be rounded; write .npz."
            )


def narrow_integers(values: Array, codes: Collection[str]) -> Array:
    """Convert 64-bit integers to the first type of ``codes`` that holds them all.

    Values that fit none of these types, and values of other dtypes, are unchanged.
    """
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 8:
        return values
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    for code in codes:
        limits = np.iinfo(code)
        if limits.min <= low and high <= limits.max:
            return values.astype(code)
    return values


def to_records(columns: NamedColumns, rows: slice = slice(None)) -> Array:
    """Return rows of columns as one little-endian structured array, shape ``(n,)``."""
    parts = {name: column[rows] for name, column in columns.items()}
    types = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in parts.items()]
    records = np.empty(len(next(iter(parts.values()))), types)
    for name, column in parts.items():
        records[name] = column
    return records


def write_records(path: Path, header: Sequence[str], columns: NamedColumns) -> None:
    """Write header lines and columns as binary records."""
    num_rows = len(next(iter(columns.values())))
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in header).encode())
        for rows in split_rows(num_rows, _RECORDS_PER_CHUNK):
            to_records(columns, rows).tofile(stream)


def map_records(stream: BinaryIO, dtype: np.dtype[Any], count: int) -> Array:
    """Map records at the position of a stream, which moves to their end, shape ``(count,)``.

    Unlike a buffer, pages of the file take no memory that the system cannot reclaim.
    """
    start = stream.tell()
    # No records cannot be mapped.
    records = np.memmap(stream, dtype, "c", start, count) if count else np.empty(0, dtype)
    stream.seek(start + count * dtype.itemsize)
    return np.asarray(records)
