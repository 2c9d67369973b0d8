"""From the columns of a file to a cloud: one name for what every format calls otherwise.

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
from torchrg.structures import UNLABELED, Cloud


def are_whole(values: NDArray[Any]) -> bool:
    """Whether all values are finite whole numbers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def _reach(values: NDArray[Any]) -> float:
    """Return the largest magnitude, 0 for none."""
    return float(np.abs(values.astype(np.float64)).max(initial=0))


def are_unit(rows: NDArray[Any]) -> bool:
    """Whether rows are unit vectors up to 1e-3, or zero or not numbers where there is none."""
    squares = np.square(rows.astype(np.float64)).sum(axis=1)
    rest = squares[np.isfinite(squares) & (squares != 0)]
    return len(rest) > 0 and bool((np.abs(rest - 1) < 2e-3).all())


def as_labels(path: Path, labels: NDArray[Any]) -> NDArray[np.int64]:
    """Return labels as int64, shape ``(N,)``; not-a-number means no label, as in CloudCompare."""
    flat = labels.reshape(-1) if labels.shape[1:] == (1,) else labels
    if flat.ndim != 1 or flat.dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: expected one whole number a point as labels, got shape {labels.shape} "
            f"of {labels.dtype}; rename or remove that field."
        )
    if flat.dtype.kind == "f":
        flat = np.where(np.isnan(flat), flat.dtype.type(UNLABELED), flat)
    if not are_whole(flat) or (flat.dtype.kind in "uf" and _reach(flat) >= 2.0**63):
        raise FormatError(
            f"{path}: expected labels to be whole numbers of 64 bits; rename or remove that field."
        )
    return flat.astype(np.int64)


def as_normals(path: Path, normals: NDArray[Any]) -> NDArray[np.floating]:
    """Return normals as float32 or float64, shape ``(N, 3)``."""
    if normals.ndim != 2 or normals.shape[1] != 3 or normals.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected normals to be three numbers a point, got shape {normals.shape} "
            f"of {normals.dtype}; rename or remove that field."
        )
    return normals.astype(np.float64 if normals.dtype.itemsize > 4 else np.float32, copy=False)


def as_color(path: Path, color: NDArray[Any]) -> NDArray[Any]:
    """Return colours as uint8 0..255, shape ``(N, 3)``; uint16 where 8 bits do not hold them.

    Floating-point colours are 0..1 if none is larger, otherwise 0..255.
    """
    if color.ndim != 2 or color.shape[1] != 3 or color.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected color to be three numbers a point, got shape {color.shape} "
            f"of {color.dtype}; rename or remove that field."
        )
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8)
    values = np.nan_to_num(color, copy=True) if color.dtype.kind == "f" else color
    low, high = values.min(), values.max()
    if low < 0 or high > (255 if color.dtype.kind == "f" else 65535):
        raise FormatError(
            f"{path}: expected color in 0..255, got {low} to {high}; rename or remove that field."
        )
    if color.dtype.kind == "f":
        scaled: NDArray[Any] = np.rint(values * 255 if high <= 1 else values)
        return scaled.astype(np.uint8)
    if high <= 255:
        return values.astype(np.uint8)
    # 65535 / 255 = 257: what eight bits become in sixteen, and back without loss.
    quotient, remainder = np.divmod(values.astype(np.uint16), np.uint16(257))
    return values.astype(np.uint16) if remainder.any() else quotient.astype(np.uint8)


Columns = Mapping[str, NDArray[Any]]

ALIASES = {
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
TRIPLES = {
    ("nx", "ny", "nz"): "normals",
    ("normal_x", "normal_y", "normal_z"): "normals",
    ("normalx", "normaly", "normalz"): "normals",
    ("red", "green", "blue"): "color",
    ("diffuse_red", "diffuse_green", "diffuse_blue"): "color",
    ("r", "g", "b"): "color",
}


def assemble_cloud(
    path: Path,
    columns: Columns,
    *,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
) -> Cloud:
    """Build a cloud from columns that include ``x``, ``y`` and ``z``.

    Args:
        path: The file, for messages.
        columns: Values of each point by the file's own names, each of shape ``(N, ...)``.
        grid_shape: ``(height, width)`` of an organised cloud.
        header: What the file says about the whole cloud, see :class:`Cloud`.

    Returns:
        The cloud; its fields have torchrg's names.

    Raises:
        FormatError: If there are no coordinates or no points, or values make no sense.
    """
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
    """Build a cloud from coordinates and further columns; see :func:`assemble_cloud`."""
    return Cloud(
        coordinates=checked_coordinates(path, coordinates),
        fields=_renamed(path, columns),
        grid_shape=grid_shape,
        source=str(path),
        header=header or {},
    )


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
    """Name the columns of a table that has no names.

    Three columns are x y z. A fourth alone is ``intensity``. Six are x y z and a colour (whole
    numbers 0 to 255) or a unit normal; seven are the same and a whole number, ``label``. Columns
    that fit none of this are kept as ``column_4``, ``column_5`` and so on.

    Args:
        values: The table, shape ``(N, C)`` with at least three columns.

    Returns:
        The columns by name.

    Example:
        >>> list(name_columns(np.array([[0.5, 0.5, 0.5, 255.0, 128.0, 0.0]])))
        ['x', 'y', 'z', 'red', 'green', 'blue']
    """
    names = ["x", "y", "z", *(f"column_{i}" for i in range(4, values.shape[1] + 1))]
    if values.shape[1] == 4:
        names[3] = "intensity"
    if values.shape[1] in (6, 7):
        three = values[:, 3:6]
        if are_unit(three):
            names[3:6] = ["nx", "ny", "nz"]
        elif are_whole(three) and three.min() >= 0 and three.max() <= 255:
            names[3:6] = ["red", "green", "blue"]
        if values.shape[1] == 7 and names[3] != "column_4" and are_whole(values[:, 6]):
            names[6] = "label"
    return {name: values[:, i] for i, name in enumerate(names)}


def _renamed(path: Path, columns: Columns) -> dict[str, NDArray[Any]]:
    """Give columns torchrg's names and types."""
    fields = _grouped(columns)
    for name, check in (("labels", as_labels), ("normals", as_normals), ("color", as_color)):
        if name in fields:
            fields[name] = check(path, fields[name])
    return fields


def _grouped(columns: Columns) -> dict[str, NDArray[Any]]:
    """Join triples and numbered columns, and rename; the first of two equal names wins it."""
    plain = {_plain(name): name for name in columns if columns[name].ndim == 1}
    rest, fields = dict(columns), {}
    for parts, target in TRIPLES.items():
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
    target = ALIASES.get(_plain(name), name.removeprefix("scalar_") or name)
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
