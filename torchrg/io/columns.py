"""From a cloud to the columns of a file: the other way round of :mod:`torchrg.io.fields`."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
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
    """Spread a cloud over single columns: ``x y z`` first, then its fields.

    Args:
        path: The file to write, for messages.
        cloud: The cloud.
        spelling: The format's names.

    Returns:
        Columns of shape ``(N,)`` by name. Labels are int32 where they fit, colours uint8, a field
        of several columns is ``name_0``, ``name_1`` and so on, unless the format has ``vectors``.

    Raises:
        FormatError: If a field is not numbers, has too many axes or another length, or two columns
            would have one name.
    """
    columns: dict[str, NDArray[Any]] = {
        axis: cloud.coordinates[:, i] for i, axis in enumerate("xyz")
    }
    for name, values in check_fields(path, cloud, color_bits=spelling.color_bits).items():
        for column_name, column in _spread(name, values, spelling):
            if column_name in columns:
                raise FormatError(
                    f"{path}: expected fields of different names, got {column_name!r} twice; "
                    "rename one."
                )
            columns[column_name] = column
    return columns


def check_fields(path: Path, cloud: Cloud, *, color_bits: int = 8) -> dict[str, NDArray[Any]]:
    """Return the fields of a cloud as real numbers that files hold.

    Args:
        path: The file to write, for messages.
        cloud: The cloud.
        color_bits: Width of a channel of ``color`` that the format holds.

    Returns:
        Fields by name: truth values as uint8, half precision as float32, labels as int32 where
        they fit, ``color`` as uint8, or uint16 if it is that and the format holds it.

    Raises:
        FormatError: If a field is not real numbers, or has more axes or another length than fits.
    """
    checked = {}
    for name, values in cloud.fields.items():
        check_length(path, name, values, len(cloud))
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
            values = values.astype(np.uint8)
        elif values.dtype == np.float16:
            values = values.astype(np.float32)
        elif name == "labels":
            values = narrow_integers(values, ("i4",))
        elif name == "color":
            values = _channels(path, values, color_bits)
        checked[name] = values
    return checked


def check_length(path: Path, name: str, values: NDArray[Any], num_points: int) -> None:
    """Check that a field has a value for each point."""
    if values.shape[:1] != (num_points,):
        raise FormatError(
            f"{path}: expected field {name} of shape ({num_points}, ...), got {values.shape}; "
            "give one row a point."
        )


def narrow_integers(values: NDArray[Any], codes: Collection[str]) -> NDArray[Any]:
    """Return 64-bit integers in the first of some types that holds them all.

    Args:
        values: Numbers of any type.
        codes: Types to try, such as ``("i4", "u4")``.

    Returns:
        Values of the first fitting type; the input if none fits or it is not 64-bit integers.
    """
    if values.dtype.kind not in "iu" or values.dtype.itemsize < 8 or values.size == 0:
        return values
    low, high = int(values.min()), int(values.max())
    for code in codes:
        limits = np.iinfo(code)
        if limits.min <= low and high <= limits.max:
            return values.astype(code)
    return values


def _channels(path: Path, color: NDArray[Any], bits: int) -> NDArray[Any]:
    """Return colours as uint8, or as uint16 where the format holds that."""
    if color.dtype == np.uint16:
        return color if bits == 16 else np.rint(color / 257).astype(np.uint8)
    if color.dtype != np.uint8:
        raise FormatError(
            f"{path}: expected field color of uint8 or uint16, got {color.dtype}; convert it."
        )
    return color


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
