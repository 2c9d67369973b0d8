"""Plane tables in files: ``.npz`` arrays, JSON and CSV.

:func:`describe_planes` creates the JSON form, from which the CSV and DXF forms are derived.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.io.outlines import straighten_rings
from torchrg.linalg.precision import machine_epsilon, smallest_normal
from torchrg.structures import PLANE_KINDS, PlaneAdjacency, Planes
from torchrg.structures.planes import PLANE_COLUMNS
from torchrg.structures.points import Array

__all__ = [
    "CSV_COLUMNS",
    "TABLE_SUFFIXES",
    "describe_planes",
    "encode_csv",
    "planes_from_arrays",
    "planes_to_arrays",
    "tabulate_planes",
]
__dir__ = __all__.copy

Arrays = dict[str, Array]
"""Arrays of a plane table by their names in ``.npz``."""
Json = dict[str, Any]
"""JSON-compatible values by name."""
CSV_COLUMNS = (
    "id", "kind", "object", "normal", "offset", "centroid", "area", "count", "rms", "dip_deg",
    "dip_direction_deg", "curved", "outline",
)  # fmt: skip
"""Columns of CSV files and data frames, empty if unknown. Directions and positions have three
columns, such as ``normal_x``; a polygon is a WKT ``POLYGON Z``."""
TABLE_SUFFIXES = (".csv", ".json", ".dxf")
"""File extensions of plane tables."""
_STOREY_HEIGHTS = 2.0, 6.0
"""Range of the height of the tallest plane, in meters: the walls of rooms and halls."""
_DECIMALS = {"normal": 12, "axes": 12, "dip_deg": 5, "dip_direction_deg": 5}
"""Decimals of numbers that are no lengths. Offsets at UTM coordinates need exact normals."""
_MIN_ERROR = 1e-5
"""Minimum error of positions, as a fraction of the longest plane, for points without noise."""
_NUM_ERRORS = 3.0
"""Number of standard errors of its dip below which a plane has no dip direction."""


def planes_to_arrays(planes: Planes, origin: NDArray[np.float64]) -> Arrays:
    """Convert a table to ``.npz`` arrays by name; missing columns are omitted.

    Args:
        planes: The table.
        origin: Origin of its coordinates in file coordinates, shape ``(3,)``. Positions and offsets
            are shifted by it, in float64.

    Returns:
        ``plane_normal`` and so on, with M rows; ``plane_kind`` as text; ``adjacency_pairs``,
        ``adjacency_boundary_length`` and ``adjacency_dihedral_deg``; polygons as ``outline_points``
        (all rings), ``outline_ring_sizes`` (lengths) and ``outline_ring_planes`` (plane IDs).
    """

    def moved(positions: Tensor) -> NDArray[np.float64]:
        return positions.numpy(force=True).astype(np.float64) + origin

    arrays: Arrays = {
        f"plane_{name}": getattr(planes, name).numpy(force=True) for name in PLANE_COLUMNS
    }
    offset = arrays["plane_offset"].astype(np.float64)
    arrays["plane_offset"] = offset + arrays["plane_normal"] @ origin
    arrays |= {f"plane_{name}": moved(getattr(planes, name)) for name in ("centroid", "center")}
    if planes.kind is not None:
        arrays["plane_kind"] = np.array(PLANE_KINDS)[planes.kind.numpy(force=True)]
    if planes.object is not None:
        arrays["plane_object"] = planes.object.numpy(force=True)
    if planes.adjacency is not None:
        for name, values in planes.adjacency._asdict().items():
            arrays[f"adjacency_{name}"] = values.numpy(force=True)
    if planes.outline is not None:
        rings = [(plane, ring) for plane, outline in enumerate(planes.outline) for ring in outline]
        arrays["outline_points"] = moved(torch.cat([planes.center[:0], *(r for _, r in rings)]))
        arrays["outline_ring_sizes"] = np.array([len(r) for _, r in rings], dtype=np.int64)
        arrays["outline_ring_planes"] = np.array([plane for plane, _ in rings], dtype=np.int64)
    return arrays


def planes_from_arrays(
    arrays: Mapping[str, Array], origin: NDArray[np.float64], dtype: torch.dtype
) -> Planes:
    """Convert the arrays of :func:`planes_to_arrays` to a table with numbers of ``dtype``.

    Raises:
        LookupError: If an array is missing, or a plane ID or class in it is out of range.
        ValueError: If an array has another shape or type.
    """

    def read(name: str, dtype: str, shape: tuple[int, ...]) -> Array:
        values = arrays[name]
        if values.dtype.kind != np.dtype(dtype).kind or values.shape != shape:
            raise ValueError(f"{name} of {values.dtype} and shape {values.shape}")
        return values

    def tensor(values: Array) -> Tensor:
        column = torch.from_numpy(np.ascontiguousarray(values))
        return column.to(dtype) if column.is_floating_point() else column

    num_planes = len(arrays["plane_count"])
    columns = {
        name: read(f"plane_{name}", number, (num_planes, *shape))
        for name, (number, shape) in PLANE_COLUMNS.items()
    }
    columns["offset"] = columns["offset"] - columns["normal"] @ origin
    columns |= {name: columns[name] - origin for name in ("centroid", "center")}
    typed: Json = {name: tensor(values) for name, values in columns.items()}
    table = Planes(**typed)
    if "plane_kind" in arrays:
        kinds = [PLANE_KINDS.index(word) for word in read("plane_kind", "U", (num_planes,))]
        table = replace(table, kind=torch.tensor(kinds, dtype=torch.int64))
    if "plane_object" in arrays:
        table = replace(table, object=tensor(read("plane_object", "i8", (num_planes,))))
    if "adjacency_pairs" in arrays:
        num_pairs = len(arrays["adjacency_pairs"])
        pairs = read("adjacency_pairs", "i8", (num_pairs, 2))
        length, angle = (
            read(f"adjacency_{name}", "f8", (num_pairs,)) for name in PlaneAdjacency._fields[1:]
        )
        _check_planes(pairs, num_planes)
        adjacency = PlaneAdjacency(tensor(pairs), tensor(length), tensor(angle))
        table = replace(table, adjacency=adjacency)
    if "outline_points" in arrays:
        num_rings = len(arrays["outline_ring_sizes"])
        sizes = read("outline_ring_sizes", "i8", (num_rings,))
        owners = read("outline_ring_planes", "i8", (num_rings,))
        points = read("outline_points", "f8", (int(sizes.sum()), 3)) - origin
        _check_planes(owners, num_planes)
        outline: list[tuple[Tensor, ...]] = [()] * num_planes
        for owner, end, size in zip(owners, sizes.cumsum(), sizes, strict=True):
            outline[owner] += (tensor(points[end - size : end]),)
        table = replace(table, outline=tuple(outline))
    return table


def _check_planes(numbers: Array, num_planes: int) -> None:
    """Raise IndexError if a plane ID is out of range."""
    if numbers.size and not 0 <= numbers.min() <= numbers.max() < num_planes:
        raise IndexError(f"plane {numbers.max()} of {num_planes}")


def describe_planes(planes: Planes, *, origin: Sequence[float] | None = None) -> Json:
    """Convert a plane table to JSON-compatible values.

    Args:
        planes: The table.
        origin: Origin of its coordinates, in coordinates of the data set, ``(3,)``. Default: zero.

    Returns:
        ``planes``: for each plane its ``id`` (the value in ``plane.npy``) and the columns of
        :class:`torchrg.structures.Planes`; ``kind`` as text, and ``outline`` as rings of points.
        With z up and y north, ``dip_deg`` is the angle to the horizontal, in [0, 90], and
        ``dip_direction_deg`` the direction of steepest descent, clockwise from north; None for a
        dip below its error.
        ``adjacency``, if known: ``pair`` of IDs, ``boundary_length``, ``dihedral_deg``. ``unit``:
        "m" if the tallest plane is as high as a room, else "".

    Example:
        >>> from torchrg.pipeline import segment_planes
        >>> grid = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.ones(1))
        >>> plane = describe_planes(segment_planes(grid).planes, origin=[0, 0, 5])["planes"][0]
        >>> plane["count"], plane["normal"], plane["offset"]
        (81, [0.0, 0.0, 1.0], 6.0)
    """
    arrays = planes_to_arrays(
        planes, np.array([0.0] * 3 if origin is None else origin, dtype=np.float64)
    )
    columns = {"id": [*range(len(planes))]} | _lists(arrays, "plane_")
    x, y, z = arrays["plane_normal"].T.astype(np.float64)
    dip = np.arctan2(np.hypot(x, y), np.abs(z))
    columns["dip_deg"] = np.degrees(dip).tolist()
    falls = np.degrees(np.arctan2(x * np.copysign(1, z), y * np.copysign(1, z))) % 360
    # The error of the slope of a fit to points that are spread evenly over the shorter side.
    with np.errstate(divide="ignore", invalid="ignore"):
        error = arrays["plane_rms"] / arrays["plane_extent"][:, 1]
        error = _NUM_ERRORS * error * np.sqrt(12 / arrays["plane_count"])
    error = np.nan_to_num(error, nan=np.inf) + machine_epsilon(planes.normal.dtype)
    columns["dip_direction_deg"] = [
        None if is_level else fall
        for is_level, fall in zip(dip <= error, falls.tolist(), strict=True)
    ]
    if planes.outline is not None:
        ends = arrays["outline_ring_sizes"].cumsum()[:-1]
        rings = iter([ring.tolist() for ring in np.split(arrays["outline_points"], ends)])
        columns["outline"] = [[next(rings) for _ in outline] for outline in planes.outline]
    table: Json = {"unit": guess_unit(planes), "planes": _rows(columns)}
    if planes.adjacency is not None:
        pairs = _lists(arrays, "adjacency_")
        table["adjacency"] = _rows({"pair": pairs.pop("pairs"), **pairs})
    return table


def guess_unit(planes: Planes) -> str:
    """Return "m" if the tallest plane is as high as a room in meters, else an empty string."""
    heights = (planes.axes[..., 2].abs() * planes.extent).sum(dim=1).tolist()
    low, high = _STOREY_HEIGHTS
    return "m" if low <= max(heights, default=0.0) <= high else ""


def tabulate_planes(described: Json) -> Json:
    """Convert the result of :func:`describe_planes` to scalar columns by name.

    Example:
        >>> plane = {"id": 0, "normal": [0.0, 0.6, 0.8], "centroid": [1.0, 2.0, 3.0], "area": 2.5}
        >>> columns = tabulate_planes({"planes": [plane]})
        >>> columns["normal_z"], columns["area"], columns["kind"]
        ([0.8], [2.5], [None])
    """
    rows, columns = described["planes"], Json()
    for name in CSV_COLUMNS:
        values = [row.get(name) for row in rows]
        if name in ("normal", "centroid"):
            columns |= {f"{name}_{x}": [v[i] for v in values] for i, x in enumerate("xyz")}
        elif name == "outline":
            columns[name] = [
                None if rings is None else _to_wkt(rings, row["normal"])
                for rings, row in zip(values, rows, strict=True)
            ]
        else:
            columns[name] = values
    return columns


def encode_csv(described: Json) -> bytes:
    """Convert the result of :func:`describe_planes` to CSV with a header line.

    ``simplify_table`` rounds numbers and straightens polygons. Names of lengths and areas end in
    the unit if it is known, as in ``area_m2``.
    """
    columns, text = tabulate_planes(simplify_table(described)), io.StringIO()
    unit, powers = described.get("unit"), {"area": "2", "rms": "", "offset": ""}
    powers |= {f"centroid_{axis}": "" for axis in "xyz"}
    header = [
        f"{name}_{unit}{powers[name]}" if unit and name in powers else name for name in columns
    ]
    csv.writer(text, lineterminator="\n").writerows([header, *zip(*columns.values(), strict=True)])
    return text.getvalue().encode()


def simplify_table(described: Json) -> Json:
    """Return the result of :func:`describe_planes` with few corners and rounded numbers.

    :func:`torchrg.io.outlines.straighten_rings` simplifies the polygons. Lengths and areas are
    rounded to a hundredth of the median RMS distance, far below their error.
    """
    planes = described["planes"]
    error = float(np.median([plane.get("rms", 0.0) for plane in planes])) if planes else 0.0
    size = max((side for plane in planes for side in plane.get("extent", ())), default=1.0)
    smallest = max(error, _MIN_ERROR * size, smallest_normal(torch.float64))
    decimals = math.ceil(2 - math.log10(smallest))
    rows = []
    for plane in planes:
        row = plane | ({"outline": _straighten(plane)} if plane.get("outline") else {})
        rows.append({n: _rounded(value, _DECIMALS.get(n, decimals)) for n, value in row.items()})
    return described | {"planes": rows}


def bounding_rectangle(plane: Json) -> list[list[float]]:
    """Return the corners of the bounding rectangle of a plane of :func:`describe_planes`."""
    (length, height), center, sides = plane["extent"], plane["center"], plane["axes"]
    halves = [(s * length / 2, t * height / 2) for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [[c + a * u + b * v for c, u, v in zip(center, *sides, strict=True)] for a, b in halves]


def _straighten(plane: Json) -> list[list[list[float]]]:
    """Return the straightened rings of a plane."""
    center, axes = np.array(plane["center"]), np.array(plane["axes"])
    flat = [(np.array(ring) - center) @ axes.T for ring in plane["outline"]]
    spacing = math.sqrt(plane["area"] / max(plane["count"], 1))
    return [(center + r @ axes).tolist() for r in straighten_rings(flat, spacing, plane["rms"])]


def _rounded(value: Any, decimals: int) -> Any:  # noqa: ANN401
    """Round all numbers of a JSON value; minus zero becomes zero."""
    if isinstance(value, list):
        return [_rounded(part, decimals) for part in value]
    return round(value, decimals) + 0.0 if isinstance(value, float) else value


def _to_wkt(rings: Sequence[Sequence[Sequence[float]]], normal: Sequence[float]) -> str:
    """Convert rings to a WKT polygon or multipolygon.

    Outer rings are counter-clockwise; each is followed by its holes.
    """
    polygons: list[list[str]] = []
    for ring in rings:
        positions = np.array(ring) - ring[0]
        if np.cross(positions, np.roll(positions, -1, axis=0)).sum(axis=0) @ normal > 0:
            polygons.append([])
        polygons[-1].append(", ".join(" ".join(map(repr, point)) for point in [*ring, ring[0]]))
    texts = [f"(({'), ('.join(polygon)}))" for polygon in polygons]
    if len(texts) > 1:
        return f"MULTIPOLYGON Z ({', '.join(texts)})"
    return f"POLYGON Z {''.join(texts) or 'EMPTY'}"


def _lists(arrays: Arrays, prefix: str) -> Json:
    """Return the arrays with a prefix as lists, by their names without it."""
    return {n.removeprefix(prefix): v.tolist() for n, v in arrays.items() if n.startswith(prefix)}


def _rows(columns: Json) -> list[Json]:
    """Convert a table of columns to a list of rows."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def described_to_arrays(described: Json) -> Arrays:
    """Convert the result of :func:`describe_planes` to that of :func:`planes_to_arrays`."""
    rows, pairs = described["planes"], described.get("adjacency")
    arrays = {
        f"plane_{name}": np.array([row[name] for row in rows], dtype).reshape(len(rows), *shape)
        for name, (dtype, shape) in PLANE_COLUMNS.items()
    }
    for name in ("kind", "object"):
        if rows and name in rows[0]:
            arrays[f"plane_{name}"] = np.array([row[name] for row in rows])
    if rows and "outline" in rows[0]:
        rings = [(row["id"], ring) for row in rows for ring in row["outline"]]
        arrays["outline_points"] = np.array([p for _, ring in rings for p in ring]).reshape(-1, 3)
        arrays["outline_ring_sizes"] = np.array([len(ring) for _, ring in rings], np.int64)
        arrays["outline_ring_planes"] = np.array([plane for plane, _ in rings], np.int64)
    if pairs is not None:
        ends = np.array([pair["pair"] for pair in pairs], np.int64).reshape(-1, 2)
        arrays["adjacency_pairs"] = ends
        for name in PlaneAdjacency._fields[1:]:
            arrays[f"adjacency_{name}"] = np.array([pair[name] for pair in pairs], np.float64)
    return arrays
