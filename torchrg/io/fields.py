"""From the columns of a file to a cloud and back: one name for what every format calls otherwise.

Read as ``labels``: ``label``; as ``normals``: ``nx ny nz``, ``normal_x ...``, ``NormalX ...``,
``normal``; as ``color``: ``red green blue``, ``diffuse_red ...``, ``r g b``, ``rgb``, ``colors``;
as ``intensity``: ``intensities``. Case does not matter, nor CloudCompare's prefix ``scalar_``.
``name_0``, ``name_1``, ... of one type become one field ``name`` of as many columns. Everything
else keeps its name.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
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
_MAY_BE_COLOR = re.compile(
    r"(scalar_)?((diffuse_)?(red|green|blue)|[rgb]|rgb|colors?)(_[0-9]+|_value)*|column_[456]",
    re.IGNORECASE,
)
"""Names of columns that may turn out to be colours, ``column_4`` to ``column_6`` without names."""
_GUESSED_WIDTHS = (6, 7)
"""Columns of a table without names whose meaning the values tell."""
_UNIT_TOLERANCE = 2e-3
"""Most that the square of a unit vector's length differs from 1: 1e-3 of the length."""
WIDEN = 257
"""65535 / 255: what eight bits become in sixteen, and back without loss."""


def _row_text(values: NDArray[Any]) -> str:
    """Return the shape of a field for a message, which is the same for a chunk and the whole."""
    return f"({', '.join(['N', *map(str, values.shape[1:])])})"


class Span(NamedTuple):
    """What the values of a column are between: all that the type of a colour depends on.

    Attributes:
        low: Least value; of floating-point columns the least once not-a-number is zero.
        high: Largest value, likewise.
        fine: Whether some value is no multiple of :data:`WIDEN`, so that 8 bits do not hold it.
    """

    low: Any
    high: Any
    fine: bool

    @classmethod
    def of(cls, values: NDArray[Any]) -> "Span":
        """Return the span of some values, of which there may be none."""
        if values.size == 0:
            return cls(0, 0, False)
        if values.dtype.kind == "f":
            values = np.nan_to_num(values)
            return cls(values.min(), values.max(), False)
        low, high = values.min(), values.max()
        return cls(low, high, bool(high > 0 if high <= 255 else (values % WIDEN).any()))

    def __or__(self, other: "Span") -> "Span":
        """Return the span of the values of both."""
        fine = self.fine or other.fine
        return Span(min(self.low, other.low), max(self.high, other.high), fine)


def color_spans(columns: Columns) -> dict[str, Span]:
    """Return the spans of all columns by the file's names that may be colours, or parts of them."""
    return {
        name: Span.of(values)
        for name, values in columns.items()
        if _MAY_BE_COLOR.fullmatch(name) and values.dtype.kind in "biuf"
    }


def assemble_cloud(
    path: Path,
    columns: Columns,
    *,
    coordinates: str | None = None,
    spans: Mapping[str, Span] | None = None,
    grid_shape: tuple[int, int] | None = None,
    header: Mapping[str, Any] | None = None,
) -> Cloud:
    """Build a cloud from columns by the file's own names.

    ``x``, ``y`` and ``z`` are among them unless ``coordinates`` names the column that holds all
    three. If the columns are a chunk of a file, ``spans`` are those of the whole file.
    """
    rest = dict(columns)
    if coordinates is None:
        exact = all(axis in rest for axis in "xyz")
        names = [axis if exact else axis.upper() for axis in "xyz"]
        if not all(name in rest for name in names):
            found = ", ".join(map(ascii, rest)) or "none"
            raise FormatError(f"{path}: expected fields x, y, z, got {found}; rename or add them.")
        axes = [rest.pop(name) for name in names]
        if any(axis.ndim != 1 for axis in axes):
            raise FormatError(f"{path}: expected one number a point in each of x, y, z.")
        places = _stacked(axes)
    else:
        places = rest.pop(coordinates)
    points = checked_coordinates(path, places)
    sources = _sources(rest)
    fields = {name: _joined([rest[part] for part in parts]) for name, parts in sources.items()}
    if "labels" in fields:
        fields["labels"] = _labels(path, fields["labels"])
    if "normals" in fields:
        fields["normals"] = _normals(path, fields["normals"])
    if "color" in fields:
        if spans is None and fields["color"].dtype != np.uint8:
            spans = color_spans({part: columns[part] for part in sources["color"]})
        known = (spans or {}).get
        fields["color"] = _color(path, fields["color"], [*map(known, sources["color"])])
    return Cloud(points, fields, grid_shape, source=str(path), header=header or {})


def checked_coordinates(path: Path, coordinates: NDArray[Any]) -> NDArray[np.floating]:
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
        raise FormatError(
            f"{path}: expected coordinates of shape (N, 3), got {shape}; reshape them."
        )
    if dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected real numbers as coordinates, got {dtype}; convert them to float64."
        )
    if shape[0] == 0:
        raise FormatError(
            f"{path}: expected at least one point, got none; check where it comes from."
        )


class Naming(NamedTuple):
    """Names that depend on the values of all points, and which columns are kept.

    Attributes:
        facts: What a chunk of columns shows.
        names: Columns by the names they get, from the columns of the file and the facts that any
            of the chunks showed.
    """

    facts: Callable[[Columns], set[str]]
    names: Callable[[Collection[str], Collection[str]], dict[str, str]]


