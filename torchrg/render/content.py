"""Content of a viewer: axes, displayed points, planes, and outer sides of surfaces."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.io.plane_table import Json, bounding_rectangle, describe_planes
from torchrg.io.result import Result
from torchrg.linalg.angles import unit_direction
from torchrg.metrics.contingency import number_labels
from torchrg.neighbors.order import finite_rows
from torchrg.regions.classes import classify_planes
from torchrg.regions.directions import horizontal_toward, unit_axis
from torchrg.render.channels import COLOR_MODES
from torchrg.render.cutaway import Sides, find_sides
from torchrg.render.surface import MAX_SPACING_RATIO, VisibleSurface, sample_surface
from torchrg.structures import PLANE_KINDS, Cloud
from torchrg.structures.points import bounding_box

NUM_STRATA = 8
"""Number of random strata of the points, each sorted along a Morton curve. While the camera moves,
slow machines draw only the first strata. Sorting compresses positions to two thirds."""
PAGE_EXTENT = 10.0
"""Longest side of a cloud in a viewer; independent of the unit."""
_OMITTED_COLUMNS = ("id", "centroid", "axes", "center", "outline")
"""Columns of the plane table that are drawn or omitted."""
_MEDIAN_RADIUS = 128
"""Encoded median radius, in the middle of the byte range."""
_STEPS_PER_OCTAVE = 16
"""Steps of the encoded radius per factor of two: one step is 4 percent."""


class PageFrame(NamedTuple):
    """Axes of a viewer: z up, origin at the center of the first cloud.

    Attributes:
        origin: Origin in file coordinates, shape ``(3,)``, float64.
        rotation: Axes of the viewer as rows, shape ``(3, 3)``, float64.
        scale: Length of a viewer unit, in units of the cloud.
    """

    origin: Tensor
    rotation: Tensor
    scale: float

    def transform(self, points: Tensor, origin: NDArray[np.float64]) -> Tensor:
        """Transform points relative to an origin to viewer axes, float32."""
        moved = points.double() + (torch.from_numpy(origin) - self.origin)
        return (moved @ self.rotation.T / self.scale).float()


class PointSample(NamedTuple):
    """Points of a cloud displayed in a viewer.

    Attributes:
        rows: Displayed rows, by strata, shape ``(n,)``.
        levels: Cumulative number of points of the strata.
        points: Points in viewer axes, shape ``(n, 3)``, float32.
        fields: Fields of the points; normals are in viewer axes, labels are consecutive.
        surface: Surface of the points, in viewer axes.
        sides: Outer sides of the surface.
    """

    rows: Tensor
    levels: list[int]
    points: Tensor
    fields: dict[str, Tensor]
    surface: VisibleSurface
    sides: Sides


def make_frame(cloud: Cloud, up: Sequence[float] | str) -> PageFrame:
    """Return the axes of a viewer for its first cloud."""
    third = unit_direction("make_page", up)
    # With z up, x stays x; otherwise use the axis most perpendicular to the up direction.
    first = horizontal_toward(unit_axis(third), third)
    rotation = torch.stack([first, torch.linalg.cross(third, first), third])
    finite = cloud.coordinates[cloud.finite]
    if len(finite) == 0:
        return PageFrame(torch.zeros(3, dtype=torch.float64), rotation, 1.0)
    low, high = map(torch.from_numpy, bounding_box(finite))
    extent = float((high - low).amax())
    return PageFrame(low + (high - low) / 2, rotation, extent / PAGE_EXTENT if extent > 0 else 1.0)


def choose_points(result: Result, frame: PageFrame, max_points: int) -> PointSample:
    """Sample the points to display, in random strata."""
    cloud = result.cloud
    finite = finite_rows(cloud.points)
    shuffled = torch.from_numpy(np.random.default_rng(0).permutation(len(finite))[:max_points])
    strata = [stratum.sort().values for stratum in shuffled.tensor_split(NUM_STRATA)]
    levels = torch.tensor([len(stratum) for stratum in strata]).cumsum(0).tolist()
    rows = finite[torch.cat(strata)]
    fields = {
        name: result.fields[name][rows] for _, name in COLOR_MODES.values() if name in result.fields
    }
    for name in ("normals", "curvature"):
        if name in fields:
            fields[name] = fields[name].float().nan_to_num(0, 0, 0)
    if "normals" in fields:
        fields["normals"] = fields["normals"] @ frame.rotation.T.float()
    if "labels" in fields:
        fields["labels"] = result.labels[rows]
    if "superpoint" in fields:
        parts = result.fields["superpoint"].long()
        fields["superpoint"] = number_labels(parts.clamp(min=-1))[1][rows]
    points = frame.transform(cloud.points[rows], cloud.origin)
    surface = sample_surface(points)
    labels = fields["labels"][surface.rows] if "labels" in fields else None
    sides = find_sides(surface, labels, torch.tensor([0.0, 0.0, 1.0]))
    return PointSample(rows, levels, points, fields, surface, sides)


def encode_radii(shown: PointSample) -> Tensor:
    """Return the encoded radius of each point: 16 steps per factor of two, 128 is the median."""
    surface = shown.surface
    median_spacing = float(surface.spacing.median()) if len(surface.spacing) else 0.0
    if median_spacing == 0:
        return torch.full((len(surface.rows),), _MEDIAN_RADIUS, dtype=torch.uint8)
    labels = shown.fields.get("labels", torch.zeros_like(shown.rows))[surface.rows]
    ratio = surface.disc_spacing(labels) / median_spacing
    octaves = ratio.clamp(min=1 / MAX_SPACING_RATIO).log2()
    return (octaves * _STEPS_PER_OCTAVE + _MEDIAN_RADIUS).round().to(torch.uint8)


def page_planes(described: Json, frame: PageFrame) -> list[Json]:
    """Return the plane entries of a viewer, by viewer label.

    Entries have the columns of :func:`displayed_table` that are not drawn, ``rings`` in viewer
    axes (the polygon, or the bounding rectangle), and ``meets``: adjacent planes with angle and
    boundary length.
    """
    meets: list[list[tuple[int, float, float]]] = [[] for _ in described["planes"]]
    for contact in described.get("adjacency", []):
        sizes = round(contact["dihedral_deg"], 1), contact["boundary_length"]
        for plane, other in (contact["pair"], contact["pair"][::-1]):
            meets[plane].append((other, *sizes))
    return [
        {name: value for name, value in row.items() if name not in _OMITTED_COLUMNS}
        | {
            "name": row["id"],
            "kind": PLANE_KINDS.index(row["kind"]),
            "rings": [
                rounded(frame.transform(torch.tensor(ring, dtype=torch.float64), np.zeros(3)))
                for ring in row.get("outline") or [bounding_rectangle(row)]
            ],
            "meets": met,
        }
        for row, met in zip(described["planes"], meets, strict=True)
    ]


def displayed_table(result: Result, frame: PageFrame) -> Json:
    """Return the plane table of a viewer, with the labels of the file as IDs.

    Planes without classes are classified by the up axis of the viewer.
    """
    planes = result.planes
    if not planes:
        return {"planes": []}
    if not isinstance(vars(planes)["kind"], Tensor):
        cloud = result.cloud.points, result.labels
        planes = replace(planes, kind=classify_planes(planes, *cloud, frame.rotation[2]))
    described = describe_planes(planes, origin=result.cloud.origin.tolist())
    for row, name in zip(described["planes"], result.names.tolist(), strict=True):
        row["id"] = name
    return described


def rounded(values: Tensor) -> object:
    """Round numbers for JSON, to 1e-5 of the cloud extent."""
    numbers: object = np.round(values.numpy(force=True).astype(np.float64), 4).tolist()
    return numbers
