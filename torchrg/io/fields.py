"""From the columns of a file to a cloud and back: one name for what every format calls otherwise.

Read as ``labels``: ``label``; as ``normals``: ``nx ny nz``, ``normal_x ...``, ``NormalX ...``,
``normal``; as ``color``: ``red green blue``, ``diffuse_red ...``, ``r g b``, ``rgb``, ``colors``;
as ``intensity``: ``intensities``. Case does not matter, nor CloudCompare's prefix ``scalar_``.
``name_0``, ``name_1``, ... of one type become one field ``name`` of as many columns. Everything
else keeps its name.
"""

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.files import atomic_path
from torchrg.structures import UNLABELED, Cloud

Columns = Mapping[str, NDArray[Any]]
"""Values of each point by name, each of shape ``(N, ...)``."""

_ALIASES = {
    "label": "labels",
    "labels": "labels",
    "normal": "normals",
    "normals": "normals",
    "color": "color",
    "colors": "color",
    "rgb": "color",
    "intensity": "intensity",
    "intensities": "intensity",
    "curvature": "curvature",
}
"""torchrg's names by those of files in lower case."""
_TRIPLES = {
    ("nx", "ny", "nz"): "normals",
    ("normal_x", "normal_y", "normal_z"): "normals",
    ("normalx", "normaly", "normalz"): "normals",
    ("red", "green", "blue"): "color",
    ("diffuse_red", "diffuse_green", "diffuse_blue"): "color",
    ("r", "g", "b"): "color",
}
"""torchrg's names by those of three columns, in lower case."""
_UNIT_TOLERANCE = 2e-3
"""Most that the square of a unit vector's length differs from 1: 1e-3 of the length."""
WIDEN = 257
"""65535 / 255: what eight bits become in sixteen, and back without loss."""


def assemble_cloud(
    path: Path,
    columns: Columns,
    *,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
) -> Cloud:
    """Build a cloud from columns by the file's own names, ``x``, ``y`` and ``z`` among them."""
    rest = dict(columns)
    exact = all(axis in rest for axis in "xyz")
    names = [axis if exact else axis.upper() for axis in "xyz"]
    if not all(name in rest for name in names):
        found = ", ".join(map(ascii, rest)) or "none"
        raise FormatError(f"{path}: expected fields x, y, z, got {found}; rename or add them.")
    axes = [rest.pop(name) for name in names]
    if any(axis.ndim != 1 for axis in axes):
        raise FormatError(f"{path}: expected one number a point in each of x, y, z.")
    return cloud_of(path, _stacked(axes), rest, grid_shape=grid_shape, header=header)


def cloud_of(
    path: Path,
    coordinates: NDArray[Any],
    columns: Columns,
    *,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
) -> Cloud:
    """Build a cloud from coordinates and further columns by the file's own names."""
    coordinates = checked_coordinates(path, coordinates)
    fields = _grouped(columns)
    for name, check in (("labels", _labels), ("normals", _normals), ("color", _color)):
        if name in fields:
            fields[name] = check(path, fields[name])
    return Cloud(coordinates, fields, grid_shape, source=str(path), header=header or {})


def checked_coordinates(path: Path, coordinates: NDArray[Any]) -> NDArray[np.floating]:
    """Return coordinates as float32 or float64 in native byte order.

    Whole numbers of at most 16 bits and half precision become float32, which holds them exactly;
    other numbers become float64.
    """
    dtype = coordinates.dtype
    if coordinates.ndim != 2 or coordinates.shape[1] != 3:
        raise FormatError(
            f"{path}: expected coordinates of shape (N, 3), got {coordinates.shape}; reshape them."
        )
    if dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected real numbers as coordinates, got {dtype}; convert them to float64."
        )
    if len(coordinates) == 0:
        raise FormatError(
            f"{path}: expected at least one point, got none; check where it comes from."
        )
    single = dtype.itemsize <= (4 if dtype.kind == "f" else 2)
    return np.ascontiguousarray(coordinates, dtype=np.float32 if single else np.float64)


