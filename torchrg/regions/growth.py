"""Region growing from points, normals and neighbors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._checks import as_tensor, check_floating, check_shapes, eager_only
from torchrg._parallel import CHUNK_SIZE, limit_rows
from torchrg.config import AnyConfig, GrowingConfig, settings_of
from torchrg.errors import ConfigError, ShapeError
from torchrg.linalg.moments import to_column_major
from torchrg.linalg.precision import is_single, to_single
from torchrg.neighbors import canonical_order, measure_sampling
from torchrg.neighbors.knn import check_neighbors
from torchrg.neighbors.order import ascending_rows
from torchrg.regions.adjacency import KnnAdjacency
from torchrg.regions.edges import GrowingInput, has_late_promotion, mark_edges, neighborhood_radii
from torchrg.regions.fit import MIN_FITTED, RegionFits, find_solid_regions
from torchrg.regions.repair import keep_regions, merge_facets, refine_regions, remove_small
from torchrg.regions.splits import cut_bridges, split_levels
from torchrg.structures import UNLABELED, AnyCloud, Neighbors
from torchrg.structures.points import Colors, Points, Values

_ROOTS_AT_ONCE = 1024
"""Number of roots between two releases of memory-mapped arrays. Each root may map about 200 kB of
neighbor lists."""


@eager_only
def grow_regions(
    points: AnyCloud,
    normals: Points,
    curvature: Values,
    neighbors: Neighbors,
    config: GrowingConfig | AnyConfig | None = None,
    *,
    valid: Tensor | None = None,
    residual_rms: Values | None = None,
    colors: Colors | None = None,
    max_color_distance: float = math.inf,
    signed_normals: bool = False,
    canonical: bool = False,
    chunk_size: int = CHUNK_SIZE,
    **changes: Any,  # noqa: ANN401
) -> Tensor:
    """Grow regions of similar normals in order of ascending curvature (Algorithm 2) [1].

    A region starts at the unassigned point of lowest curvature. Each seed claims its unassigned
    neighbors that pass the configured criteria; a claimed point becomes a seed if the seed rule
    holds. With ``connectivity_scope="seed"``, the seed and the point must also be connected. If the
    claiming seed is not connected to the point, a later seed of the region may still promote it;
    without this late promotion, regions fragment.

    Convention:
        All limits are inclusive. The curvature limit is the value at index
        ``floor(curvature_quantile * (n - 1))`` of the sorted curvatures of the n valid points.
        Equal curvatures are taken in canonical order. Labels are 0 to M-1 by descending size, ties
        by first point in canonical order. They do not depend on the point order (exact duplicates
        may swap) or on the chunk size.

    Args:
        points: Finite points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``; the sign only matters with ``signed_normals``.
        curvature: Surface variation, shape ``(N,)``.
        neighbors: Neighbors of each point from :func:`torchrg.search_knn`, the point itself first.
            Remove duplicates before the search (:func:`torchrg.neighbors.distinct_points`), as
            :func:`torchrg.segment_planes` does, because duplicates are neighbors of each other.
        config: A growing configuration, a dictionary, a complete configuration, or a preset name.
            Default: that of :func:`torchrg.load_config`, which requires ``residual_rms``.
        valid: Mask of the points with a normal, shape ``(N,)``, bool. Invalid points, and points
            with a non-finite normal or curvature, belong to no region. Default: all are valid.
        residual_rms: RMS distance of the neighbors to each point's plane, shape ``(N,)``, as in
            :class:`torchrg.structures.NormalFit`; required for ``plane_reach``.
        colors: Colors of the points, shape ``(N, C)``.
        max_color_distance: Maximum Euclidean color difference of a neighbor that joins, in color
            units. Default: colors are ignored.
        signed_normals: Whether opposite normals differ by 180 degrees instead of 0 (for oriented
            normals), which separates the two sides of a thin wall.
        canonical: Whether the points are already in canonical order; saves a copy.
        chunk_size: Points processed at a time; fewer with more than 64 neighbors.
        **changes: Individual parameters, as in ``max_angle_deg=7``.

    Returns:
        Labels, shape ``(N,)``, int64; :data:`torchrg.UNLABELED` for unassigned points and regions
        smaller than ``min_size``.

    Raises:
        ShapeError: If a shape, dtype or device is invalid.
        ConfigError: If required residuals or colors are missing, or a parameter is invalid.

    References:
        [1] T. Rabbani, F. van den Heuvel, G. Vosselman. Segmentation of point clouds using
        smoothness constraint. ISPRS Commission V Symposium, 2006.

    Example:
        >>> from torchrg import search_knn
        >>> points = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> normals, curvature = torch.eye(3)[[2] * 16], torch.zeros(16)
        >>> neighbors = search_knn(points, 16)
        >>> labels = grow_regions(
        ...     points, normals, curvature, neighbors, GrowingConfig(min_size=9),
        ...     residual_rms=torch.zeros(16),
        ... )
        >>> labels.unique()
        tensor([0])
    """
    settings = config
    if not isinstance(settings, GrowingConfig) or changes:
        settings = settings_of("grow_regions", GrowingConfig, config, changes)
    cloud = checked_cloud(settings, points, normals, curvature, neighbors, valid, residual_rms)
    cloud = cloud._replace(signed_normals=signed_normals)
    if max_color_distance < math.inf:
        cloud = _add_colors(cloud, colors, max_color_distance)
    if len(cloud.points) == 0:
        return torch.empty(0, dtype=torch.int64, device=cloud.points.device)
    chunk_size = limit_rows(chunk_size, neighbors.indices.shape[1])
    order = None if canonical else canonical_order(cloud.points)
    if order is not None:
        row_of = torch.empty(len(order), dtype=torch.int32, device=order.device)
        row_of[order] = torch.arange(len(order), dtype=torch.int32, device=order.device)
        lists = cloud.neighbors.select(order)
        cloud = cloud.select(order, lists._replace(indices=lists.gather(row_of)))
    if needs_sampling(settings):
        settings = settings.with_sampling(measure_sampling(cloud.points, cloud.neighbors))
    labels = label_regions(cloud, grow(cloud, settings, chunk_size), settings, chunk_size)
    return labels if order is None else torch.empty_like(labels).index_copy_(0, order, labels)


def needs_sampling(config: GrowingConfig) -> bool:
    """Return whether a parameter is ``auto``, resolved by :func:`measure_sampling`."""
    faceted = config.faceted if config.facet_tolerance is not None else False
    return "auto" in (config.min_size, config.facet_tolerance, faceted)


def label_regions(
    cloud: GrowingInput, roots: Tensor, config: GrowingConfig, chunk_size: int
) -> Tensor:
    """Return region labels after the enabled split and refinement steps."""
    min_points = int(config.min_size)
    if config.absorb:
        # A region may reach ``min_size`` only after boundary assignment.
        min_points = min(min_points, max(min_points // 2, MIN_FITTED))
    # Facets of any size can be merged into a large surface.
    fitted = min_points if config.facet_tolerance is None else min(min_points, MIN_FITTED)
    labels, fits = rank_by_size(roots, fitted), RegionFits(cloud, config)

    def grow_cores(part: GrowingInput) -> Tensor:
        return rank_by_size(grow(part, config, chunk_size), int(config.min_size))

    if config.cut_bridges:
        cut = cut_bridges(cloud, labels, fits.get(labels), config, chunk_size, grow_cores)
        labels = labels if cut is labels else rank_by_size(cut, fitted)
    if config.facet_tolerance is not None:
        contacts = KnnAdjacency(cloud.neighbors).contacts(labels)
        merged = merge_facets(labels, contacts, fits.get(labels), config)
        # Unchanged labels are ranked already.
        rank = remove_small if merged is labels else rank_by_size
        labels = rank(merged, min_points)
    if config.cut_bridges:
        split = split_levels(cloud, labels, fits.get(labels), config)
        labels = labels if split is labels else rank_by_size(split, 1)
    if config.absorb or config.merge_coplanar or config.max_plane_residual is not None:
        labels = rank_by_size(refine_regions(cloud, labels, config, fits), int(config.min_size))
    solid = find_solid_regions(cloud, labels)
    return keep_regions(labels, ~solid) if bool(solid.any()) else labels


def checked_cloud(
    config: GrowingConfig,
    points: AnyCloud,
    normals: Points,
    curvature: Values,
    neighbors: Neighbors,
    valid: Tensor | None,
    residual_rms: Values | None,
) -> GrowingInput:
    """Validate the arguments of :func:`grow_regions`, keeping the point order."""
    caller = "grow_regions"
    points = as_tensor(caller, "points", points).detach()
    normals = as_tensor(caller, "normals", normals).detach()
    curvature = as_tensor(caller, "curvature", curvature).detach()
    valid = None if valid is None else as_tensor(caller, "valid", valid)
    vectors = {"points": (points, "N 3"), "normals": (normals, "N 3")}
    check_shapes(caller, **vectors, curvature=(curvature, "N"), valid=(valid, "N"))
    check_floating(caller, points=points, normals=normals, curvature=curvature)
    check_neighbors(caller, neighbors, points)
    if valid is not None and valid.dtype != torch.bool:
        raise ShapeError(f"{caller}: expected valid of bool, got {valid.dtype}.")
    # Normals of another source may have more digits, which decide at the limits.
    is_estimated = is_single(normals) and is_single(curvature)
    positions, reach, radii = to_single(points) if is_estimated else points, None, None
    normals, curvature = normals.to(positions), curvature.to(positions)
    if config.plane_reach is not None:
        if residual_rms is None:
            raise ConfigError(
                f"{caller}: expected residual_rms (required by plane_reach), got None. Pass "
                "residual_rms of the normals, or set plane_reach to None."
            )
        residual_rms = as_tensor(caller, "residual_rms", residual_rms).detach()
        check_shapes(caller, points=(points, "N 3"), residual_rms=(residual_rms, "N"))
        check_floating(caller, residual_rms=residual_rms)
        # The noise is unknown if the fit is exact.
        residual_rms = residual_rms.to(positions)
        radii = scratch.store(neighborhood_radii(positions, neighbors))
        floor = config.coplanarity_floor * radii
        reach = torch.where(residual_rms > floor, config.plane_reach * residual_rms, torch.inf)
    positions, normals = to_column_major(positions), to_column_major(normals)
    valid = curvature.isfinite() if valid is None else curvature.isfinite() & valid
    for column in normals.unbind(dim=1):
        valid &= column.isfinite()
    columns = positions, normals, curvature, neighbors, valid, reach
    return GrowingInput(*columns, radii=radii)


def _add_colors(cloud: GrowingInput, colors: Colors | None, max_distance: float) -> GrowingInput:
    """Return the cloud with colors and the maximum color difference."""
    if colors is None or max_distance < 0:
        raise ConfigError(
            "grow_regions: expected colors and max_color_distance >= 0, got "
            f"{max_distance!r} and {'no' if colors is None else 'some'} colors."
        )
    colors = as_tensor("grow_regions", "colors", colors)
    check_shapes("grow_regions", points=(cloud.points, "N 3"), colors=(colors, "N C"))
    colors = to_column_major(colors.to(cloud.points.dtype))
    return cloud._replace(colors=colors, max_color_distance=max_distance)


def rank_by_size(regions: Tensor, min_size: int) -> Tensor:
    """Number regions by descending size, ties by first point.

    ``regions`` ``(N,)`` holds one integer below N per region, -1 if unassigned. Regions smaller
    than ``min_size`` become :data:`torchrg.UNLABELED`.
    """
    old = regions.cpu().numpy()
    # Count runs of equal labels at once: many are long.
    is_end = np.ones(len(old) + 1, dtype=bool)
    np.not_equal(old[1:], old[:-1], out=is_end[1:-1])
    ends = np.flatnonzero(is_end)
    starts, lengths = ends[:-1], ends[1:] - ends[:-1]
    run_labels = old[starts]
    num = int(run_labels.max(initial=UNLABELED)) + 1
    sizes = np.bincount(run_labels + 1, lengths, minlength=num + 1)[1:]
    large = np.flatnonzero(sizes >= max(min_size, 1))
    firsts = np.empty(num + 1, dtype=np.int32)
    # The last of several writes to an index wins: in reverse order, the first.
    firsts[run_labels[::-1]] = starts[::-1]
    large = large[np.lexsort((firsts[large], -sizes[large]))]
    # The last entry is selected by -1.
    numbers = np.full(num + 1, UNLABELED)
    numbers[large] = np.arange(len(large))
    ranked = torch.from_numpy(np.repeat(numbers[run_labels], lengths))
    return scratch.store(ranked).to(regions.device)


def rank_by_count(labels: Tensor) -> Tensor:
    """Return new region numbers by descending point count, ties in the old order.

    ``labels`` ``(N,)`` are per point, -1 if unlabeled. The last of the numbers ``(M + 1,)`` belongs
    to -1, so that labels can index them.
    """
    counts = torch.bincount(labels + 1, minlength=1)[1:]
    numbers = counts.argsort(descending=True, stable=True).argsort()
    return torch.cat([numbers, numbers.new_tensor([UNLABELED])])


def grow(cloud: GrowingInput, config: GrowingConfig, chunk_size: int) -> Tensor:
    """Return the root of each point's region ``(N,)``, which is its first point, or -1.

    Invalid points, and some points of regions below ``min_size``, have no root.
    """
    columns = (cloud.curvature, cloud.valid, cloud.neighbors.indices)
    curvature, valid, indices = (column.cpu() for column in columns)
    # Invalid points are last.
    curvature, num_valid = curvature.where(valid, torch.inf), int(torch.count_nonzero(valid))
    order = ascending_rows(curvature)
    limit = curvature[order[max(int(config.curvature_quantile * (num_valid - 1)), 0)]]
    is_seed, order = curvature <= limit, order[:num_valid].int()
    on_device = limit.to(cloud.points.device)
    joins, makes_seed = mark_edges(cloud, config, on_device, chunk_size=chunk_size)
    if makes_seed is None and int(config.min_size) > indices.shape[1]:
        order = order[: int(torch.count_nonzero(is_seed))]
    tables, late = (indices, joins, makes_seed, is_seed, valid), has_late_promotion(config)
    if kernels.serve(indices, valid):
        roots = torch.full(valid.shape, UNLABELED, dtype=torch.int32, device="cpu")
        queue = torch.empty_like(roots)
        at_once = _ROOTS_AT_ONCE if scratch.is_active() else max(len(order), 1)
        for batch in torch.split(order, at_once):
            kernels.call("grow_regions", *tables, batch, late, roots, queue)
            scratch.release()
    else:
        roots = grow_fifo(*tables, order, late=late)
    return roots.to(cloud.points.device)


def grow_fifo(
    neighbors: Tensor,
    joins: Tensor,
    makes_seed: Tensor | None,
    is_seed: Tensor,
    valid: Tensor,
    order: Tensor,
    *,
    late: bool,
) -> Tensor:
    """Grow regions one after another, each from a FIFO queue of seeds (Algorithm 2).

    The first seed in the queue with an edge to a point claims it. The point becomes a seed if
    ``makes_seed`` is set for this edge or, if it is None, if ``is_seed`` is set for the point.
    :func:`mark_edges` returns ``joins`` and ``makes_seed``. With ``late`` promotion, any edge of
    the region may promote a point; all other points are claimed after all seeds are known.

    Returns the root of each point's region.
    """
    lists, free = neighbors.numpy(), valid.numpy().copy()
    roots = np.full(len(free), UNLABELED, dtype=np.int32)
    width = lists.shape[1]
    joined = _unpack(joins, width)
    promotes = is_seed.numpy()[lists] if makes_seed is None else _unpack(makes_seed, width)

    for root in order.numpy():
        if not free[root]:
            continue
        free[root], roots[root], queue = False, root, [root]
        for seeds_alone in (True, False) if late else (False,):
            for seed in queue:
                claims = joined[seed] & free[lists[seed]]
                if seeds_alone:
                    claims &= promotes[seed]
                targets = lists[seed][claims]
                free[targets], roots[targets] = False, root
                if seeds_alone or not late:
                    queue.extend(targets[promotes[seed][claims]])
    return torch.from_numpy(roots)


def _unpack(bits: Tensor, width: int) -> NDArray[np.bool_]:
    """Return the bits of words ``(N, words)``, one for each of ``width`` neighbors."""
    flags = np.unpackbits(bits.numpy().view(np.uint8), axis=1, count=width, bitorder="little")
    return flags.view(np.bool_)
