"""What a page says about a cloud: its axes, the points it shows, its planes, what closes it."""

from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from torchrg.metrics.contingency import number_labels
from torchrg.neighbors import finite_rows, search_knn
from torchrg.regions import summarize_planes
from torchrg.render.channels import MODES
from torchrg.render.cutaway import find_outer_surfaces
from torchrg.render.grid import build_grid, local_spacing, surface_cells
from torchrg.structures import Cloud, Planes

NUM_STRATA = 8
"""Random parts of the points, each along a Morton curve. While the page moves on a slow machine it
draws the first ones; along a curve, positions compress to two thirds."""
PAGE_EXTENT = 10.0
"""The longest side of a cloud on a page: pages do not depend on the unit."""
_TABLE_POINTS = 200_000
"""Points that tell outlines and which planes meet: enough for a picture."""
_TABLE_NEIGHBORS = 24
"""Neighbours that bridge the strip without labels along an edge."""
_MAX_SURFACES = 7
"""Outer surfaces that a page can cut away: bits of a byte, the last of which hides planes."""
_USUAL_RADIUS = 128
_STEPS_OF_OCTAVE = 16
_LARGEST_SPACING = 3.0
"""Radii of points are bytes: steps of their ratio to the usual one, which is bounded both ways."""
_UPRIGHT = 0.26
"""Cosine between the normal of a wall and the upward direction: 15 degrees."""
_BEYOND = 0.02
"""A point is beyond a wall from this share of the cloud's longest side on."""
_MOST_BEYOND = 0.03
"""Share of the points beyond an outer wall: those that a scanner saw through doors and windows."""
_ALIKE = 0.9
"""Cosine of the directions of walls that are cut away together."""
_MOST_WALLS, _WALL_POINTS = 200, 20_000
"""So many of the largest planes may be outer walls, as so many points of the cloud tell."""


class Frame(NamedTuple):
    """Where a page's axes are: z up, the middle of the first cloud in the origin.

    Attributes:
        origin: In the coordinates of the files, shape ``(3,)``, float64.
        rotation: Rows are the axes of the page, shape ``(3, 3)``, float64.
        scale: Length of a unit of the page, in the unit of the cloud.
    """

    origin: Tensor
    rotation: Tensor
    scale: float

    def place(self, points: Tensor, origin: NDArray[np.float64]) -> Tensor:
        """Return points about an origin in the axes of the page, float32."""
        moved = points.double() + (torch.from_numpy(origin) - self.origin)
        return (moved @ self.rotation.T / self.scale).float()


class Shown(NamedTuple):
    """The points of a cloud that a page shows.

    Attributes:
        finite: All finite rows of the cloud, in canonical order.
        rows: Those that are shown, by strata, shape ``(n,)``.
        levels: Number of points in the first stratum, in the first two, and so on.
        points: In the axes of the page, shape ``(n, 3)``, float32.
        fields: Of those points; normals in the axes of the page, labels numbered without gaps.
    """

    finite: Tensor
    rows: Tensor
    levels: list[int]
    points: Tensor
    fields: dict[str, Tensor]


def frame_of(cloud: Cloud, up: tuple[float, float, float]) -> Frame:
    """Return the axes of a page for its first cloud."""
    third = functional.normalize(torch.tensor(up, dtype=torch.float64), dim=0)
    # With z up, x stays x; else the axis least along the upward one, so that x is never up.
    start = torch.zeros(3, dtype=torch.float64)
    start[int(third.abs().argmin())] = 1
    first = functional.normalize(start - (start @ third) * third, dim=0)
    rotation = torch.stack([first, torch.linalg.cross(third, first), third])
    kept = cloud.coordinates[cloud.finite]
    if len(kept) == 0:
        return Frame(torch.zeros(3, dtype=torch.float64), rotation, 1.0)
    low, high = (torch.from_numpy(end(axis=0).astype(np.float64)) for end in (kept.min, kept.max))
    extent = float((high - low).amax())
    return Frame(low + (high - low) / 2, rotation, extent / PAGE_EXTENT if extent > 0 else 1.0)


