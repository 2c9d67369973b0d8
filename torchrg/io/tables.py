"""Tables of numbers without column names: what the columns mean, and which tables are no cloud."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError, warn
from torchrg.structures.colors import BYTE, WORD
from torchrg.structures.points import are_integers

Table = NDArray[Any]
"""Numbers of shape ``(N, C)``."""
_NORMAL, _COLOR = ("nx", "ny", "nz"), ("red", "green", "blue")
"""Names of three columns whose meaning their values show."""
_MAX_COLUMNS = 15
"""Maximum number of unnamed columns. Programs write up to a dozen values per point; more columns
mean features, a transposed table, or cameras such as LLFF's 17 numbers."""
_GUESSED_ROWS = 1000
"""Rows from which the meaning of unnamed columns is guessed."""
COLUMNS_RULE = (
    "Without names, columns are x y z; a fourth column alone is intensity. Three consecutive "
    "columns after these are a unit normal, or a color of integers from 0 to 255, if the first "
    "1,000 rows fit; else a color of integers from 0 to 65535, if all rows fit. If several "
    "overlapping triples fit, those without a constant column count; if these overlap, none is "
    "used. A column between z and a color is intensity. In .pts files, in which colors come last, "
    "only the last three are tested. All other columns are named column_4, column_5 and so on."
)
"""Naming rule for unnamed columns of text files and plain arrays, for help texts."""
_UNIT_TOLERANCE = 2e-3
"""Maximum deviation of a unit vector's squared norm from 1; 1e-3 of the norm."""
_MIN_COUNTED = 10
"""Minimum number of rows of a column that counts; fewer coordinates may be sorted by chance."""
_NAME_THEM = "name the columns with --columns"


def check_table(path: Path, table: Table) -> None:
    """Raise FormatError if an unnamed table is no point cloud: cameras, poses, or transposed."""
    num_rows, num_columns = table.shape
    if num_columns > _MAX_COLUMNS:
        raise FormatError(
            f"{path}: expected one row per point, got {num_rows:,} rows of {num_columns:,} "
            f"numbers; transpose them, or {_NAME_THEM} (up to {_MAX_COLUMNS} need no names)."
        )
    if what := _describe_cameras(table[:_GUESSED_ROWS].astype(np.float64, copy=False)):
        raise FormatError(f"{path}: expected points, got {what}; pass the point cloud file.")


def _describe_cameras(table: NDArray[np.float64]) -> str:
    """Return what a table of cameras contains; an empty string for any other table."""
    shape, last = table.shape, table[-1].tolist()
    if shape == (4, 4) and last == [0, 0, 0, 1]:
        return "a 4 x 4 pose matrix"
    is_camera = shape in ((3, 3), (3, 4)) and last[:3] == [0, 0, 1] and table[1, 0] == 0
    if is_camera and (table[:, :3] != np.eye(3)).any():
        return f"a 3 x {shape[1]} camera matrix"
    if shape == (3, 4) and _are_rotations(table[None, :, :3]):
        return "a 3 x 4 pose matrix"
    rotations = [table[:, i : i + 12].reshape(-1, 3, 4)[..., :3] for i in range(shape[1] - 11)]
    rotations += [table[:, i : i + 9].reshape(-1, 3, 3) for i in range(shape[1] - 11)]
    if any(map(_are_rotations, rotations)):
        return "poses (a rotation matrix in each row)"
    # Normals next to a column of zeros, and classes coded as 0 and 1, have unit length, too. Only
    # time stamps distinguish the quaternions of a camera that does not turn.
    is_timed = shape[0] > 1 and shape[1] > 7 and bool((np.diff(table[:, 0]) > 0).all())
    fours = [table[:, i : i + 4] for i in range(shape[1] - 3) if shape[1] > 6]
    for four in filter(_are_units, fours):
        is_other = are_integers(four) or _are_units(four[:, :3]) or _are_units(four[:, 1:])
        if is_timed or not is_other:
            return "poses (a unit quaternion in each row)"
    return ""


