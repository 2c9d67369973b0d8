"""From the columns of a file to a cloud and back: one name for what every format calls otherwise.

Read as ``labels``: ``label``; as ``normals``: ``nx ny nz``, ``normal_x ...``, ``NormalX ...``,
``normal``; as ``color``: ``red green blue``, ``diffuse_red ...``, ``r g b``, ``rgb``, ``colors``,
``rf gf bf``; as ``intensity``: ``intensities``. Case does not matter, nor CloudCompare's prefix
``scalar_``.
``name_0``, ``name_1``, ... of one type become one field ``name`` of as many columns. Everything
else keeps its name.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.colors import BYTE, WORD, read_colors
from torchrg.structures import UNLABELED, Cloud

Values = NDArray[Any]
"""An array of any type, as files hold them."""
Columns = Mapping[str, Values]
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
    ("rf", "gf", "bf"): "color",
}
"""torchrg's names by those of three columns, in lower case."""
_COLOR = ("red", "green", "blue")
_GUESSED_WIDTHS = (6, 7)
"""Columns of a table without names whose meaning the values tell."""
LEFT_OUT = "_"
"""Name of a column that is not read, as in PCD."""
_MAX_COLUMNS = 32
"""Columns of a few rows without names. More are taken for points in columns; programs write up to a
dozen values of a point without names."""
_SHOWN_NAMES = 8
"""Names of columns in a note; more are not shown one by one."""
_GUESSED_ROWS = 1000
"""Rows from which the meaning of such columns is guessed."""
COLUMNS_RULE = (
    "Without names, columns are x y z, and a fourth alone is intensity. Of six, the last three are "
    "a unit normal, or a color of integers from 0 to 255, where the first 1,000 rows fit; else a "
    "color of integers from 0 to 65535, where all rows fit. Of seven, the same is asked of the "
    "last three and of the three before the last; if one of both fits, it is taken, with intensity "
    "before a color; in .pts, where colors come last, the last three alone are asked. Any other "
    "column is column_4, column_5 and so on."
)
"""How the columns of text and of bare arrays are named where nothing names them, for people."""
_UNIT_TOLERANCE = 2e-3
"""Most that the square of a unit vector's length differs from 1: 1e-3 of the length."""
LARGEST_WHOLE = 2**53
"""float64, and so text, tells whole numbers below from all others; this may have been another."""


def assemble_cloud(
    path: Path,
    columns: Columns,
    *,
    coordinates: str | None = None,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
    integers: Collection[str] = (),
) -> Cloud:
    """Build a cloud from columns by the file's own names.

    ``coordinates`` is the column that holds ``x``, ``y`` and ``z``, where these are no columns.
    ``integers`` are the columns that the file writes as integers, whatever their type is here.
    """
    remaining = dict(columns)
    if coordinates is None:
        exact = all(axis in remaining for axis in "xyz")
        names = [axis if exact else axis.upper() for axis in "xyz"]
        if not all(name in remaining for name in names):
            present = ", ".join(map(ascii, remaining)) or "none"
            raise FormatError(
                f"{path}: expected fields x, y, z, got {present}; rename or add them."
            )
        axes = [remaining.pop(name) for name in names]
        if any(axis.ndim != 1 for axis in axes):
            shapes = ", ".join(map(_row_shape, axes))
            raise FormatError(
                f"{path}: expected one number a point in each of x, y, z, got {shapes}; flatten "
                "or rename them."
            )
        places = _stacked(path, axes)
    else:
        places = remaining.pop(coordinates)
    points = checked_coordinates(path, places)
    sources = _sources_of(remaining)
    fields = {
        name: _stacked(path, [remaining[column] for column in parts])
        for name, parts in sources.items()
    }
    for name, check in (("labels", _labels), ("normals", _normals)):
        if name in fields:
            fields[name] = check(path, fields[name])
    if "color" in fields:
        color = fields["color"]
        _check_triples(path, "color", color)
        if set(integers).issuperset(sources["color"]) and are_whole(color):
            color = color.astype(np.int64)
        fields["color"], more = read_colors(path, color)
        notes += more
    return Cloud(points, fields, grid_shape, str(path), header or {}, notes)