def choose_points(cloud: Cloud, frame: Frame, max_points: int) -> Shown:
    """Choose the points to show: the same whatever their order, and in random strata."""
    finite = finite_rows(cloud.points)
    mixed = torch.from_numpy(np.random.default_rng(0).permutation(len(finite))[:max_points])
    strata = [part.sort().values for part in mixed.tensor_split(NUM_STRATA)]
    levels = torch.tensor([len(part) for part in strata]).cumsum(0).tolist()
    rows = finite[torch.cat(strata)]
    fields = {
        name: torch.from_numpy(np.ascontiguousarray(cloud.fields[name][rows.numpy()]))
        for _, name in MODES.values()
        if name in cloud.fields
    }
    for name in ("normals", "curvature"):
        if name in fields:
            fields[name] = fields[name].float().nan_to_num(0, 0, 0)
    if "normals" in fields:
        fields["normals"] = fields["normals"] @ frame.rotation.T.float()
    for name in ("labels", "superpoints"):
        if name in fields:
            distinct = _distinct(cloud, name)
            places = torch.searchsorted(distinct, fields[name].long())
            fields[name] = torch.where(fields[name] < 0, -1, places)
    return Shown(finite, rows, levels, frame.place(cloud.points[rows], cloud.origin), fields)


def _distinct(cloud: Cloud, name: str) -> Tensor:
    """Return the labels that occur at finite points, ascending."""
    values = torch.from_numpy(np.ascontiguousarray(cloud.fields[name][cloud.finite])).long()
    distinct: Tensor = torch.unique(values[values >= 0])
    return distinct


class Surfaces(NamedTuple):
    """What closes a cloud, and how dense it is.

    Attributes:
        directions: From the inside toward the outside of each outer surface, shape ``(S, 3)``.
        covered: Bits of the surfaces that each point is in, shape ``(n,)``, uint8.
        spacing: The usual distance of a point from its neighbours.
        radii: That of each point, as a step of a sixteenth of an octave from 128, the usual one.
    """

    directions: Tensor
    covered: Tensor
    spacing: float
    radii: Tensor


def outer_surfaces(points: Tensor) -> Surfaces:
    """Find walls and ceiling, and how far points are from their neighbours."""
    covered = torch.zeros(len(points), dtype=torch.uint8)
    radii = torch.full((len(points),), _USUAL_RADIUS, dtype=torch.uint8)
    grid = build_grid(points)
    if len(grid.levels) == 0:
        return Surfaces(points.new_zeros(0, 3), covered, 0.0, radii)
    up = torch.tensor([0.0, 0.0, 1.0])
    found = find_outer_surfaces(surface_cells(grid), up)[:_MAX_SURFACES]
    for place, surface in enumerate(found):
        covered[grid.rows] |= surface.covers(grid.points).to(torch.uint8) << place
    spacing = local_spacing(grid)
    usual = float(spacing.median())
    if usual > 0:
        octaves = (spacing / usual).clamp(min=1 / _LARGEST_SPACING, max=_LARGEST_SPACING).log2()
        steps = (octaves * _STEPS_OF_OCTAVE + _USUAL_RADIUS).round()
        radii[grid.rows] = steps.to(torch.uint8)
    directions = torch.stack([points.new_zeros(3), *(each.direction for each in found)])[1:]
    return Surfaces(directions, covered, usual, radii)


def describe_planes(cloud: Cloud, shown: Shown, frame: Frame) -> list[dict[str, Any]]:
    """Return what a page says about each plane, by the number that its points have there."""
    if "labels" not in shown.fields:
        return []
    names = _distinct(cloud, "labels")
    if len(names) == 0:
        return []
    kept = shown.finite
    labels = torch.from_numpy(np.ascontiguousarray(cloud.fields["labels"])).long()[kept]
    labels = torch.where(labels < 0, -1, torch.searchsorted(names, labels))
    points = cloud.points[kept]
    has_normals = "normals" in cloud.fields
    normals = torch.zeros_like(points)
    if has_normals:
        given = torch.from_numpy(np.ascontiguousarray(cloud.fields["normals"]))[kept]
        normals = given.to(points.dtype).nan_to_num(0, 0, 0)
    table = summarize_planes(points, normals, labels, up=frame.rotation[2].tolist())
    drawn = _planes_to_draw(shown, len(names))
    offset = table.offset.double() + table.normal.double() @ torch.from_numpy(cloud.origin)
    kinds = table.kind if table.kind is not None else torch.zeros_like(table.count)
    rows = zip(
        names.tolist(),
        table.count.tolist(),
        table.area.tolist(),
        table.rms.tolist(),
        table.extent.tolist(),
        table.normal.tolist(),
        offset.tolist(),
        kinds.tolist(),
        (table.curved & has_normals).tolist(),
        _rectangles(table, frame, cloud.origin),
        strict=True,
    )
    planes = []
    for number, row in enumerate(rows):
        name, count, area, rms, extent, normal, height, kind, curved, corners = row
        rings, met = drawn.get(number, ([], []))
        planes.append(
            {
                "name": name,
                "count": count,
                "area": area,
                "rms": rms,
                "extent": extent,
                "normal": normal,
                "offset": height,
                "kind": kind,
                "curved": curved,
                "rings": rings or [corners],
                "meets": met,
            }
        )
    return planes


