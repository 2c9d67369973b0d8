"""Mapping between file columns and cloud fields, with format-independent names.

Read as ``labels``: ``label``; as ``normals``: ``nx ny nz``, ``normal_x ...``, ``NormalX ...``,
``normal``; as ``color``: ``red green blue``, ``diffuse_red ...``, ``r g b``, ``rgb``, ``colors``,
``rf gf bf``; as ``intensity``: ``intensities``. Case and CloudCompare's prefix ``scalar_`` are
ignored. ``name_0``, ``name_1``, ... of one type become one field. Other names are unchanged.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg import scratch
from torchrg.errors import FormatError
from torchrg.io.tables import check_table, guess_column_names, warn_about_counters
from torchrg.structures import UNLABELED, Cloud
from torchrg.structures.colors import read_colors
from torchrg.structures.points import Array, are_integers

NamedColumns = Mapping[str, Array]
"""Per-point values by name, each of shape ``(N, ...)``."""
_WORDS = {
    "labels": "label labels",
    "normals": "normal normals",
    "color": "color colors rgb",
    "intensity": "intensity intensities",
    "curvature": "curvature",
}
FIELD_NAMES = {word: name for name, words in _WORDS.items() for word in words.split()}
"""Field names by lower-case column name."""
_TRIPLES = {
    "normals": "nx ny nz, normal_x normal_y normal_z, normalx normaly normalz",
    "color": "red green blue, diffuse_red diffuse_green diffuse_blue, r g b, rf gf bf",
}
"""Triples of lower-case column names by field name."""
SKIPPED = "_"
"""Name of a skipped column, as in PCD."""
_SHOWN_NAMES = 8
"""Maximum number of column names listed in a note."""
MAX_EXACT_INTEGER = 2**53
"""Limit below which float64, and thus text, has exact integers; it may itself be a rounded one."""


def assemble_cloud(
    path: Path,
    columns: NamedColumns,
    *,
    coordinates: str | None = None,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
    notes: tuple[str, ...] = (),
    integers: Collection[str] = (),
) -> Cloud:
    """Build a cloud from columns named as in the file.

    ``coordinates`` is the column that holds ``x``, ``y`` and ``z``, if these are not columns. It is
    not copied.
    ``integers`` are the columns stored as integers in the file, whatever their type here.
    """
    remaining = dict(columns)
    if coordinates is None:
        is_lower = all(axis in remaining for axis in "xyz")
        names = [axis if is_lower else axis.upper() for axis in "xyz"]
        if not all(name in remaining for name in names):
            present = ", ".join(map(ascii, remaining)) or "none"
            raise FormatError(f"{path}: expected fields x, y, z, got {present}; add or rename.")
        axes = [remaining.pop(name) for name in names]
        if any(axis.ndim != 1 for axis in axes):
            shapes = ", ".join(map(_row_shape, axes))
            raise FormatError(
                f"{path}: expected x, y, z of one number per point, got {shapes}; flatten them."
            )
        values = stack_columns(path, axes)
    else:
        values = remaining.pop(coordinates)
    points = convert_coordinates(path, values)
    sources = _field_columns(remaining)
    fields = {
        name: stack_columns(path, [remaining[column] for column in parts])
        for name, parts in sources.items()
    }
    if "labels" in fields:
        fields["labels"] = scratch.store(_convert_labels(path, fields["labels"]))
    if "normals" in fields:
        fields["normals"] = scratch.store(_convert_normals(path, fields["normals"]))
    if "color" in fields:
        color = fields["color"]
        if set(integers).issuperset(sources["color"]) and are_integers(color):
            color = color.astype(np.int64)
        color, more = read_colors(path, color)
        fields["color"] = scratch.store(color)
        notes += more
    return Cloud(points, fields, grid_shape, str(path), header or {}, notes)


def assemble_table(
    path: Path,
    table: Array,
    names: Sequence[str] | None,
    notes: tuple[str, ...] = (),
    integers: Collection[int] = (),
) -> Cloud:
    """Build a cloud from a table, shape ``(N, C)``, with column names or by the naming rule.

    ``integers`` are the indices of columns written without decimal point or exponent.
    """
    if names is None:
        check_table(path, table)
        is_pts = path.suffix.lower() == ".pts"
        names = guess_column_names(table, color_last=is_pts)
        warn_about_counters(path, table, names)
        if len(names) > 3:
            is_long = len(names) > _SHOWN_NAMES
            shown = [*names[: _SHOWN_NAMES - 1], "...", names[-1]] if is_long else names
            notes += (
                f"its columns have no names and are taken as {' '.join(shown)}; if they are "
                "others, name them with --columns",
            )
    columns = {name: table[:, i] for i, name in enumerate(names) if name != SKIPPED}
    return assemble_cloud(path, columns, notes=notes, integers=[names[i] for i in integers])


def convert_coordinates(path: Path, coordinates: Array) -> NDArray[np.floating]:
    """Return coordinates as float32 or float64 in native byte order.

    Integers of at most 16 bits and half precision become float32, which is exact; others float64.
    """
    check_coordinates(path, coordinates.shape, coordinates.dtype)
    dtype = coordinates.dtype
    single = dtype.itemsize <= (4 if dtype.kind == "f" else 2)
    return np.ascontiguousarray(coordinates, dtype=np.float32 if single else np.float64)


def check_coordinates(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Check that an array of this shape and type can hold coordinates."""
    if len(shape) != 2 or shape[1] != 3:
        fix = "transpose" if len(shape) == 2 and shape[0] == 3 else "reshape"
        raise FormatError(f"{path}: expected coordinates of shape (N, 3), got {shape}; {fix} them.")
    if dtype.kind not in "fiu":
        raise FormatError(f"{path}: expected real coordinates, got {dtype}; use float64.")
    if shape[0] == 0:
        raise FormatError(f"{path}: expected at least one point, got none; check its source.")


