"""The plane table: what each region measures, and which others it meets."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels
from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._optional import require
from torchrg._parallel import map_tasks, places_of
from torchrg.config import Auto
from torchrg.errors import ShapeError
from torchrg.linalg import eigh3_of_few, unit_direction
from torchrg.linalg.moments import Segments, reduce_runs
from torchrg.neighbors import check_neighbors, distinct_rows, mark_first
from torchrg.regions.adjacency import find_adjacency
from torchrg.regions.classes import classify_planes
from torchrg.regions.fit import POINTS_AT_ONCE, RegionPlanes, fit_planes
from torchrg.structures import Neighbors, PlaneAdjacency, Planes, Rows

_TIE = 1e-9
"""Rectangles whose areas differ by less than this share are equal but for rounding."""

_COMPASS = np.array([[1.0, 0], [1, 1], [0, 1], [-1, 1]])
"""Four directions counter-clockwise; the opposite ones follow."""

_ROUNDING = 1e-12
"""Share of the coordinates by which a point inside an octagon is inside beyond rounding."""

_TO_OTHER_SIDES = np.array([[1.5], [2.0], [2.5]])
"""Turns, in units of pi, from an edge to the front, opposite and back edges of its rectangle: 0.5,
1 and 1.5, and 1 more as angles begin at -pi."""

_POINTS_PER_CELL = 9.0
"""Points in an average cell; one cell of 8,000 is then empty by chance."""

_NUM_DOUBLINGS = 4
"""How often cells are made twice as wide, at most."""

_WIDE_ENOUGH = 1.05
"""Cells are wide enough when cells twice as wide give less than this times the area."""

_CELL_ANGLE = math.radians(28.0)
"""Angle between cells and rectangle: along a parallel edge all cells would be cut alike."""

_Outlines = tuple[tuple[Tensor, ...], ...]


def summarize_planes(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    labels: Tensor | NDArray[np.integer],
    *,
    neighbors: Neighbors | None = None,
    up: Sequence[float] | str | None = None,
    outline: bool = False,
    canonical: bool = False,
    facet_tolerance: float | Auto | None = None,
) -> Planes:
    """Fit a plane to each region and measure it.

    Copies of a point in one region count once, except in ``count``. The table does not depend on
    the order of the points, but for which planes meet, which the neighbors say.

    Args:
        points: Points, shape ``(N, 3)``; those without a label may hold anything.
        normals: Unit normals of any sign, shape ``(N, 3)``. They tell curved regions from flat
            ones, and decide where points do not: in regions of one or two points, or along a line.
        labels: Region of each point, shape ``(N,)``: 0 to M-1, each at least once, or negative.
        neighbors: Neighbours of each point, to tell which planes meet.
        up: The upward direction, to tell floors, ceilings and walls: three numbers, or an axis such
            as ``"z"`` or ``"-y"``.
        outline: Whether to trace outlines; needs shapely (``torchrg[outline]``).
        canonical: Whether the points already are finite and in canonical order, copies of one
            region side by side; saves a sort.
        facet_tolerance: Of faces in facets, whose normals are spread, in the unit of the points:
            regions within 1.5 of it, root mean square, are planes. Default: normals decide alone.

    Raises:
        ShapeError: If a shape or dtype is not as above, or a labeled point is not finite.
        ConfigError: If ``up`` is not a direction.
        MissingDependencyError: If outlines are asked for and shapely is not installed.

    Example:
        >>> points = torch.tensor([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2]])
        >>> normals, labels = torch.eye(3)[[2] * 4], torch.zeros(4, dtype=torch.int64)
        >>> planes = summarize_planes(points, normals, labels)
        >>> planes.normal.tolist(), planes.offset.tolist(), planes.count.tolist()
        ([[0.0, 0.0, 1.0]], [2.0], [4])
    """
    points = as_tensor("summarize_planes", "points", points).detach()
    normals = as_tensor("summarize_planes", "normals", normals).detach()
    labels = as_tensor("summarize_planes", "labels", labels)
    check_shapes(
        "summarize_planes", points=(points, "N 3"), normals=(normals, "N 3"), labels=(labels, "N")
    )
    check_floating("summarize_planes", points=points, normals=normals)
    if neighbors is not None and not canonical:
        check_neighbors("summarize_planes", neighbors, points)
    rows = _distinct_members(points, labels, canonical=canonical)
    segments, places = Segments(labels[rows]), points[rows]
    fit = fit_planes(segments, places, normals[rows]).flattened(facet_tolerance)
    planes = measure_planes(segments, places, fit, outline=outline)
    planes = replace(planes, count=torch.bincount(labels.clamp(min=-1) + 1, minlength=1)[1:])
    if up is not None:
        direction = unit_direction("summarize_planes", up)
        planes = replace(planes, kind=classify_planes(planes, places, labels[rows], direction))
    if neighbors is not None:
        meeting = find_adjacency(
            points, labels, neighbors, fit.normal, fit.thickness, curved=fit.curved
        )
        lengths, angles = meeting.boundary_length, meeting.dihedral_deg
        lengths, angles = lengths.to(points.dtype), angles.to(points.dtype)
        planes = replace(planes, adjacency=PlaneAdjacency(meeting.pairs, lengths, angles))
    return planes


def _distinct_members(points: Tensor, labels: Tensor, *, canonical: bool) -> Rows:
    """Return the rows of the distinct points of each region, in canonical order."""
    if canonical:
        is_first = mark_first(*points.unbind(dim=1), labels)
        return slice(None) if bool(is_first.all()) else places_of(is_first)
    members = places_of(labels >= 0)
    num_bad = int(torch.count_nonzero(~points[members].isfinite().all(dim=1)))
    if num_bad:
        raise ShapeError(
            f"summarize_planes: expected finite points in regions, got {num_bad:,} that are not; "
            "label them -1."
        )
    return members[distinct_rows(points[members], labels[members])]


def measure_planes(
    segments: Segments, points: Tensor, fit: RegionPlanes, *, outline: bool = False
) -> Planes:
    """Measure regions on the planes that were fitted to them; see :func:`summarize_planes`."""
    first, second = _plane_axes(fit)
    shares = segments.shares(POINTS_AT_ONCE)
    sizes = [len(share.counts) for share in shares]
    frame = fit.center, torch.stack([first, second, fit.normal], dim=1)
    frames = zip(*(torch.split(part, sizes) for part in frame), strict=True)
    measures = map_tasks(
        lambda part: _measure(points, *part, outline=outline),
        list(zip(shares, frames, strict=True)),
        points.device,
    )
    numbers, outlines = zip(*measures, strict=True)
    mean, area, sides, directions, middle = map(torch.cat, zip(*numbers, strict=True))
    axes = directions @ torch.stack([first, second], dim=1)

    def as_given(values: Tensor) -> Tensor:
        return values.to(points.dtype)

    return Planes(
        normal=as_given(fit.normal),
        offset=as_given((fit.center * fit.normal).sum(dim=1)),
        centroid=as_given(fit.center + mean),
        area=as_given(area),
        count=fit.num_points,
        rms=as_given(fit.rms),
        extent=as_given(sides),
        axes=as_given(axes),
        center=as_given(fit.center + (middle[:, None] @ axes).squeeze(1)),
        curved=fit.curved,
        outline=sum(outlines, ()) if outline else None,
    )


def _measure(
    points: Tensor, segments: Segments, frame: tuple[Tensor, Tensor], *, outline: bool
) -> tuple[list[Tensor], _Outlines]:
    """Return mean, area, rectangle and outlines of regions, by centers ``(M, 3)`` and axes.

    The axes ``(M, 3, 3)`` are two in the plane and its normal; the mean is in space.
    """
    u, v, height = segments.along(points, *frame)
    mean = torch.stack([segments.mean(column) for column in (u, v, height)], dim=1)
    mean = (mean[:, None] @ frame[1]).squeeze(1)
    del height
    boxes = fit_rectangles(segments, u, v)
    area, width = covered_areas(segments, u, v, boxes)
    rings = _outlines(segments, u, v, width, frame, points.dtype) if outline else ()
    return [mean, area, *boxes], rings


def _plane_axes(fit: RegionPlanes) -> tuple[Tensor, Tensor]:
    """Return two unit directions that span each plane, the first along the region."""
    first = _without(eigh3_of_few(fit.covariance)[1][:, :, 2], fit.normal)
    # The points of one place have no direction of their own: any in the plane will do.
    least = fit.normal.abs().argmin(dim=1)
    other = _without(torch.eye(3, dtype=first.dtype, device=first.device)[least], fit.normal)
    first = torch.where(first.norm(dim=1, keepdim=True) > 0.5, first, other)
    first = first / first.norm(dim=1, keepdim=True)
    return first, torch.linalg.cross(fit.normal, first)


def _without(vectors: Tensor, normals: Tensor) -> Tensor:
    """Return vectors less their component along the normals."""
    return vectors - (vectors * normals).sum(dim=1, keepdim=True) * normals


def _outlines(
    segments: Segments,
    u: Tensor,
    v: Tensor,
    width: Tensor,
    frame: tuple[Tensor, Tensor],
    dtype: torch.dtype,
) -> _Outlines:
    """Trace the outline of each region, and lift it into space."""
    outlines = []
    counts = segments.counts.tolist()
    parts = torch.split(torch.stack([u, v], dim=1), counts)
    for places, size, center, axes in zip(parts, width.tolist(), *frame, strict=True):
        rings = (
            torch.from_numpy(ring).to(u.device)
            for ring in trace_outline(places.cpu().numpy(), size)
        )
        lifted = (center + ring[:, :1] * axes[0] + ring[:, 1:] * axes[1] for ring in rings)
        outlines.append(tuple(ring.to(dtype) for ring in lifted))
    return tuple(outlines)


def trace_outline(places: NDArray[np.float64], width: float) -> list[NDArray[np.float64]]:
    """Return the outline of points in a plane: rings through some of them.

    The points near an edge, found with square cells, are triangulated. Triangles over cells without
    points are left out, and the others united. Holes and dents narrower than ``width``, that of the
    cells, are filled. Outer rings ``(V, 2)``, the first point not repeated, run counter-clockwise,
    holes clockwise; points on one line have none.

    Raises:
        MissingDependencyError: If shapely is not installed.
    """
    from scipy.ndimage import binary_erosion
    from scipy.spatial import Delaunay, QhullError

    shapely = require("shapely", extra="outline", purpose="trace outlines")
    if width <= 0:
        return []
    cells = np.floor((places - places.min(axis=0)) / width).astype(np.int64) + 1
    occupied = np.zeros(cells.max(axis=0) + 2, dtype=bool)
    occupied[tuple(cells.T)] = True
    inside = binary_erosion(occupied, np.ones((3, 3), dtype=bool))
    corners = places[~inside[tuple(cells.T)]]
    try:
        triangles = corners[Delaunay(corners).simplices]
    except (QhullError, ValueError):
        return []
    ends = np.roll(triangles, 1, axis=1)
    tried = np.concatenate([(triangles + ends) / 2, triangles.mean(axis=1, keepdims=True)], axis=1)
    reached = np.floor((tried - places.min(axis=0)) / width).astype(np.int64) + 1
    covered = occupied[reached[..., 0], reached[..., 1]].all(axis=1)
    # Triangles that share whole edges are a coverage, which is united twenty times as fast.
    shape = shapely.coverage_union_all(shapely.polygons(triangles[covered]))
    return _rings(shapely, shapely.simplify(shape, width / 6), width * width)


def _rings(shapely: Any, shape: Any, min_area: float) -> list[NDArray[np.float64]]:  # noqa: ANN401
    """Return the rings of a polygon or of several, largest polygon first, without specks."""
    parts = [polygon for polygon in shapely.get_parts(shape) if polygon.geom_type == "Polygon"]
    largest = max((polygon.area for polygon in parts), default=0.0)
    parts = [polygon for polygon in parts if polygon.area >= min(min_area, largest)]
    rings: list[NDArray[np.float64]] = []
    for polygon in sorted(parts, key=lambda polygon: -polygon.area):
        turned = shapely.geometry.polygon.orient(polygon)
        holes = [hole for hole in turned.interiors if shapely.Polygon(hole).area >= min_area]
        rings += [np.asarray(ring.coords)[:-1] for ring in (turned.exterior, *holes)]
    return rings


class Rectangles(NamedTuple):
    """Rectangles about M regions.

    Lengths of the long and of the short side, shape ``(M, 2)``; their unit directions in the
    plane's coordinates, ``(M, 2, 2)``; and the centers, ``(M, 2)``, along those directions.
    """

    sides: Tensor
    directions: Tensor
    center: Tensor


def fit_rectangles(segments: Segments, u: Tensor, v: Tensor) -> Rectangles:
    """Find the rectangle of least area about each region.

    One of its sides runs along an edge of the region's convex hull [1]. Of equally small ones it is
    that with the least angle to the coordinates ``u`` and ``v`` in the plane, given in the order of
    :meth:`Segments.take`. A region on one line has a short side of 0, one of one place two.

    References:
        [1] H. Freeman, R. Shapira. Determining the minimum-area encasing rectangle for an arbitrary
        closed curve. Communications of the ACM 18(7), 1975.
    """
    rectangles = [_least_rectangle(places) for places in outer_places(segments, u, v)]
    cosine, sine, *ends = u.new_tensor(rectangles).view(-1, 6).unbind(dim=1)
    low, high = torch.stack(ends[:2], dim=1), torch.stack(ends[2:], dim=1)
    directions = torch.stack([cosine, sine, -sine, cosine], dim=1).view(-1, 2, 2)
    sides, centers = high - low, (high + low) / 2
    swap = sides[:, 0] < sides[:, 1]
    return Rectangles(
        torch.where(swap[:, None], sides.flip(1), sides),
        torch.where(swap[:, None, None], directions.flip(1), directions),
        torch.where(swap[:, None], centers.flip(1), centers),
    )


def _least_rectangle(places: NDArray[np.float64]) -> list[float]:
    """Return cosine and sine of the smallest rectangle about points ``(n, 2)``, and its ends.

    These are the least coordinates along its two directions, then the largest ones.
    """
    angle = _least_area_angle(places)
    cosine, sine = math.cos(angle), math.sin(angle)
    u, v = places.T
    along = np.stack([u * cosine + v * sine, v * cosine - u * sine])
    return [cosine, sine, *along.min(axis=1).tolist(), *along.max(axis=1).tolist()]


def _least_area_angle(places: NDArray[np.float64]) -> float:
    """Return the angle of the smallest rectangle about points ``(n, 2)``, in [0, 90) degrees.

    A corner of the hull is the farthest in a direction if the edges before and after it are on
    either side of the edge that would be across it: a search among the angles of the edges.
    """
    corners = places[_hull_corners(places)] @ [1, 1j]
    angles = np.angle(np.roll(corners, -1) - corners)
    order = np.argsort(angles)
    corners, angles = corners[order], angles[order]
    across = (angles + np.pi * _TO_OTHER_SIDES) % (2 * np.pi) - np.pi
    front, top, back = corners[np.searchsorted(angles, across) % len(corners)]
    to_edge = np.exp(-1j * angles)
    length, height = ((front - back) * to_edge).real, ((top - corners) * to_edge).imag
    area = (length * height).clip(min=0)
    smallest = angles[area <= area.min() * (1 + _TIE)] % (np.pi / 2)
    return float(np.where(smallest < np.pi / 2 - _TIE, smallest, smallest - np.pi / 2).min())


def _hull_corners(places: NDArray[np.float64]) -> NDArray[np.integer]:
    """Return the corners of the convex hull, counter-clockwise; the two ends of a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners: NDArray[np.integer] = ConvexHull(places).vertices
    except QhullError:
        corners = np.lexsort(places.T)[[0, -1]]
    return corners