def _planes_to_draw(
    shown: Shown, num_planes: int
) -> dict[int, tuple[list[Any], list[tuple[int, float, float]]]]:
    """Return outlines in the axes of the page, and which planes meet at which angle and length.

    A sample of the points tells both; without shapely there are no outlines.
    """
    rows = shown.fields["labels"][:_TABLE_POINTS]
    points = shown.points[:_TABLE_POINTS]
    normals = shown.fields.get("normals", torch.zeros_like(points))[:_TABLE_POINTS]
    numbers, labels = number_labels(rows)
    neighbors = search_knn(points, min(_TABLE_NEIGHBORS, len(points)))
    can_trace = find_spec("shapely") is not None
    table = summarize_planes(points, normals, labels, neighbors=neighbors, outline=can_trace)
    found: dict[int, tuple[list[Any], list[tuple[int, float, float]]]] = {
        number: ([], []) for number in range(num_planes)
    }
    if table.outline is not None:
        for number, rings in zip(numbers.tolist(), table.outline, strict=True):
            found[number][0].extend(rounded(ring) for ring in rings)
    if table.adjacency is not None:
        pairs = numbers[table.adjacency.pairs].tolist()
        angles = table.adjacency.dihedral_deg.tolist()
        lengths = table.adjacency.boundary_length.tolist()
        for (first, second), angle, length in zip(pairs, angles, lengths, strict=True):
            for own, other in ((first, second), (second, first)):
                found[own][1].append((other, round(angle, 1), length))
    return found


def sides_of_planes(
    shown: Shown, planes: list[dict[str, Any]], frame: Frame, surfaces: Surfaces
) -> tuple[Tensor, Tensor]:
    """Return the directions of outer surfaces ``(S, 3)``, and the bits of each plane ``(M,)``.

    A plane is in the outer surfaces that hold most of its points. Large upright ones are, too, in
    that of the direction in which there is next to nothing beyond them: walls of scans that are too
    open for a closed outer surface. There is a bit for each main direction.
    """
    labels = shown.fields["labels"]
    inside = labels >= 0
    own, bits = labels[inside], surfaces.covered[inside]
    counts = torch.bincount(own, minlength=len(planes))
    sides = torch.zeros(len(planes), dtype=torch.uint8)
    for place in range(len(surfaces.directions)):
        covered = torch.bincount(own[(bits >> place & 1).bool()], minlength=len(planes))
        sides |= (2 * covered > counts).to(torch.uint8) << place
    directions = list(surfaces.directions)
    normals = torch.tensor([plane["normal"] for plane in planes]).double()
    offsets = torch.tensor([plane["offset"] for plane in planes]).double()
    offsets = (offsets - normals @ frame.origin) / frame.scale
    normals = (normals @ frame.rotation.T).float()
    large = counts.argsort(descending=True, stable=True)[:_MOST_WALLS]
    walls = large[normals[large, 2].abs() < _UPRIGHT]
    heights = shown.points[:_WALL_POINTS] @ normals[walls].T - offsets[walls].float()
    margin = _BEYOND * PAGE_EXTENT
    beyond = torch.stack([heights > margin, heights < -margin]).float().mean(dim=1)
    for sign, shares in zip((1, -1), beyond.tolist(), strict=True):
        for wall, share in zip(walls.tolist(), shares, strict=True):
            if share > _MOST_BEYOND:
                continue
            outward = sign * normals[wall]
            alike = [place for place, each in enumerate(directions) if each @ outward > _ALIKE]
            if not alike and len(directions) < _MAX_SURFACES:
                alike = [len(directions)]
                directions.append(outward)
            for place in alike[:1]:
                sides[wall] |= 1 << place
    return torch.stack([shown.points.new_zeros(3), *directions])[1:], sides


def _rectangles(table: Planes, frame: Frame, origin: NDArray[np.float64]) -> list[Any]:
    """Return the corners of the rectangle around each plane, in the axes of the page."""
    half = (table.axes * table.extent[:, :, None] / 2).double()
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]).double()
    corners = table.center.double()[:, None] + signs @ half
    return [rounded(frame.place(each, origin)) for each in corners]


def rounded(values: Tensor) -> Any:  # noqa: ANN401
    """Return numbers of a page as JSON needs them: a step is a hundred-thousandth of the cloud."""
    return np.round(values.numpy(force=True).astype(np.float64), 4).tolist()
