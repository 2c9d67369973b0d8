"""From a cloud to the columns of a file, by the format's own names and types."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import WIDEN, Columns
from torchrg.io.files import atomic_path
from torchrg.structures import Cloud


class Spelling(NamedTuple):
    """How a format spells torchrg's names.

    Attributes:
        normals: Names of the three components.
        color: Names of the three channels.
        curvature: Name of the curvature.
        color_bits: Width of a channel, 8 or 16; colours of 16 bits are rounded to 8, not widened.
        vectors: Whether other fields of several columns stay one, shape ``(N, C)``.
    """

    normals: tuple[str, str, str] = ("nx", "ny", "nz")
    color: tuple[str, str, str] = ("red", "green", "blue")
    curvature: str = "curvature"
    color_bits: int = 8
    vectors: bool = False


def flatten_cloud(path: Path, cloud: Cloud, spelling: Spelling) -> dict[str, NDArray[Any]]:
    """Spread a cloud over columns by the format's names: ``x y z`` first, then its fields.

    Labels are int32 where they fit, colours uint8 (or uint16 if the format holds it), truth values
    uint8, half precision float32. A field of several columns is ``name_0``, ``name_1`` and so on,
    unless the format has ``vectors``.
    """
    columns: dict[str, NDArray[Any]] = {
        axis: cloud.coordinates[:, i] for i, axis in enumerate("xyz")
    }
    for name, values in cloud.fields.items():
        check_length(path, name, values, len(cloud))
        for column_name, column in _spread(name, _storable(path, name, values, spelling), spelling):
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
    if name == "labels":
        return narrow_integers(values, ("i4",))
    if name != "color" or values.dtype == np.uint8:
        return values
    if values.dtype != np.uint16:
        raise FormatError(
            f"{path}: expected field color of uint8 or uint16, got {values.dtype}; convert it."
        )
    return values if spelling.color_bits == 16 else np.rint(values / WIDEN).astype(np.uint8)


def _spread(name: str, values: NDArray[Any], spelling: Spelling) -> list[tuple[str, NDArray[Any]]]:
    """Cut a field into named columns."""
    word = "_".join(name.split()) or "field"
    if values.shape[1:] in ((), (1,)):
        single = {"labels": "label", "curvature": spelling.curvature}.get(name, word)
        return [(single, values.reshape(-1))]
    triples = {"normals": spelling.normals, "color": spelling.color}
    if name in triples and values.shape[1] == 3:
        names: tuple[str, ...] = triples[name]
    elif spelling.vectors:
        return [(word, values)]
    else:
        names = tuple(f"{word}_{i}" for i in range(values.shape[1]))
    return [(column_name, values[:, i]) for i, column_name in enumerate(names)]


def narrow_integers(values: NDArray[Any], codes: Collection[str]) -> NDArray[Any]:
    """Return 64-bit integers in the first of some types, as ``("i4", "u4")``, that holds them all.

    What none of them holds, and what is no 64-bit integers, stays as it is.
    """
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 8 or values.size == 0:
        return values
    low, high = int(values.min()), int(values.max())
    for code in codes:
        limits = np.iinfo(code)
        if limits.min <= low and high <= limits.max:
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


def write_records(path: Path, lines: list[str], columns: Columns) -> None:
    """Write a header of lines and the columns as binary records."""
    records = to_records(columns)
    with atomic_path(path) as beside, beside.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())
        records.tofile(stream)
