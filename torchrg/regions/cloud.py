"""The cloud that growth reads, checked and in canonical order."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.regions.criteria import neighborhood_radii
from torchrg.structures import Neighbors


class GrowingCloud(NamedTuple):
    """What growth reads: a cloud in canonical order with everything known about its points.

    Coordinates and normals are fast to gather when each column is contiguous.

    Attributes:
        points: Shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``.
        curvature: Shape ``(N,)``.
        neighbors: Neighbours of each point.
        valid: Points that may belong to a region, shape ``(N,)``, bool.
        colors: Shape ``(N, C)``, floating point, or None.
        reach: Distance from its plane within which a neighbour lies on it, shape ``(N,)``, infinite
            where that is not known, or None.
    """

    points: Tensor
    normals: Tensor
    curvature: Tensor
    neighbors: Neighbors
    valid: Tensor
    colors: Tensor | None = None
    reach: Tensor | None = None


def checked_cloud(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    valid: Tensor | None,
    colors: Tensor | NDArray[np.generic] | None,
) -> GrowingCloud:
    """Check what the user passed to ``grow_regions``, and settle which points are valid.

    Returns:
        The cloud, in the order it came in, without ``reach``.

    Raises:
        ShapeError: If a shape, dtype or device is not as :func:`torchrg.grow_regions` says.
    """
    caller = "grow_regions"
    points = as_tensor(caller, "points", points).detach()
    normals = as_tensor(caller, "normals", normals).detach()
    curvature = as_tensor(caller, "curvature", curvature).detach()
    valid = None if valid is None else as_tensor(caller, "valid", valid)
    colors = None if colors is None else as_tensor(caller, "colors", colors)
    check_shapes(
        caller,
        points=(points, "N 3"),
        normals=(normals, "N 3"),
        curvature=(curvature, "N"),
        neighbors=(neighbors.indices, "N K"),
        neighbors_valid=(neighbors.valid, "N K"),
        valid=(valid, "N"),
        colors=(colors, "N C"),
    )
    check_floating(caller, points=points, normals=normals, curvature=curvature)
    if valid is not None and valid.dtype != torch.bool:
        raise ShapeError(f"{caller}: expected valid of bool, got {valid.dtype}.")
    if neighbors.indices.device != points.device:
        raise ShapeError(
            f"{caller}: expected points and neighbors on one device, got {points.device} and "
            f"{neighbors.indices.device}."
        )
    finite = normals.isfinite().all(dim=1) & curvature.isfinite()
    valid = finite if valid is None else finite & valid
    colors = None if colors is None else _by_column(colors.to(points.dtype))
    return GrowingCloud(
        _by_column(points), _by_column(normals), curvature, neighbors, valid, colors
    )


def reordered(cloud: GrowingCloud, order: Tensor) -> GrowingCloud:
    """Return the cloud with its points, and the rows its neighbours name, in another order.

    Args:
        cloud: The cloud.
        order: Old row of each new one, shape ``(N,)``.
    """
    row_of = torch.empty(len(order), dtype=torch.int32, device=order.device)
    row_of[order] = torch.arange(len(order), dtype=torch.int32, device=order.device)
    indices = cloud.neighbors.indices[order]
    indices = row_of.index_select(0, indices.reshape(-1)).view(indices.shape)
    mask = cloud.neighbors.valid
    return GrowingCloud(
        _by_column(cloud.points[order]),
        _by_column(cloud.normals[order]),
        cloud.curvature[order],
        Neighbors(indices, None if mask is None else mask[order]),
        cloud.valid[order],
        None if cloud.colors is None else _by_column(cloud.colors[order]),
        None if cloud.reach is None else cloud.reach[order],
    )


def plane_reach_of(
    cloud: GrowingCloud, residual_rms: Tensor | NDArray[np.floating] | None, config: GrowingConfig
) -> Tensor:
    """Return how far from each point's plane a neighbour may be.

    Args:
        cloud: The cloud.
        residual_rms: Root mean square distance of the neighbours from the planes, shape ``(N,)``.
        config: Settings, with ``plane_reach``.

    Returns:
        Shape ``(N,)``: so many times the residual; infinite where the fit is exact, which is to say
        that nothing is known of the noise.

    Raises:
        ConfigError: If the residuals are missing.
        ShapeError: If their shape or dtype is not that of the points.
    """
    if residual_rms is None or config.plane_reach is None:
        raise ConfigError(
            "grow_regions: expected residual_rms, which plane_reach needs, got None; pass that of "
            "the normals or set plane_reach to None."
        )
    caller = "grow_regions"
    residual_rms = as_tensor(caller, "residual_rms", residual_rms).detach()
    check_shapes(caller, points=(cloud.points, "N 3"), residual_rms=(residual_rms, "N"))
    check_floating(caller, points=cloud.points, residual_rms=residual_rms)
    floor = config.coplanarity_floor * neighborhood_radii(cloud.points, cloud.neighbors)
    return torch.where(residual_rms > floor, config.plane_reach * residual_rms, torch.inf)


def _by_column(vectors: Tensor) -> Tensor:
    """Return vectors ``(N, C)`` laid out column by column."""
    return vectors.T.contiguous().T