def name_columns(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Name the columns of a table without names, shape ``(N, C)`` with at least three columns.

    Three columns are x y z. A fourth alone is ``intensity``. Six are x y z and a colour (whole
    numbers 0 to 255) or a unit normal; seven are the same and a whole number, ``label``. Columns
    that fit none of this are kept as ``column_4``, ``column_5`` and so on.

    Example:
        >>> list(name_columns(np.array([[0.5, 0.5, 0.5, 255.0, 128.0, 0.0]])))
        ['x', 'y', 'z', 'red', 'green', 'blue']
    """
    names = ["x", "y", "z", *(f"column_{i}" for i in range(4, values.shape[1] + 1))]
    if values.shape[1] == 4:
        names[3] = "intensity"
    if values.shape[1] in (6, 7):
        three = values[:, 3:6]
        if _are_unit(three):
            names[3:6] = ["nx", "ny", "nz"]
        elif are_whole(three) and three.min() >= 0 and three.max() <= 255:
            names[3:6] = ["red", "green", "blue"]
        if values.shape[1] == 7 and names[3] != "column_4" and are_whole(values[:, 6]):
            names[6] = "label"
    return {name: values[:, i] for i, name in enumerate(names)}


def are_whole(values: NDArray[Any]) -> bool:
    """Whether all values are finite whole numbers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def _are_unit(rows: NDArray[Any]) -> bool:
    """Whether rows are unit vectors, or zero or not numbers where there is none."""
    squares = np.square(rows.astype(np.float64)).sum(axis=1)
    rest = squares[np.isfinite(squares) & (squares != 0)]
    return len(rest) > 0 and bool((np.abs(rest - 1) < _UNIT_TOLERANCE).all())


def _grouped(columns: Columns) -> dict[str, NDArray[Any]]:
    """Join triples and numbered columns, and rename; the first of two equal names wins it."""
    plain = {_plain(name): name for name in columns if columns[name].ndim == 1}
    rest, fields = dict(columns), {}
    for parts, target in _TRIPLES.items():
        if target not in fields and all(part in plain for part in parts):
            fields[target] = _stacked([rest.pop(plain[part]) for part in parts])
    for name, members in _numbered(rest).items():
        if name not in fields and name not in rest:
            fields[name] = _stacked([rest.pop(member) for member in members])
    for name, values in rest.items():
        fields[_free_name(name, values, fields)] = np.ascontiguousarray(
            values, dtype=values.dtype.newbyteorder("=")
        )
    return fields


def _free_name(name: str, values: NDArray[Any], taken: Columns) -> str:
    """Return torchrg's name for a column if its shape fits and no other has it yet."""
    target = _ALIASES.get(_plain(name), name.removeprefix("scalar_") or name)
    shapes = {"normals": (3,), "color": (3,), "labels": ()}
    if target in shapes and values.shape[1:] != shapes[target]:
        target = name
    while target in taken:
        target = name = f"_{name}" if target == name else name
    return target


def _plain(name: str) -> str:
    """Return a name in lower case without CloudCompare's prefix."""
    return name.lower().removeprefix("scalar_")


def _numbered(columns: Columns) -> dict[str, list[str]]:
    """Find ``name_0``, ``name_1``, ... without a gap, single columns of one type."""
    numbers: dict[str, dict[int, str]] = {}
    for name, values in columns.items():
        match = re.fullmatch(r"(.+)_(0|[1-9][0-9]{0,5})", name)
        if match and values.ndim == 1:
            numbers.setdefault(match[1], {})[int(match[2])] = name
    return {
        name: [found[i] for i in range(len(found))]
        for name, found in numbers.items()
        if len(found) > 1
        and max(found) == len(found) - 1
        and len({columns[member].dtype for member in found.values()}) == 1
    }


def _stacked(columns: list[NDArray[Any]]) -> NDArray[Any]:
    """Put single columns side by side, in native byte order."""
    dtype = np.result_type(*columns)
    stacked = np.empty((len(columns[0]), len(columns)), dtype)
    for i, column in enumerate(columns):
        stacked[:, i] = column
    return stacked


def _labels(path: Path, labels: NDArray[Any]) -> NDArray[np.int64]:
    """Return labels as int64, shape ``(N,)``; not-a-number means no label, as in CloudCompare."""
    flat = labels.reshape(-1) if labels.shape[1:] == (1,) else labels
    if flat.ndim != 1 or flat.dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: expected one whole number a point as labels, got shape {labels.shape} "
            f"of {labels.dtype}; rename or remove that field."
        )
    if flat.dtype.kind == "f":
        flat = np.where(np.isnan(flat), flat.dtype.type(UNLABELED), flat)
    largest = float(np.abs(flat.astype(np.float64)).max(initial=0))
    if not are_whole(flat) or (flat.dtype.kind in "uf" and largest >= 2.0**63):
        raise FormatError(
            f"{path}: expected labels to be whole numbers of 64 bits; rename or remove that field."
        )
    return flat.astype(np.int64)


def _normals(path: Path, normals: NDArray[Any]) -> NDArray[np.floating]:
    """Return normals as float32 or float64, shape ``(N, 3)``."""
    _check_triples(path, "normals", normals)
    return normals.astype(np.float64 if normals.dtype.itemsize > 4 else np.float32, copy=False)


def _color(path: Path, color: NDArray[Any]) -> NDArray[Any]:
    """Return colours as uint8 0..255, shape ``(N, 3)``; uint16 where 8 bits do not hold them.

    Floating-point colours are 0..1 if none is larger, otherwise 0..255.
    """
    _check_triples(path, "color", color)
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8)
    is_float = color.dtype.kind == "f"
    values = np.nan_to_num(color, copy=True) if is_float else color
    low, high = values.min(), values.max()
    if low < 0 or high > (255 if is_float else 65535):
        raise FormatError(
            f"{path}: expected color in 0..255, got {low} to {high}; rename or remove that field."
        )
    if is_float:
        values = np.rint(values * 255 if high <= 1 else values)
    if is_float or high <= 255:
        return values.astype(np.uint8)
    quotient, remainder = np.divmod(values.astype(np.uint16), np.uint16(WIDEN))
    return values.astype(np.uint16) if remainder.any() else quotient.astype(np.uint8)


def _check_triples(path: Path, name: str, values: NDArray[Any]) -> None:
    """Check that a field is three real numbers a point."""
    if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected {name} to be three numbers a point, got shape {values.shape} "
            f"of {values.dtype}; rename or remove that field."
        )


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