def assemble_table(
    path: Path,
    table: Values,
    names: Sequence[str] | None,
    notes: tuple[str, ...] = (),
    integers: Collection[int] = (),
) -> Cloud:
    """Build a cloud from a table, shape ``(N, C)``, with names of its columns or by the rule.

    ``integers`` are the columns that the file writes without a decimal point or an exponent.
    """
    if names is None:
        _check_table(path, table)
        is_pts = path.suffix.lower() == ".pts"
        names = names_by_rule(table, color_last=is_pts)
        if len(names) > 3:
            many = len(names) > _SHOWN_NAMES
            shown = [*names[: _SHOWN_NAMES - 1], "...", names[-1]] if many else names
            notes += (
                f"its columns have no names and are taken as {' '.join(shown)}; if they are "
                "others, name them with --columns",
            )
    columns = {name: table[:, i] for i, name in enumerate(names) if name != LEFT_OUT}
    return assemble_cloud(path, columns, notes=notes, integers=[names[i] for i in integers])


def checked_coordinates(path: Path, coordinates: Values) -> NDArray[np.floating]:
    """Return coordinates as float32 or float64 in native byte order.

    Whole numbers of at most 16 bits and half precision become float32, which holds them exactly;
    other numbers become float64.
    """
    check_coordinates(path, coordinates.shape, coordinates.dtype)
    dtype = coordinates.dtype
    single = dtype.itemsize <= (4 if dtype.kind == "f" else 2)
    return np.ascontiguousarray(coordinates, dtype=np.float32 if single else np.float64)