def _are_rotations(matrices: NDArray[np.float64]) -> bool:
    """Whether all matrices ``(N, 3, 3)`` are rotations."""
    products = matrices @ matrices.transpose(0, 2, 1)
    return bool((np.abs(products - np.eye(3)) < _UNIT_TOLERANCE).all())


def _are_units(vectors: Table) -> bool:
    """Whether all vectors ``(n, C)`` have length 1; missing ones may be zero or NaN."""
    squares = np.square(vectors.astype(np.float64, copy=False)).sum(axis=1)
    lengths = squares[np.isfinite(squares) & (squares != 0)]
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < _UNIT_TOLERANCE).all())


def guess_column_names(table: Table, *, color_last: bool = False) -> list[str]:
    """Name the columns of a table by :data:`COLUMNS_RULE`, shape ``(N, C)``.

    Columns of small integers may mean ``intensity red green blue`` or ``red green blue label``. The
    values cannot distinguish the two unless one is constant, so they stay numbered.
    """
    num_columns = table.shape[1]
    names = ["x", "y", "z", *(f"column_{i}" for i in range(4, num_columns + 1))]
    if num_columns == 4:
        return [*names[:3], "intensity"]
    starts = range(max(num_columns - 3, 3) if color_last else 3, num_columns - 2)
    threes = {i: table[:, i : i + 3] for i in starts}
    first = {i: _guess_triple(three[:_GUESSED_ROWS]) for i, three in threes.items()}
    triples = {i: triple for i, triple in first.items() if triple}
    if _COLOR not in triples.values():
        # A 16-bit color has every channel above the 8-bit maximum.
        wide = {i: three for i, three in threes.items() if three.max(axis=0).min() > BYTE}
        triples |= {i: _COLOR for i, three in wide.items() if _is_color(three, WORD)}
    varied = [i for i in triples if (threes[i] != threes[i][:1]).any(axis=0).all()]
    for start in varied or triples:
        is_alone = all(abs(other - start) >= 3 or other == start for other in varied or triples)
        if is_alone and triples[start][0] not in names:
            names[start : start + 3] = triples[start]
            if start == 4 and triples[start] == _COLOR:
                names[3] = "intensity"
    return names


def _guess_triple(three: Table) -> tuple[str, str, str] | None:
    """Return names for three columns, shape ``(n, 3)``, if they can be a normal or a color."""
    if _are_units(three):
        return _NORMAL
    return _COLOR if _is_color(three, BYTE) else None


def _is_color(three: Table, white: int) -> bool:
    """Whether three columns are integers from 0 to ``white``."""
    return bool(three.min() >= 0 and three.max() <= white) and are_integers(three)


def warn_about_counters(path: Path, table: Table, names: Sequence[str]) -> None:
    """Warn if one of the first three columns only counts up, as an index or time does.

    The other columns without a known meaning are then enough for coordinates, and do not count.
    """
    if len(table) < _MIN_COUNTED or len(names) < 4:
        return
    unknown = [i for i, name in enumerate(names) if name not in (*_NORMAL, *_COLOR)]
    counting = [i for i in unknown if _only_rises(table[:, i])]
    whole = [i for i in counting if are_integers(table[:, i])]
    others = [i for i in unknown if i not in counting]
    if not whole:
        others = [i for i in others if not are_integers(table[:, i])]
    wrong = [str(i + 1) for i in whole or counting if i < 3]
    if 0 < len(wrong) < 3 <= len(others):
        warn(
            f"{path}: values only count up in column {' and '.join(wrong)}, as those of an index "
            f"or of time; if these are no coordinates, {_NAME_THEM}."
        )


def _only_rises(column: Table) -> bool:
    """Whether a column never falls, except to its start; integers rise by at most one."""
    steps = np.diff(column)
    rises = (steps >= 0) & (steps <= (1 if are_integers(column) else np.inf))
    return bool(steps.any() and (rises | (column[1:] == column.min())).all())
