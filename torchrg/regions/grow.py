"""Region growing: from points, normals and neighbours to labels."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.config import GrowingConfig
from torchrg.errors import ConfigError
from torchrg.neighbors import canonical_order
from torchrg.regions.cloud import GrowingCloud, checked_cloud, plane_reach_of, reordered
from torchrg.regions.components import claim_leftovers, first_to_reach
from torchrg.regions.edges import EdgeFinder
from torchrg.regions.frontier import grow_in_turn
from torchrg.regions.graph import pack_edges
from torchrg.regions.refine import refine_regions
from torchrg.structures import UNLABELED, Neighbors


def grow_regions(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    config: GrowingConfig | None = None,
    *,
    valid: Tensor | None = None,
    colors: Tensor | NDArray[np.generic] | None = None,
    residual_rms: Tensor | NDArray[np.floating] | None = None,
    canonical: bool = False,
    chunk_size: int = 16384,
) -> Tensor:
    """Grow regions of similar normals, in the order of ascending curvature (Algorithm 2) [1].

    A region starts at the free point of least curvature. Each of its seeds claims those of its free
    neighbours that pass the criteria of the settings; a claimed point becomes a seed if the seed
    rule holds.

    Convention:
        All limits are inclusive. The curvature limit is the value at place
        ``floor(curvature_quantile * (n - 1))`` of the sorted curvatures of the n valid points.
        Equal curvatures are taken in canonical order. Labels are 0 to M-1 by descending size,
        regions of equal size by their first point in canonical order. They do not depend on the
        order of the points (exact duplicates may swap) or on chunk size.

    Args:
        points: Finite points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``; their sign only matters for ``signed_normals``.
        curvature: Surface variation, shape ``(N,)``.
        neighbors: Neighbours of each point, as :func:`torchrg.search_knn` gives them.
        config: Settings. Default: the paper's.
        valid: Points that have a normal, shape ``(N,)``, bool; the others join no region, and no
            region passes through them. Default: all. Points whose normal or curvature is not
            finite never join.
        colors: Colours of the points, shape ``(N, C)``, for ``max_color_distance``.
        residual_rms: How far the neighbours are from the planes of the points, shape ``(N,)``, as a
            :class:`torchrg.structures.NormalFit` has it, for ``plane_reach``.
        canonical: Whether the points already are in canonical order; saves a copy.
        chunk_size: Points handled at a time.

    Returns:
        Labels, shape ``(N,)``, int64; :data:`torchrg.UNLABELED` for points of no region and of
        regions smaller than ``min_size``.

    Raises:
        ShapeError: If a shape, dtype or device is not as above.
        ConfigError: If the settings ask for colours or residuals, and there are none.

    References:
        [1] T. Rabbani, F. van den Heuvel, G. Vosselman. Segmentation of point clouds using
        smoothness constraint. ISPRS Commission V Symposium, 2006.

    Example:
        >>> points = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> normals, curvature = torch.eye(3)[[2] * 16], torch.zeros(16)
        >>> neighbors = Neighbors(torch.arange(16).expand(16, 16))
        >>> grow_regions(points, normals, curvature, neighbors, GrowingConfig(min_size=9)).unique()
        tensor([0])
    """
    cloud = checked_cloud(points, normals, curvature, neighbors, valid, colors)
    config = GrowingConfig() if config is None else config
    if config.max_color_distance is not None and colors is None:
        raise ConfigError(
            "grow_regions: expected colors, which max_color_distance needs, got None; pass them or "
            "set max_color_distance to None."
        )
    if config.plane_reach is not None:
        cloud = cloud._replace(reach=plane_reach_of(cloud, residual_rms, config))
    device = cloud.points.device
    if len(cloud.points) == 0:
        return torch.empty(0, dtype=torch.int64, device=device)
    order = None if canonical else canonical_order(cloud.points)
    if order is not None:
        cloud = reordered(cloud, order)
    labels = _labels(_grow(cloud, config, chunk_size), config.min_size, device)
    refined = refine_regions(cloud, labels, config)
    if refined is not labels:
        labels = _labels(refined.cpu().numpy(), config.min_size, device)
    return labels if order is None else torch.empty_like(labels).index_copy_(0, order, labels)


def _labels(heads: NDArray[np.integer], min_size: int, device: torch.device) -> Tensor:
    """Return the numbers of regions as a tensor."""
    return torch.from_numpy(number_by_size(heads, min_size)).to(device)


def curvature_limit(curvature: Tensor, quantile: float) -> Tensor:
    """Return the lower quantile of curvatures: one of the values, as PCL's users take it.

    Args:
        curvature: Curvatures of the valid points, shape ``(n,)``.
        quantile: Share in [0, 1].

    Returns:
        The value at place ``floor(quantile * (n - 1))`` when sorted, a scalar; 0 where n is 0.

    Example:
        >>> curvature_limit(torch.tensor([0.3, 0.1, 0.2]), 0.95).item() < 0.21
        True
    """
    if len(curvature) == 0:
        return curvature.new_zeros(())
    return curvature.kthvalue(int(quantile * (len(curvature) - 1)) + 1).values


def number_by_size(heads: NDArray[np.integer], min_size: int) -> NDArray[np.int64]:
    """Number regions by descending size, those of equal size by their first point.

    Args:
        heads: Any number that is the same in a region and another elsewhere, below N; -1 for none.
        min_size: Smaller regions get :data:`torchrg.UNLABELED`.

    Returns:
        Labels, shape ``(N,)``.

    Example:
        >>> number_by_size(np.array([3, 1, 1, 3, -1, 2, 1]), 2).tolist()
        [1, 0, 0, 1, -1, -1, 0]
    """
    placed = np.flatnonzero(heads >= 0)
    sizes = np.bincount(heads[placed], minlength=len(heads))
    firsts = np.full(len(heads), len(heads))
    firsts[heads[placed][::-1]] = placed[::-1]
    kept = np.flatnonzero(sizes >= max(min_size, 1))
    kept = kept[np.lexsort((firsts[kept], -sizes[kept]))]
    # The last entry is what a head of -1 finds.
    numbers = np.full(len(heads) + 1, UNLABELED, dtype=np.int64)
    numbers[kept] = np.arange(len(kept))
    labels: NDArray[np.int64] = numbers[heads]
    return labels


def _grow(cloud: GrowingCloud, config: GrowingConfig, chunk_size: int) -> NDArray[np.int32]:
    """Return the head of each point's region, by whichever way the settings allow."""
    curvature, valid = cloud.curvature.cpu().numpy(), cloud.valid.cpu().numpy()
    order = np.argsort(curvature, kind="stable").astype(np.int32)
    order = order[valid[order]]
    limit = curvature_limit(cloud.curvature[cloud.valid], config.curvature_quantile)
    finder = EdgeFinder(cloud, config, limit)
    num_points, k = cloud.neighbors.indices.shape
    if not config.is_order_free:
        edges = pack_edges(
            finder.coded,
            num_points,
            capacity=num_points * k,
            chunk_size=chunk_size,
            device=cloud.points.device,
        )
        return grow_in_turn(edges, order, valid)
    seeds = order[curvature[order] <= limit.cpu().numpy()]
    edges = pack_edges(
        finder.spreading,
        num_points,
        capacity=num_points * k + 2 * len(seeds),
        chunk_size=chunk_size,
        device=cloud.points.device,
    )
    heads = first_to_reach(edges, seeds, num_points)
    # A point that does not spread claims at most its k - 1 neighbours.
    if config.min_size <= k:
        claim_leftovers(*finder.others(), heads, order)
    return heads