def backup_name(name: str) -> str:
    """Return the backup name of a cloud field that a result replaces."""
    return f"{'label' if name == 'labels' else name}_input"


def add_result_fields(
    fields: Mapping[str, Array], results: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the fields of a cloud together with the fields of a result.

    A field with the name of a result is renamed as :func:`backup_name` returns. If that name is
    taken, the cloud is itself a result; then the input field is kept and the result is replaced.
    """
    unchanged = {name: values for name, values in fields.items() if name not in results}
    backups = {backup_name(name): fields[name] for name in results if name in fields}
    return {**backups, **unchanged, **results}


def describe_renamed_fields(fields: Collection[str], results: Collection[str]) -> list[str]:
    """Return notes on fields that :func:`add_result_fields` renames or drops."""
    shown = {name: "label" if name == "labels" else name for name in results if name in fields}
    renamed = [name for name in shown if backup_name(name) not in fields]
    dropped = [name for name in shown if name not in renamed]
    notes = []
    if renamed:
        names = ", ".join(f"{shown[name]} as {backup_name(name)}" for name in renamed)
        notes.append(f"input fields are kept next to the result: {names}")
    if dropped:
        names = ", ".join(shown[name] for name in dropped)
        kept = ", ".join(map(backup_name, dropped))
        notes.append(f"its own {names} left out for the result's; {kept} stay")
    return notes


def check_names(path: Path, names: Sequence[str], num_columns: int) -> None:
    """Check column names: one per column, and no duplicates except ``_``."""
    read, shown = [name for name in names if name != SKIPPED], ",".join(names)
    if not {"x", "y", "z"} <= {name.lower() for name in read} or len(set(read)) != len(read):
        wrong = f"distinct column names that include x, y and z, got {shown}"
    elif len(names) != num_columns:
        wrong = f"names for {num_columns} columns, got {len(names)} ({shown})"
    else:
        return
    raise FormatError(f"{path}: expected {wrong}; use {SKIPPED} to skip a column.")


def _field_columns(columns: NamedColumns) -> dict[str, list[str]]:
    """Return the columns of each field; the first of two equal names wins.

    Triples and numbered columns are joined, the others renamed, by shape and type only.
    """
    single = [name for name in columns if columns[name].ndim == 1]
    by_plain_name = {name.lower().removeprefix("scalar_"): name for name in single}
    remaining, fields = dict(columns), dict[str, list[str]]()
    for target, triples in _TRIPLES.items():
        for parts in map(str.split, triples.split(",")):
            if target not in fields and all(column in by_plain_name for column in parts):
                fields[target] = [by_plain_name[column] for column in parts]
                for column in fields[target]:
                    del remaining[column]
    for name, members in _find_numbered(remaining).items():
        if name not in fields and name not in remaining:
            fields[name] = members
            for member in members:
                del remaining[member]
    for name, values in remaining.items():
        fields[_unique_field_name(name, values, fields)] = [name]
    return fields


def _unique_field_name(name: str, values: Array, existing: Collection[str]) -> str:
    """Return the field name of a column if its shape fits, changed if the name is taken."""
    plain = name.lower().removeprefix("scalar_")
    target = FIELD_NAMES.get(plain, name.removeprefix("scalar_") or name)
    shapes = {"normals": (3,), "color": (3,), "labels": ()}
    if target in shapes and values.shape[1:] != shapes[target]:
        target = name
    while target in existing:
        target = name = f"_{name}" if target == name else name
    return target


def _find_numbered(columns: NamedColumns) -> dict[str, list[str]]:
    """Find consecutive ``name_0``, ``name_1``, ... of single columns of one type."""
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


def stack_columns(path: Path, columns: list[Array]) -> Array:
    """Stack single columns, or copy one, in native byte order.

    A view would keep the file or the buffer of a parser.
    """
    if len(columns) == 1:
        return scratch.join(columns)
    try:
        dtype = np.result_type(*columns)
    except TypeError as error:
        kinds = ", ".join(str(column.dtype) for column in columns)
        raise FormatError(
            f"{path}: expected columns of one type to combine, got {kinds}; convert to numbers."
        ) from error
    stacked = scratch.empty((len(columns[0]), len(columns)), dtype)
    for i, column in enumerate(columns):
        stacked[:, i] = column
    return stacked


def _convert_labels(path: Path, labels: Array) -> NDArray[np.int64]:
    """Convert labels to int64, shape ``(N,)``; NaN means unlabeled, as in CloudCompare."""
    flat = labels.reshape(-1) if labels.shape[1:] == (1,) else labels
    if flat.ndim != 1 or flat.dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: expected labels to be one integer per point, got shape "
            f"{_row_shape(labels)} of {labels.dtype}; rename or remove that field."
        )
    if flat.dtype.kind == "f":
        flat = np.where(np.isnan(flat), flat.dtype.type(UNLABELED), flat)
    largest = float(np.abs(flat.astype(np.float64)).max(initial=0))
    if not are_integers(flat) or (flat.dtype.kind in "uf" and largest >= 2.0**63):
        raise FormatError(
            f"{path}: expected 64-bit integer labels, got fractions or larger; rename or drop them."
        )
    if flat.dtype.kind == "f" and largest >= MAX_EXACT_INTEGER:
        raise FormatError(
            f"{path}: expected labels within 2^53, because text and floating-point numbers round "
            f"larger ones, got {largest:.0f}; write them as integers, as in .npz."
        )
    return flat.astype(np.int64)


def _convert_normals(path: Path, normals: Array) -> NDArray[np.floating]:
    """Convert normals to float32 or float64, shape ``(N, 3)``."""
    if normals.shape[1:] != (3,) or normals.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected normals of shape (N, 3), got shape {_row_shape(normals)} "
            f"of {normals.dtype}; rename or remove that field."
        )
    return normals.astype(np.float64 if normals.dtype.itemsize > 4 else np.float32, copy=False)


def _row_shape(values: Array) -> str:
    """Format the shape of a field for a message, with N for the number of points."""
    return f"({', '.join(['N', *map(str, values.shape[1:])])})"