def check_coordinates(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Check that an array of this shape and type can be coordinates."""
    if len(shape) != 2 or shape[1] != 3:
        repair = "transpose" if len(shape) == 2 and shape[0] == 3 else "reshape"
        raise FormatError(
            f"{path}: expected coordinates of shape (N, 3), got {shape}; {repair} them."
        )
    if dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected real numbers as coordinates, got {dtype}; convert them to float64."
        )
    if shape[0] == 0:
        raise FormatError(
            f"{path}: expected at least one point, got none; check where it comes from."
        )


def name_aside(name: str) -> str:
    """Return the name under which a cloud's own field is kept when a result takes its name.

    Example:
        >>> name_aside("labels"), name_aside("normals")
        ('label_input', 'normals_input')
    """
    return f"{'label' if name == 'labels' else name}_input"


def put_results(fields: Mapping[str, Values], results: Mapping[str, Values]) -> dict[str, Values]:
    """Return the fields of a cloud with those of a result beside them.

    What a result has the name of is kept as :func:`name_aside` says, unless there is such a field
    already: then the cloud is a result itself, and its input's own field stays.

    Example:
        >>> first = put_results({"labels": np.array([7])}, {"labels": np.array([0])})
        >>> again = put_results(first, {"labels": np.array([1])})
        >>> {name: values.tolist() for name, values in again.items()}
        {'label_input': [7], 'labels': [1]}
    """
    others = {name: values for name, values in fields.items() if name not in results}
    aside = {name_aside(name): fields[name] for name in results if name in fields}
    return {**aside, **others, **results}


def notes_on_results(fields: Collection[str], results: Collection[str]) -> list[str]:
    """Return what to tell people of fields that :func:`put_results` renames or leaves out."""
    shown = {name: "label" if name == "labels" else name for name in results if name in fields}
    moved = [name for name in shown if name_aside(name) not in fields]
    lost = [name for name in shown if name not in moved]
    notes = []
    if moved:
        names = ", ".join(f"{shown[name]} as {name_aside(name)}" for name in moved)
        notes.append(f"its own fields are kept beside the result's: {names}")
    if lost:
        names, stay = ", ".join(shown[name] for name in lost), ", ".join(map(name_aside, lost))
        notes.append(f"its own {names} left out for the result's; {stay} stay")
    return notes


def names_by_rule(table: Values, *, color_last: bool = False) -> list[str]:
    """Name the columns of a table by :data:`COLUMNS_RULE`, shape ``(N, C)``.

    Of seven columns of small whole numbers, programs mean ``intensity red green blue`` or ``red
    green blue label``; which of these is not told by values, so both keep their numbers.

    Example:
        >>> names_by_rule(np.array([[0.5, 0.5, 0.5, -1640.0, 255.0, 128.0, 0.0]]))
        ['x', 'y', 'z', 'intensity', 'red', 'green', 'blue']
    """
    num_columns = table.shape[1]
    names = ["x", "y", "z", *(f"column_{i}" for i in range(4, num_columns + 1))]
    if num_columns == 4:
        return [*names[:3], "intensity"]
    if num_columns not in _GUESSED_WIDTHS:
        return names
    starts = range(num_columns - 3 if color_last else 3, num_columns - 2)
    threes = {i: table[:, i : i + 3] for i in starts}
    first = {i: _triple_by_values(three[:_GUESSED_ROWS]) for i, three in threes.items()}
    triples = {i: triple for i, triple in first.items() if triple}
    if not triples:
        triples = {i: _COLOR for i, three in threes.items() if _is_wide_color(three)}
    if len(triples) == 1:
        ((start, triple),) = triples.items()
        names[start : start + 3] = triple
        if start > 3 and "red" in triple:
            names[3] = "intensity"
    return names


def _triple_by_values(three: Values) -> tuple[str, str, str] | None:
    """Return the names of three columns, shape ``(n, 3)``, that can be a normal or a color."""
    squares = np.square(three.astype(np.float64, copy=False)).sum(axis=1)
    # Unit vectors may be zero or not numbers where there is none.
    lengths = squares[np.isfinite(squares) & (squares != 0)]
    if len(lengths) and (np.abs(lengths - 1) < _UNIT_TOLERANCE).all():
        return ("nx", "ny", "nz")
    is_color = three.size == 0 or (three.min() >= 0 and three.max() <= BYTE and are_whole(three))
    return _COLOR if is_color else None


def _is_wide_color(three: Values) -> bool:
    """Whether three columns can be a color of 16 bits, each of which is more than 8 hold."""
    in_range = three.min() >= 0 and three.max() <= WORD and three.max(axis=0).min() > BYTE
    return bool(in_range) and are_whole(three)


def check_names(path: Path, names: Sequence[str], num_columns: int) -> None:
    """Check names that are given for columns: one for each, and each once but for ``_``."""
    read, shown = [name for name in names if name != LEFT_OUT], ",".join(names)
    if not {"x", "y", "z"} <= {name.lower() for name in read} or len(set(read)) != len(read):
        wrong = f"names of columns that differ, x, y and z among them, got {shown}"
    elif len(names) != num_columns:
        wrong = f"names for {num_columns} columns, got {len(names)} ({shown})"
    else:
        return
    raise FormatError(f"{path}: expected {wrong}; {LEFT_OUT} leaves a column out.")


def _check_table(path: Path, table: Values) -> None:
    """Refuse tables without names that are no points: a pose, or points across."""
    num_rows, num_columns = table.shape
    if table.shape == (4, 4) and table[3].tolist() == [0, 0, 0, 1]:
        raise FormatError(
            f"{path}: expected points, got a matrix of 4 x 4, a pose; name the file of the cloud."
        )
    if 3 <= num_rows <= max(_GUESSED_WIDTHS) and num_columns > _MAX_COLUMNS:
        raise FormatError(
            f"{path}: expected a row for each point, got {num_rows} rows of {num_columns:,} "
            "numbers; transpose them, or name the columns with --columns."
        )


def are_whole(values: Values) -> bool:
    """Whether all values are finite whole numbers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def _sources_of(columns: Columns) -> dict[str, list[str]]:
    """Return the columns that each field is made of; the first of two equal names wins it.

    Triples and numbered columns are joined, the others renamed. Shapes and types decide, no values.
    """
    plain = {_plain(name): name for name in columns if columns[name].ndim == 1}
    remaining, fields = dict(columns), dict[str, list[str]]()
    for parts, target in _TRIPLES.items():
        if target not in fields and all(column in plain for column in parts):
            fields[target] = [plain[column] for column in parts]
            for column in fields[target]:
                del remaining[column]
    for name, members in _numbered(remaining).items():
        if name not in fields and name not in remaining:
            fields[name] = members
            for member in members:
                del remaining[member]
    for name, values in remaining.items():
        fields[_free_name(name, values, fields)] = [name]
    return fields


def _free_name(name: str, values: Values, taken: Collection[str]) -> str:
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
        name: [by_number[i] for i in range(len(by_number))]
        for name, by_number in numbers.items()
        if len(by_number) > 1
        and max(by_number) == len(by_number) - 1
        and len({columns[member].dtype for member in by_number.values()}) == 1
    }