def number_columns(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of a table without names, shape ``(N, C)`` with at least three columns.

    The first three are ``x y z``, a fourth alone is ``intensity``, others are ``column_4``,
    ``column_5`` and so on; where there are six or seven, :func:`name_numbered` knows better.
    """
    names = ["x", "y", "z", *(f"column_{i}" for i in range(4, values.shape[1] + 1))]
    if len(names) == 4:
        names[3] = "intensity"
    return {name: values[:, i] for i, name in enumerate(names)}


def naming_of(num_columns: int) -> Naming | None:
    """Return how a table without names, of so many columns, gets better ones."""
    return Naming(numbered_facts, name_numbered) if num_columns in _GUESSED_WIDTHS else None


def name_numbered(columns: Collection[str], facts: Collection[str]) -> dict[str, str]:
    """Name the six or seven columns of a table of which :func:`numbered_facts` are known.

    Three are x y z, the next three a colour (whole numbers 0 to 255) or a unit normal, and a
    seventh of whole numbers beside them is ``label``. What fits none of this keeps its name.

    Example:
        >>> columns = number_columns(np.array([[0.5, 0.5, 0.5, 255.0, 128.0, 0.0]]))
        >>> list(name_numbered(columns, numbered_facts(columns)))
        ['x', 'y', 'z', 'red', 'green', 'blue']
    """
    old, names = list(columns), list(columns)
    if "has lengths" in facts and "not unit" not in facts:
        names[3:6] = ["nx", "ny", "nz"]
    elif "not bytes" not in facts:
        names[3:6] = ["red", "green", "blue"]
    if len(names) == 7 and names[3] != "column_4" and "no label" not in facts:
        names[6] = "label"
    return dict(zip(names, old, strict=True))


def numbered_facts(columns: Columns) -> set[str]:
    """Return what the columns of a table without names show that the further ones are not."""
    values = list(columns.values())
    three = np.stack(values[3:6], axis=1)
    squares = np.square(three.astype(np.float64, copy=False)).sum(axis=1)
    # Unit vectors may be zero or not numbers where there is none.
    lengths = squares[np.isfinite(squares) & (squares != 0)]
    facts = {"has lengths"} if len(lengths) else set()
    if (np.abs(lengths - 1) >= _UNIT_TOLERANCE).any():
        facts.add("not unit")
    if three.size and not (three.min() >= 0 and three.max() <= 255 and are_whole(three)):
        facts.add("not bytes")
    if len(columns) == 7 and not are_whole(values[6]):
        facts.add("no label")
    return facts


def are_whole(values: NDArray[Any]) -> bool:
    """Whether all values are finite whole numbers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def _sources(columns: Columns) -> dict[str, list[str]]:
    """Return the columns that each field is made of; the first of two equal names wins it.

    Triples and numbered columns are joined, the others renamed. Shapes and types decide, no values.
    """
    plain = {_plain(name): name for name in columns if columns[name].ndim == 1}
    rest, fields = dict(columns), dict[str, list[str]]()
    for parts, target in _TRIPLES.items():
        if target not in fields and all(part in plain for part in parts):
            fields[target] = [plain[part] for part in parts]
            for part in fields[target]:
                del rest[part]
    for name, members in _numbered(rest).items():
        if name not in fields and name not in rest:
            fields[name] = members
            for member in members:
                del rest[member]
    for name, values in rest.items():
        fields[_free_name(name, values, fields)] = [name]
    return fields


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """Return several single columns as one field, or one column as it is, in native byte order."""
    if len(parts) > 1:
        return _stacked(parts)
    return np.ascontiguousarray(parts[0], dtype=parts[0].dtype.newbyteorder("="))


def _free_name(name: str, values: NDArray[Any], taken: Collection[str]) -> str:
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
            f"{path}: expected one whole number a point as labels, got shape {_row_text(labels)} "
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


def _color(path: Path, color: NDArray[Any], spans: Iterable[Span | None]) -> NDArray[Any]:
    """Return colours as uint8 0..255, shape ``(N, 3)``; uint16 where 8 bits do not hold them.

    Floating-point colours are 0..1 if none is larger, otherwise 0..255. The spans are those of its
    parts over the whole file.
    """
    _check_triples(path, "color", color)
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8)
    low, high, fine = reduce(or_, (span for span in spans if span is not None))
    is_float = color.dtype.kind == "f"
    if low < 0 or high > (255 if is_float else 65535):
        raise FormatError(
            f"{path}: expected color in 0..255, got {low} to {high}; rename or remove that field."
        )
    if is_float:
        known = np.nan_to_num(color)
        rounded: NDArray[Any] = np.rint(known * 255 if high <= 1 else known)
        return rounded.astype(np.uint8)
    if high <= 255:
        return color.astype(np.uint8)
    if fine:
        return color.astype(np.uint16)
    narrow: NDArray[Any] = color // WIDEN
    return narrow.astype(np.uint8)


def _check_triples(path: Path, name: str, values: NDArray[Any]) -> None:
    """Check that a field is three real numbers a point."""
    if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected {name} to be three numbers a point, got shape {_row_text(values)} "
            f"of {values.dtype}; rename or remove that field."
        )
