"""Room alignment from planes: up from floors and ceilings, x and y along walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchrg._checks import check_kinds, default_device_cpu
from torchrg.errors import ConfigError, warn
from torchrg.linalg.angles import unit_direction
from torchrg.linalg.moments import eigh3_lapack
from torchrg.linalg.rigid import check_rigid
from torchrg.regions.directions import (
    MAX_ANGLE,
    MIN_FRACTION,
    NUM_FITS,
    are_horizontal,
    are_vertical,
    bisquare,
    find_heading,
    horizontal_toward,
    unit_axis,
)
from torchrg.regions.fit import canonicalize_sign
from torchrg.structures import Cloud, Planes, Segmentation

_MAX_TILT = math.radians(30.0)
"""Maximum tilt of a room, in radians: a larger one could mistake a wall for the floor."""


@default_device_cpu()
def align_axes(seg: Segmentation | Planes, *, up: Sequence[float] | str = "z") -> Tensor:
    r"""Compute the rigid transform that makes a room upright and axis-aligned.

    Up is the unit vector :math:`u` that minimizes, over planes of area :math:`a` and unit normal
    :math:`n`,

    .. math:: \sum_{\mathrm{horizontal}} a w \|n \times u\|^2 +
        \sum_{\mathrm{vertical}} a w (n \cdot u)^2,

    where the weights (Tukey's bisquare) fall to 0 at 3 degrees, which excludes sloped ceilings and
    leaning shelves. The initial direction is the normal within 30 degrees of ``up`` that most area
    agrees with. The x axis follows the walls: it is the direction of vertical planes, modulo 90
    degrees, with most area, fitted in the same way. Among the four possible rotations, the smallest
    about up is used. The lowest horizontal plane (the floor) is at z = 0; the center of the
    bounding box of axis-aligned planes is at x = y = 0. If the origin is far from the cloud,
    transform the points in float64.

    Args:
        seg: A segmentation or its plane table.
        up: Upward direction to within 30 degrees, as three numbers or an axis name.

    Returns:
        A rigid transform, shape ``(4, 4)``, float64: ``points @ motion[:3, :3].T + motion[:3, 3]``.

    Raises:
        ConfigError: If ``up`` is not a direction, or no plane is horizontal or vertical.

    Warns:
        UserWarning: If there are no walls to define x and y.

    Example:
        >>> from torchrg import segment_planes
        >>> from torchrg.scenes import make_room
        >>> room = make_room(num_points=5_000, seed=0)
        >>> turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
        >>> motion = align_axes(segment_planes(room.points @ turn.T))
        >>> torch.allclose(motion[:3, :3].float() @ turn, torch.eye(3), atol=0.01)
        True
    """
    planes = seg.planes if isinstance(seg, Segmentation) else seg
    check_kinds("align_axes", "pass a result of segment_planes", planes=(planes, Planes))
    upwards = unit_direction("align_axes", up)
    normals = planes.normal.cpu().double()
    areas = torch.where(planes.curved.cpu(), 0.0, planes.area.cpu().double())
    axis = _find_up(normals, areas, upwards)
    heading = find_heading(normals, areas, axis)
    if heading is None:
        warn(
            "align_axes: expected vertical planes (walls) to define x and y, got none large "
            "enough. Only the up axis is aligned."
        )
        heading = horizontal_toward(unit_axis(upwards), axis)
    rotation = torch.stack([heading, torch.linalg.cross(axis, heading), axis])
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = rotation
    motion[:3, 3] = -_origin(planes, rotation)
    return motion


def transform_planes(planes: Planes, motion: Tensor) -> Planes:
    """Apply a rigid transform ``(4, 4)`` to a plane table.

    Normals keep the canonical sign of plane tables.
    """
    check_rigid("transform_planes", "motion", motion)
    dtype = planes.normal.dtype
    motion = motion.to(planes.normal.device)
    rotation, shift = motion[:3, :3], motion[:3, 3]

    def rotate(vectors: Tensor) -> Tensor:
        return vectors.double() @ rotation.T

    def transform(points: Tensor) -> Tensor:
        return (rotate(points) + shift).to(dtype)

    normal = canonicalize_sign(rotate(planes.normal))
    center = rotate(planes.center) + shift
    # A nearby point of the plane keeps precision if the origin is far away.
    before, near = planes.normal.double(), planes.center.double()
    height = (near * before).sum(dim=1) - planes.offset.double()
    foot = near - before * height[:, None]
    outline = planes.outline
    if outline is not None:
        outline = tuple(tuple(transform(ring) for ring in rings) for rings in outline)
    return replace(
        planes,
        normal=normal.to(dtype),
        offset=((rotate(foot) + shift) * normal).sum(dim=1).to(dtype),
        centroid=transform(planes.centroid),
        center=center.to(dtype),
        axes=rotate(planes.axes).to(dtype),
        outline=outline,
    )


def transform_cloud(cloud: Cloud, motion: Tensor) -> Cloud:
    """Apply a rigid transform ``(4, 4)`` to the coordinates and normals of a cloud.

    Positions in the file header, such as a viewpoint or a coordinate system, are dropped.
    """
    check_rigid("transform_cloud", "motion", motion)
    rotation, coordinates, finite = motion[:3, :3].numpy(), cloud.coordinates.copy(), cloud.finite
    # Rotate about the cloud origin: large offsets would lose digits in the rotation.
    shift = motion[:3, 3].numpy() + rotation @ cloud.origin
    coordinates[finite] = (cloud.coordinates[finite] - cloud.origin) @ rotation.T + shift
    fields = dict(cloud.fields)
    for name in ("normals", "normals_input"):
        if name in fields:
            fields[name] = (fields[name] @ rotation.T).astype(fields[name].dtype)
    front = None if cloud.front is None else (cloud.front @ rotation.T).astype(cloud.front.dtype)
    return replace(cloud, coordinates=coordinates, fields=fields, header={}, front=front)


def _find_up(normals: Tensor, areas: Tensor, upwards: Tensor) -> Tensor:
    """Return the direction to which most area is horizontal or vertical; see :func:`align_axes`."""
    candidates = normals[are_horizontal(normals, upwards, _MAX_TILT) & (areas > 0)]
    if not len(candidates):
        # Without a floor or ceiling, up is perpendicular to the wall normals.
        weights = areas * are_vertical(normals, upwards, _MAX_TILT)
        spread = weights[:, None, None] * normals[:, :, None] * normals[:, None, :]
        values, vectors = eigh3_lapack(spread.sum(dim=0))
        if not bool(values[1] > MIN_FRACTION * values[2]) or values[2] == 0:
            raise ConfigError(
                "align_axes: expected a floor, a ceiling, or walls in two directions, got none "
                f"within {math.degrees(_MAX_TILT):g} degrees of up. Segment the cloud first, or "
                "pass up."
            )
        candidates = vectors[:, 0][None]
    agreeing = [_agreeing_area(normals, areas, axis) for axis in candidates]
    axis = candidates[int(torch.stack(agreeing).argmax())]
    for _ in range(NUM_FITS):
        lengths = (normals @ axis).abs().clamp(max=1)
        flat, across = areas * bisquare(lengths.acos()), areas * bisquare(lengths.asin())
        spread = normals[:, :, None] * normals[:, None, :]
        matrix = ((across - flat)[:, None, None] * spread).sum(dim=0)
        axis = eigh3_lapack(matrix)[1][:, 0]
        axis = axis * torch.sign(axis @ upwards)
    return axis


def _agreeing_area(normals: Tensor, areas: Tensor, axis: Tensor) -> Tensor:
    """Return the area of planes that are horizontal or vertical if this direction is up."""
    lengths = (normals @ axis).abs().clamp(max=1)
    return (areas * (bisquare(lengths.acos()) + bisquare(lengths.asin()))).sum()


def _origin(planes: Planes, rotation: Tensor) -> Tensor:
    """Return the new origin in rotated coordinates: center in x and y, floor in z."""
    axes = planes.axes.cpu().double() @ rotation.T
    half_extent = (planes.extent.cpu().double()[:, :, None] * axes).abs().sum(dim=1) / 2
    center = planes.center.cpu().double() @ rotation.T
    # The bounding box of a diagonal rectangle exceeds its content.
    axis_aligned = (axes.abs().amax(dim=2) > math.cos(MAX_ANGLE)).all(dim=1)
    used = axis_aligned if bool(axis_aligned.any()) else torch.ones_like(axis_aligned)
    low, high = (center - half_extent)[used].amin(dim=0), (center + half_extent)[used].amax(dim=0)
    area = planes.area.cpu().double()
    floors = are_horizontal(planes.normal.cpu(), rotation[2], MAX_ANGLE)
    floors &= area > MIN_FRACTION * area.sum()
    if bool(floors.any()):
        low[2] = center[floors, 2].amin()
    return torch.stack([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
