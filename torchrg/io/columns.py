"""From a cloud to the columns of a file, by the format's own names and types."""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import LARGEST_WHOLE, LEFT_OUT, WIDEN, Columns, name_aside
from torchrg.io.files import atomic_path
from torchrg.io.stream import CloudStream
from torchrg.structures import Cloud

Limits = tuple[int, int]
"""Least and largest of whole numbers."""
_LABELS_ASIDE = name_aside("labels")


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


def flatten_stream(path: Path, stream: CloudStream, spelling: Spelling) -> Iterator[Columns]:
    """Spread the chunks of a cloud over columns, which have the same types in all of them."""
    limits = wide_limits(path, stream, spelling)
    for chunk in stream:
        yield flatten_cloud(path, chunk, spelling, limits)


def flatten_cloud(
    path: Path, cloud: Cloud, spelling: Spelling, limits: Mapping[str, Limits] | None = None
) -> dict[str, NDArray[Any]]:
    """Spread a cloud over columns by the format's names: ``x y z`` first, then its fields.

    Labels are int32 where the limits of the whole cloud say that they fit, colours uint8 (or uint16
    if the format holds it), truth values uint8, half precision float32. A field of several columns
    is ``name_0``, ``name_1`` and so on, unless the format has ``vectors``.
    """
    columns: dict[str, NDArray[Any]] = {
        axis: cloud.coordinates[:, i] for i, axis in enumerate("xyz")
    }
    for name, values in cloud.fields.items():
        if name == LEFT_OUT:
            raise FormatError(f"{path}: expected names of fields, got {name!r}; rename it.")
        values = _storable(path, name, values, spelling)
        if name in ("labels", _LABELS_ASIDE):
            limit = (limits or {}).get("label" if name == "labels" else name)
            values = narrow_integers(values, ("i4",), limit)
        for column_name, column in _spread(name, values, spelling):
            if column_name in columns:
                raise FormatError(
                    f"{path}: expected fields of different names, got {column_name!r} twice; "
                    "rename one."
                )
            columns[column_name] = column
    return columns


def check_length(path: Path, name: str, values: NDArray[Any], num_points: int) -> None:
    """Check that a field has a value for each point."""
    if values.shape[:1] != (num_points,):
        raise FormatError(
            f"{path}: expected field {name} of shape ({num_points}, ...), got {values.shape}; "
            "give one row a point."
        )


def _storable(path: Path, name: str, values: NDArray[Any], spelling: Spelling) -> NDArray[Any]:
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
    return values if spelling.color_bits == 16 else np.rint(values / WIDEN).astype(np.uint8)


def _spread(name: str, values: NDArray[Any], spelling: Spelling) -> list[tuple[str, NDArray[Any]]]:
    """Cut a field into named columns."""
    names = spell(name, values.shape[1:], spelling)
    parts = [values.reshape(-1)] if values.shape[1:] == (1,) else [values]
    if len(names) > 1:
        parts = [values[:, i] for i in range(len(names))]
    return list(zip(names, parts, strict=True))


def spell(name: str, row_shape: tuple[int, ...], spelling: Spelling) -> tuple[str, ...]:
    """Return the names of the columns of a field of which rows have a shape."""
    word = (name if spelling.blanks else "_".join(name.split())) or "field"
    if row_shape in ((), (1,)):
        return ({"labels": "label", "curvature": spelling.curvature}.get(name, word),)
    triples = {"normals": spelling.normals, "color": spelling.color}
    if name in triples and row_shape == (3,):
        return triples[name]
    return (word,) if spelling.vectors else tuple(f"{word}_{i}" for i in range(row_shape[0]))


def wide_limits(path: Path, stream: CloudStream, spelling: Spelling) -> dict[str, Limits]:
    """Return the limits of all columns of 64-bit integers of a cloud, by a pass over its chunks."""
    limits: dict[str, Limits] = {}
    for chunk in stream:
        wide = {name: values for name, values in chunk.fields.items() if _is_wide(values.dtype)}
        if not wide:
            break
        merge_limits(limits, flatten_cloud(path, replace(chunk, fields=wide), spelling))
    return limits


def exact_limits(path: Path, stream: CloudStream, spelling: Spelling) -> dict[str, Limits]:
    """Return the limits of :func:`wide_limits`, all of which float64 holds exactly."""
    limits = wide_limits(path, stream, spelling)
    for name, limit in limits.items():
        if max(map(abs, limit)) >= LARGEST_WHOLE:
            raise FormatError(
                f"{path}: expected field {name} within 2^53, got 64-bit integers beyond; "
                "leave it out or write .npz."
            )
    return limits


def merge_limits(limits: dict[str, Limits], columns: Columns) -> None:
    """Widen limits by those of the columns of 64-bit integers of a chunk."""
    for name, column in columns.items():
        if _is_wide(column.dtype) and column.size:
            low, high = int(column.min()), int(column.max())
            known_low, known_high = limits.get(name, (low, high))
            limits[name] = (min(low, known_low), max(high, known_high))


def _is_wide(dtype: np.dtype[Any]) -> bool:
    """Whether values are integers of 64 bits."""
    return dtype.kind in "iu" and dtype.itemsize == 8


def narrow_integers(
    values: NDArray[Any], codes: Collection[str], limits: Limits | None
) -> NDArray[Any]:
    """Return 64-bit integers in the first of some types, as ``("i4", "u4")``, that holds them all.

    What none of them holds, what has no limits, and what is no 64-bit integers, stays as it is.
    """
    if not _is_wide(values.dtype) or limits is None:
        return values
    for code in codes:
        held = np.iinfo(code)
        if held.min <= limits[0] and limits[1] <= held.max:
            return values.astype(code)
    return values


def to_records(columns: Columns) -> NDArray[Any]:
    """Return columns as one structured array, little-endian, shape ``(N,)``."""
    length = len(next(iter(columns.values())))
    parts = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()]
    records = np.empty(length, parts)
    for name, column in columns.items():
        records[name] = column
    return records


def write_records(
    path: Path, header: Callable[[Columns], list[str]], chunks: Iterator[Columns]
) -> None:
    """Write lines that follow from the first columns, and all columns as binary records."""
    with atomic_path(path) as beside, beside.open("wb") as stream:
        for number, columns in enumerate(chunks):
            if number == 0:
                stream.write("".join(f"{line}\n" for line in header(columns)).encode())
            to_records(columns).tofile(stream)