def _stacked(path: Path, columns: list[Values]) -> Values:
    """Put single columns side by side, or return one as it is, in native byte order."""
    if len(columns) == 1:
        return np.ascontiguousarray(columns[0], dtype=columns[0].dtype.newbyteorder("="))
    try:
        dtype = np.result_type(*columns)
    except TypeError as error:
        kinds = ", ".join(str(column.dtype) for column in columns)
        raise FormatError(
            f"{path}: expected columns of one kind side by side, got {kinds}; convert them to "
            "numbers."
        ) from error
    stacked = np.empty((len(columns[0]), len(columns)), dtype)
    for i, column in enumerate(columns):
        stacked[:, i] = column
    return stacked


def _labels(path: Path, labels: Values) -> NDArray[np.int64]:
    """Return labels as int64, shape ``(N,)``; not-a-number means no label, as in CloudCompare."""
    flat = labels.reshape(-1) if labels.shape[1:] == (1,) else labels
    if flat.ndim != 1 or flat.dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: expected one whole number a point as labels, got shape "
            f"{_row_shape(labels)} of {labels.dtype}; rename or remove that field."
        )
    if flat.dtype.kind == "f":
        flat = np.where(np.isnan(flat), flat.dtype.type(UNLABELED), flat)
    largest = float(np.abs(flat.astype(np.float64)).max(initial=0))
    if not are_whole(flat) or (flat.dtype.kind in "uf" and largest >= 2.0**63):
        raise FormatError(
            f"{path}: expected labels to be whole numbers of 64 bits, got others; rename or remove "
            "that field."
        )
    if flat.dtype.kind == "f" and largest >= LARGEST_WHOLE:
        raise FormatError(
            f"{path}: expected labels within 2^53, as text and floating-point numbers do not tell "
            f"others apart, got {largest:.0f}; write them as integers, as in .npz."
        )
    return flat.astype(np.int64)


def _normals(path: Path, normals: Values) -> NDArray[np.floating]:
    """Return normals as float32 or float64, shape ``(N, 3)``."""
    _check_triples(path, "normals", normals)
    return normals.astype(np.float64 if normals.dtype.itemsize > 4 else np.float32, copy=False)


def _check_triples(path: Path, name: str, values: Values) -> None:
    """Check that a field is three real numbers a point."""
    if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected {name} to be three numbers a point, got shape {_row_shape(values)} "
            f"of {values.dtype}; rename or remove that field."
        )


def _row_shape(values: Values) -> str:
    """Return the shape of a field for a message, without the number of points."""
    return f"({', '.join(['N', *map(str, values.shape[1:])])})"