def outer_places(segments: Segments, u: Tensor, v: Tensor) -> list[NDArray[np.float64]]:
    """Return the points ``(n, 2)`` of each region that may be corners of its convex hull.

    Not those inside the octagon of the farthest points in eight directions: S. Akl, G. Toussaint. A
    fast convex hull algorithm. Information Processing Letters 7(5), 1978.
    """
    if not segments.is_served(u):
        regions = torch.split(torch.stack([u, v], dim=1).cpu(), segments.counts.tolist())
        return [_outside_of_octagon(places.numpy().astype(np.float64)) for places in regions]
    (outer,) = kernels.call("outer_places", u, v, segments.counts, _ROUNDING)
    chosen = places_of(outer)
    ends = torch.searchsorted(chosen, segments.counts.cumsum(0)).tolist()
    places = torch.stack([u[chosen], v[chosen]], dim=1).numpy()
    return [places[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def _outside_of_octagon(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Do as :func:`outer_places` for the points of one region."""
    # BLAS would start threads of its own.
    along = _COMPASS[:, :1] * places[:, 0] + _COMPASS[:, 1:] * places[:, 1]
    ends = np.concatenate([along.argmax(axis=1), along.argmin(axis=1)])
    octagon = places[ends[ends != np.roll(ends, 1)]]
    if len(octagon) < 3:
        return places
    edges = np.roll(octagon, -1, axis=0) - octagon
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    offsets = (inward * octagon).sum(axis=1)
    rounding = _ROUNDING * np.abs(inward).max(axis=1) * np.abs(places).max()
    heights = inward[:, :1] * places[:, 0] + inward[:, 1:] * places[:, 1]
    inside = (heights > (offsets + rounding)[:, None]).all(axis=0)
    outside: NDArray[np.float64] = places[~inside]
    return outside


class _Cells(NamedTuple):
    """Occupied cells: region, row and column of each, and the open sides of each region's cells."""

    owner: Tensor
    row: Tensor
    column: Tensor
    num_cells: Tensor
    num_open: Tensor


def covered_areas(
    segments: Segments, u: Tensor, v: Tensor, boxes: Rectangles
) -> tuple[Tensor, Tensor]:
    """Return the area covered by points, without gaps, holes and dents, and the cells' width.

    The plane is divided into square cells, at first three times as wide as the mean spacing of the
    points, then wider until the area hardly grows, so that parts of low density have no holes.
    Cells along the outline are only partly covered: the expected excess is taken off. Areas
    ``(M,)`` are 0 where the points are on one line, and at most those of the rectangles; the width
    ``(M,)`` of cells leaves no holes between points.
    """
    box = boxes.sides.prod(dim=1)
    size = (box * _POINTS_PER_CELL / segments.counts).sqrt()
    # A strip thinner than the spacing would have more cells than points.
    size = torch.maximum(size, boxes.sides[:, 0] / segments.counts)
    cosine, sine = boxes.directions[:, 0].unbind(dim=1)
    c = segments.spread(cosine * math.cos(_CELL_ANGLE) - sine * math.sin(_CELL_ANGLE))
    s = segments.spread(sine * math.cos(_CELL_ANGLE) + cosine * math.sin(_CELL_ANGLE))
    row = _numbered(segments, u * c + v * s, size)
    column = _numbered(segments, v * c - u * s, size)
    cells = _occupied(segments.labels, row, column, segments.counts)
    area, width = _corrected(cells, segments.counts, size), size
    wide_enough = torch.zeros_like(size, dtype=torch.bool)
    for _ in range(_NUM_DOUBLINGS):
        cells = _occupied(cells.owner, cells.row // 2, cells.column // 2, cells.num_cells)
        size = size * 2
        wider = _corrected(cells, segments.counts, size)
        wide_enough |= wider <= _WIDE_ENOUGH * area
        area, width = torch.where(wide_enough, area, wider), torch.where(wide_enough, width, size)
    return torch.minimum(area, box), width


def _numbered(segments: Segments, x: Tensor, size: Tensor) -> Tensor:
    """Return the number of each point's cell along one axis, from 0 on in each region."""
    low = segments.spread(reduce_runs(x, segments.counts, "min"))
    return ((x - low) / segments.spread(torch.where(size > 0, size, 1.0))).long()


def _occupied(owner: Tensor, row: Tensor, column: Tensor, counts: Tensor) -> _Cells:
    """Return the cells with points, each once, of regions of so many points one after the other."""
    # One empty row and column on each side, so that no cell has a neighbour of another region.
    heights, widths = (reduce_runs(place, counts, "max") + 3 for place in (row, column))
    num_regions, ends = len(counts), (heights * widths).cumsum(0)
    starts = ends - heights * widths
    keys = (starts + widths + 1).index_select(0, owner) + row * widths.index_select(0, owner)
    grid = torch.zeros(int(ends[-1]) if num_regions else 0, dtype=torch.bool, device=owner.device)
    grid[keys + column] = True
    keys = places_of(grid)
    owner = torch.searchsorted(ends, keys, right=True)
    width = widths[owner]
    sides = torch.stack([keys - 1, keys + 1, keys - width, keys + width])
    num_open = (~grid[sides]).sum(dim=0)
    inside = keys - starts[owner]
    return _Cells(
        owner,
        inside // width - 1,
        inside % width - 1,
        torch.bincount(owner, minlength=num_regions),
        torch.bincount(owner, weights=num_open.double(), minlength=num_regions),
    )


def _corrected(cells: _Cells, counts: Tensor, size: Tensor) -> Tensor:
    """Return the area of cells less what their outline overshoots.

    A convex shape of area A meets A + E/2 - 1 cells on average, areas in cells, E their open sides.
    A cell covered to a share f is seen if it has a point: with probability 1 - exp(-n f), n points
    in a full cell. Averaged over f this leaves the share 1 - 2 (1 - exp(-n)) / n of the excess.
    """
    density = (counts / cells.num_cells).double()
    share = 1 - 2 * (1 - (-density).exp()) / density
    excess = share.clamp(min=0) * (cells.num_open / 2 - 1)
    return (cells.num_cells - excess).clamp(min=0) * size * size
