"""From the columns of a file to a cloud: one name for what every format calls otherwise.

Read as ``labels``: ``label``; as ``normals``: ``nx ny nz``, ``normal_x ...``, ``NormalX ...``,
``normal``; as ``color``: ``red green blue``, ``diffuse_red ...``, ``r g b``, ``rgb``, ``colors``;
as ``intensity``: ``intensities``. Case does not matter, nor CloudCompare's prefix ``scalar_``.
``name_0``, ``name_1``, ... of one type become one field ``name`` of as many columns. Everything
else keeps its name.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.field_types import are_unit, are_whole, as_color, as_labels, as_normals
from torchrg.structures import Cloud

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
