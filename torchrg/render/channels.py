"""Color channels of a viewer: values per point, and their colors."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.linalg import unsigned_angle_deg
from torchrg.metrics.contingency import check_labels, contingency_table, is_first
from torchrg.metrics.labels import match_regions
from torchrg.render.colors import MAX_CURVATURE, color_curvature, color_normals, color_sharp
from torchrg.structures import UNLABELED
from torchrg.structures.points import Labels

COLOR_MODES = {
    "plane": ("planes", "labels"),
    "superpoint": ("superpoints", "superpoint"),
    "color": ("point colors", "color"),
    "normal": ("normals", "normals"),
    "curvature": ("curvature", "curvature"),
    "sharp": ("sharp feature points", "sharp"),
    "error": ("plane errors", "labels"),
    "normal-error": ("normal errors", "normals"),
}
"""Color modes: their name in the viewer, and the required field."""
OUTCOMES = {
    "right": ((214, 224, 214), "in the matching region"),
    "part": ((245, 170, 40), "in a second region of its plane"),
    "other": ((205, 45, 60), "in the region of another plane"),
    "none": ((50, 95, 190), "unlabeled"),
}
"""Outcomes of a point against ground truth: color and meaning."""
_OCTAHEDRON_STEPS = 254
"""Steps along the sides of the octahedral map: about a degree. Even, for exact axes."""
_WORST_ANGLE_DEG = 45.0
"""Normal error at the end of the color scale, in degrees."""
_LEVELS = 255
"""Number of steps of a color scale."""
Legend = list[tuple[list[int], str]]


class Channel(NamedTuple):
    """Values of one color mode.

    Attributes:
        mode: A key of :data:`COLOR_MODES`.
        values: Row of ``colors`` for each point, shape ``(n,)``, unsigned; if ``colors`` is None,
            color of each point, shape ``(n, 3)``, uint8.
        colors: Shape ``(C, 3)``, uint8.
        legend: Colors and their meaning.
    """

    mode: str
    values: NDArray[np.integer]
    colors: NDArray[np.uint8] | None
    legend: Legend


def make_channels(
    fields: Mapping[str, Tensor],
    ground_truth: Mapping[str, Tensor],
    palettes: Mapping[str, tuple[Tensor, Tensor]],
) -> Iterator[Channel]:
    """Yield the available color channels, in the order of :data:`COLOR_MODES`.

    Args:
        fields: Fields of n points; see :class:`torchrg.Cloud`. IDs are consecutive.
        ground_truth: Ground-truth ``labels`` or ``normals`` of the same points.
        palettes: Results of :func:`torchrg.render.colors.palette_of_planes` for the available modes
            of ``plane`` and ``superpoint``, with rows of the n points.
    """
    if "labels" in fields:
        yield _region_channel("plane", fields["labels"], *palettes["plane"])
    if "superpoint" in fields:
        yield _region_channel("superpoint", fields["superpoint"], *palettes["superpoint"])
    if "color" in fields:
        yield Channel("color", fields["color"].numpy(), None, [])
    if "normals" in fields:
        chips = color_normals(torch.tensor([[0.0, 0, 1], [0, 0, 0]])).tolist()
        legend = [*zip(chips, ("horizontal", "no normal"), strict=True)]
        yield Channel("normal", color_normals(fields["normals"]).numpy(), None, legend)
    if "curvature" in fields:
        shown = {math.sqrt(part): f"{part * MAX_CURVATURE:g}" for part in (0.0, 0.1, 0.3)}
        shown[1.0] = f"{MAX_CURVATURE:g} and more"
        fractions = (fields["curvature"] / MAX_CURVATURE).clamp(min=0).sqrt()
        yield _scale_channel("curvature", fractions, shown)
    if "sharp" in fields:
        colors = color_sharp(torch.tensor([False, True])).numpy()
        legend = [(colors[0].tolist(), "smooth"), (colors[1].tolist(), "sharp")]
        yield Channel("sharp", fields["sharp"].numpy().astype(np.uint8), colors, legend)
    if "labels" in fields and "labels" in ground_truth:
        values = point_outcomes(fields["labels"], ground_truth["labels"]).numpy().astype(np.uint8)
        meanings = [(list(color), meaning) for color, meaning in OUTCOMES.values()]
        colors = np.array([color for color, _ in meanings], dtype=np.uint8)
        yield Channel("error", values, colors, meanings)
    if "normals" in fields and "normals" in ground_truth:
        angles_deg = unsigned_angle_deg(fields["normals"], ground_truth["normals"])
        shown = {angle / _WORST_ANGLE_DEG: f"{angle:g} degrees" for angle in (0, 5, 20, 45)}
        yield _scale_channel("normal-error", angles_deg / _WORST_ANGLE_DEG, shown)


def _region_channel(mode: str, labels: Tensor, rows: Tensor, palette: Tensor) -> Channel:
    """Return the colors of regions by label; the last color is for unlabeled points."""
    none = int(labels.max()) + 1 if len(labels) else 0
    values = torch.where(labels < 0, none, labels)
    colors = palette[-1:].repeat(none + 1, 1)
    colors[values] = palette[rows]
    legend = [(palette[-1].tolist(), "unlabeled")] if bool((rows < 0).any()) else []
    return Channel(mode, values.numpy().astype(np.min_scalar_type(none)), colors.numpy(), legend)


def _scale_channel(mode: str, fractions: Tensor, shown: Mapping[float, str]) -> Channel:
    """Return the colors of fractions of a scale, with a legend for selected values."""
    steps = torch.arange(_LEVELS + 1, dtype=torch.float64) / _LEVELS
    colors = color_curvature(steps * steps * MAX_CURVATURE).numpy()
    legend = [(colors[round(_LEVELS * part)].tolist(), text) for part, text in shown.items()]
    values = (fractions.clamp(0, 1).nan_to_num() * _LEVELS).round().numpy().astype(np.uint8)
    return Channel(mode, values, colors, legend)


def point_outcomes(labels: Labels, ground_truth: Labels) -> Tensor:
    """Return the outcome of each point as an index of :data:`OUTCOMES`.

    Args:
        labels: Regions, shape ``(N,)``.
        ground_truth: Ground-truth planes, shape ``(N,)``.

    Returns:
        Shape ``(N,)``, int64: 0 if the region matches the point's plane, 1 if it is another region
        with that plane as its largest part, 2 if it is mostly of other planes, 3 if unlabeled.

    Raises:
        ShapeError: If a shape or dtype is invalid.
    """
    regions, faces = check_labels("point_outcomes", labels=labels, ground_truth=ground_truth)
    table = contingency_table(regions, faces)
    pairs = match_regions(table)
    partner = torch.full_like(table.region_labels, UNLABELED - 1)
    partner[table.regions[pairs]] = table.face_labels[table.faces[pairs]]
    largest = is_first(table.regions, -table.overlaps, table.faces)
    main = torch.full_like(table.region_labels, UNLABELED - 1)
    main[table.regions[largest]] = table.face_labels[table.faces[largest]]
    outcome = torch.full_like(regions, 3)
    labeled = regions != UNLABELED
    indices = torch.searchsorted(table.region_labels, regions[labeled])
    face = faces[labeled]
    outcome[labeled] = torch.where(
        partner[indices] == face, 0, torch.where(main[indices] == face, 1, 2)
    )
    return outcome


def encode_directions(directions: Tensor) -> NDArray[np.uint8]:
    """Encode unit vectors ``(n, 3)`` by an octahedral map [1] as two bytes each; 255 for zero.

    References:
        [1] Z. Cigolle et al. A survey of efficient representations for independent unit vectors.
            Journal of Computer Graphics Techniques 3(2), 2014.
    """
    flat = directions / directions.abs().sum(dim=1, keepdim=True)
    square, z = flat[:, :2], flat[:, 2:]
    folded = (1 - square.flip(1).abs()).copysign(square)
    square = torch.where(z < 0, folded, square)
    steps = ((square * 0.5 + 0.5) * _OCTAHEDRON_STEPS).nan_to_num(255).round()
    return steps.numpy().astype(np.uint8)
