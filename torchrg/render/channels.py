"""What the colours of a page can mean: numbers of each point, and the colour of each number."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.linalg import unsigned_angle_deg
from torchrg.render.colors import (
    UNLABELED_GRAY,
    color_curvature,
    color_normals,
    color_sharp,
    palette_of_planes,
)
from torchrg.render.outcomes import OUTCOMES, outcomes_of

MODES = {
    "plane": ("planes", "labels"),
    "superpoint": ("superpoints", "superpoints"),
    "color": ("own colours", "color"),
    "normal": ("normals", "normals"),
    "curvature": ("curvature", "curvature"),
    "sharp": ("sharp feature points", "sharp"),
    "error": ("errors of planes", "labels"),
    "normal-error": ("errors of normals", "normals"),
}
"""Meanings of colours: what a page calls them, and the field that they need."""

_OCTAHEDRON_STEPS = 254
"""Steps along the sides of the square onto which directions are mapped: about one degree. An even
number, so that the axes are mapped exactly."""
_DIRECTION_BITS = 6
"""Bits of each coordinate of that square that tell a colour."""
_CURVATURE_END = 0.1
"""Curvature at the end of its scale of colours."""
_WORST_ANGLE_DEG = 45.0
"""Error of a normal at the end of its scale of colours."""
_LEVELS = 255
"""Steps of a scale of colours."""

Legend = list[tuple[list[int], str]]


class Channel(NamedTuple):
    """One meaning of the colours.

    Attributes:
        mode: A key of :data:`MODES`.
        values: Row of each point in ``colors``, shape ``(n,)``, unsigned; or, without ``colors``,
            its colour, shape ``(n, 3)``, uint8.
        colors: Shape ``(C, 3)``, uint8.
        legend: Colours and what they mean.
    """

    mode: str
    values: NDArray[Any]
    colors: NDArray[np.uint8] | None
    legend: Legend


def channels_of(
    points: Tensor,
    fields: Mapping[str, Tensor],
    truth: Mapping[str, Tensor],
    *,
    reference: Tensor | None = None,
) -> Iterator[Channel]:
    """Yield all that the fields of points can be coloured by, in the order of :data:`MODES`.

    Args:
        points: Shape ``(n, 3)``, finite; they tell which planes need unlike colours.
        fields: Of a cloud, of those points; see :class:`torchrg.structures.Cloud`. Labels and
            superpoints are numbered without gaps.
        truth: ``labels`` or ``normals`` of the same points.
        reference: Labels whose planes shall have the same colours, shape ``(n,)``.
    """
    if "labels" in fields:
        yield _of_regions("plane", fields["labels"], points, reference)
    if "superpoints" in fields:
        yield _of_regions("superpoint", fields["superpoints"], points, None)
    if "color" in fields:
        yield Channel("color", fields["color"].numpy(), None, [])
    if "normals" in fields:
        yield _of_normals(fields["normals"])
    if "curvature" in fields:
        yield _of_curvature(fields["curvature"])
    if "sharp" in fields:
        colors = color_sharp(torch.tensor([False, True])).numpy()
        legend = [(colors[0].tolist(), "smooth"), (colors[1].tolist(), "sharp")]
        yield Channel("sharp", fields["sharp"].numpy().astype(np.uint8), colors, legend)
    if "labels" in fields and "labels" in truth:
        values = outcomes_of(fields["labels"], truth["labels"]).numpy().astype(np.uint8)
        meanings = [(list(color), meaning) for color, meaning in OUTCOMES.values()]
        colors = np.array([color for color, _ in meanings], dtype=np.uint8)
        yield Channel("error", values, colors, meanings)
    if "normals" in fields and "normals" in truth:
        yield _of_angles(unsigned_angle_deg(fields["normals"], truth["normals"]))


def _of_regions(mode: str, labels: Tensor, points: Tensor, reference: Tensor | None) -> Channel:
    """Return the colours of regions by their number; the last colour is that of points in none."""
    rows, palette = palette_of_planes(labels, points, reference=reference, for_all_eyes=True)
    none = int(labels.max()) + 1 if len(labels) else 0
    values = torch.where(labels < 0, none, labels)
    colors = palette[-1:].repeat(none + 1, 1)
    colors[values] = palette[rows]
    legend = [([UNLABELED_GRAY] * 3, "in none")] if bool((rows < 0).any()) else []
    return Channel(mode, values.numpy().astype(np.min_scalar_type(none)), colors.numpy(), legend)


def _of_normals(normals: Tensor) -> Channel:
    """Return the colours of directions, by their place on the octahedron."""
    places = encode_directions(normals)
    shift = 8 - _DIRECTION_BITS
    values = (places[:, 0].astype(np.uint16) >> shift << _DIRECTION_BITS) | (places[:, 1] >> shift)
    values[(normals == 0).all(dim=1).numpy()] = 1 << 2 * _DIRECTION_BITS
    steps = (np.arange(1 << _DIRECTION_BITS) << shift) + (1 << shift - 1)
    square = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    directions = torch.from_numpy(decode_directions(square.astype(np.uint8)))
    colors = color_normals(torch.cat([directions, torch.zeros(1, 3)])).numpy()
    level = color_normals(torch.tensor([[0.0, 0, 1]]))[0].tolist()
    legend = [(level, "level"), (colors[-1].tolist(), "no normal")]
    return Channel("normal", values, colors, legend)


def _of_curvature(curvature: Tensor) -> Channel:
    """Return the colours of curvature; they go with its root, as the numbers do."""
    share = (curvature / _CURVATURE_END).clamp(0, 1).sqrt().nan_to_num()
    steps = torch.arange(_LEVELS + 1, dtype=torch.float64) / _LEVELS
    colors = color_curvature(_CURVATURE_END * steps * steps, max_curvature=_CURVATURE_END).numpy()
    shown = (0.0, 0.01, 0.03, _CURVATURE_END)
    legend = [
        (colors[round(_LEVELS * math.sqrt(value / _CURVATURE_END))].tolist(), f"{value:g}")
        for value in shown
    ]
    legend[-1] = (legend[-1][0], f"{_CURVATURE_END:g} and more")
    return Channel("curvature", (share * _LEVELS).round().numpy().astype(np.uint8), colors, legend)


def _of_angles(angles_deg: Tensor) -> Channel:
    """Return the colours of angles between normals and their truth."""
    share = (angles_deg / _WORST_ANGLE_DEG).clamp(0, 1).nan_to_num()
    steps = torch.arange(_LEVELS + 1, dtype=torch.float64) / _LEVELS
    colors = color_curvature(steps * steps, max_curvature=1.0).numpy()
    legend = [
        (colors[round(_LEVELS * angle / _WORST_ANGLE_DEG)].tolist(), f"{angle:g} degrees")
        for angle in (0, 5, 20, _WORST_ANGLE_DEG)
    ]
    values = (share * _LEVELS).round().numpy().astype(np.uint8)
    return Channel("normal-error", values, colors, legend)


def encode_directions(directions: Tensor) -> NDArray[np.uint8]:
    """Map unit vectors ``(n, 3)`` to an octahedron, unfolded to a square [1]: two bytes each.

    References:
        [1] Z. Cigolle et al. A survey of efficient representations for independent unit vectors.
            Journal of Computer Graphics Techniques 3(2), 2014.

    Example:
        >>> encode_directions(torch.tensor([[0.0, 0, 1], [1, 0, 0]])).tolist()
        [[127, 127], [254, 127]]
    """
    size = directions.abs().sum(dim=1, keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    x, y, z = (directions / size).unbind(dim=1)
    ones = torch.ones_like(x)
    folded_x = torch.where(z < 0, (1 - y.abs()) * torch.copysign(ones, x), x)
    folded_y = torch.where(z < 0, (1 - x.abs()) * torch.copysign(ones, y), y)
    square = torch.stack([folded_x, folded_y], dim=1)
    steps = ((square * 0.5 + 0.5) * _OCTAHEDRON_STEPS).nan_to_num().round().clamp(0, 255)
    return steps.numpy().astype(np.uint8)


def decode_directions(places: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the unit vectors ``(n, 3)`` of :func:`encode_directions`.

    Example:
        >>> decode_directions(np.array([[254, 127]], dtype=np.uint8)).tolist()
        [[1.0, 0.0, 0.0]]
    """
    x, y = (places.astype(np.float32) / _OCTAHEDRON_STEPS * 2 - 1).T
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    directions = np.stack([x - np.copysign(fold, x), y - np.copysign(fold, y), z], axis=1)
    unit: NDArray[np.float32] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return unit
