"""Region growing: from points, normals and neighbours to labels."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._checks import as_tensor, check_floating, check_shapes, of_clouds
from torchrg._parallel import (
    CHUNK_SIZE,
    ROWS_AT_ONCE,
    chunks_of,
    sequential_operations,
)
from torchrg.config import AnyConfig, GrowingConfig, settings_of
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import ascending_rows, canonical_order, check_neighbors, measure_sampling
from torchrg.regions.adjacency import NearestPoints
from torchrg.regions.edges import GrowingCloud, mark_edges, neighborhood_radii, promotes_late
from torchrg.regions.fit import MIN_FITTED, RegionFits
from torchrg.regions.repair import merge_facets, refine_regions
from torchrg.regions.splits import cut_bridges, find_mixed_regions, split_levels
from torchrg.structures import UNLABELED, Neighbors

_ROOTS_AT_ONCE = 1024
"""Points that regions begin at between two releases of what is on a disk. Where each reads a list
for itself, the system maps some 200 kB around it."""


@of_clouds
@sequential_operations()
def grow_regions(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    config: GrowingConfig | AnyConfig | None = None,
    *,
    valid: Tensor | None = None,
    residual_rms: Tensor | NDArray[np.floating] | None = None,
    colors: Tensor | NDArray[np.generic] | None = None,
    max_color_distance: float = math.inf,
    signed_normals: bool = False,
    canonical: bool = False,
    chunk_size: int = CHUNK_SIZE,
    **changes: Any,  # noqa: ANN401
) -> Tensor:
    """Grow regions of similar normals, in the order of ascending curvature (Algorithm 2) [1].

    A region starts at the free point of least curvature. Each of its seeds claims those of its free
    neighbours that pass the criteria of the settings; a claimed point becomes a seed if the seed
    rule holds. With ``connectivity_scope="seed"`` the two must also be connected, and where that
    fails for the seed that claimed the point, any later seed of its region may still make it one:
    without such late promotion regions shatter.

    Convention:
        All limits are inclusive. The curvature limit is the value at place
        ``floor(curvature_quantile * (n - 1))`` of the sorted curvatures of the n valid points.
        Equal curvatures are taken in canonical order. Labels are 0 to M-1 by descending size,
        regions of equal size by their first point in canonical order. They do not depend on the
        order of the points (exact duplicates may swap) or on chunk size.

    Args:
        points: Finite points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``; their sign only matters with ``signed_normals``.
        curvature: Surface variation, shape ``(N,)``.
        neighbors: Neighbours of each point, as :func:`torchrg.search_knn` gives them: the point
            itself first. Copies of points are neighbors there, so leave them out before the search
            (:func:`torchrg.neighbors.distinct_points`), as :func:`torchrg.segment_planes` does.
        config: Settings, a dictionary of them, a whole configuration, or the name of a preset.
            Default: that of :func:`torchrg.load_config`, which needs ``residual_rms``.
        valid: Points that have a normal, shape ``(N,)``, bool; no region passes through others, nor
            through points whose normal or curvature is not finite. Default: all.
        residual_rms: How far the neighbours are from the planes of the points, shape ``(N,)``, as a
            :class:`torchrg.structures.NormalFit` has it, for ``plane_reach``.
        colors: Colours of the points, shape ``(N, C)``.
        max_color_distance: A neighbour whose colour differs by more than this (Euclidean, in the
            unit of the colours) does not join. Default: colours play no part.
        signed_normals: Whether opposite normals, if oriented, differ by 180 degrees instead of 0,
            so that the two faces of a thin wall never join.
        canonical: Whether the points already are in canonical order; saves a copy.
        chunk_size: Points handled at a time.
        **changes: Single settings, as in ``max_angle_deg=7``.

    Returns:
        Labels, shape ``(N,)``, int64; :data:`torchrg.UNLABELED` for points of no region and of
        regions smaller than ``min_size``.

    Raises:
        ShapeError: If a shape, dtype or device is not as above.
        ConfigError: If residuals or colours are needed, and there are none, or a setting is wrong.

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
        cloud = _with_colors(cloud, colors, max_color_distance)
    if len(cloud.points) == 0:
        return torch.empty(0, dtype=torch.int64, device=cloud.points.device)
    order = None if canonical else canonical_order(cloud.points)
    if order is not None:
        cloud = _reordered(cloud, order)
    if needs_sampling(settings):
        settings = settings.at_sampling(measure_sampling(cloud.points, cloud.neighbors))
    labels = label_regions(cloud, grow(cloud, settings, chunk_size), settings, chunk_size)
    return labels if order is None else torch.empty_like(labels).index_copy_(0, order, labels)


def needs_sampling(config: GrowingConfig) -> bool:
    """Whether a setting is ``auto``, to be chosen by :func:`measure_sampling`."""
    faceted = config.faceted if config.facet_tolerance is not None else False
    return "auto" in (config.min_size, config.facet_tolerance, faceted)


def label_regions(
    cloud: GrowingCloud, roots: Tensor, config: GrowingConfig, chunk_size: int
) -> Tensor:
    """Return labels of regions that have grown, after all steps that the settings ask for."""
    least = int(config.min_size)
    if config.absorb:
        # A region may be large enough only with the points that it absorbs.
        least = min(least, max(least // 2, MIN_FITTED))
    # Facets make a face together, however small they are.
    fitted = least if config.facet_tolerance is None else min(least, MIN_FITTED)
    labels, fits = number_by_size(roots, fitted), RegionFits(cloud, config)
    if config.cut_bridges and bool((labels >= 0).any()):
        mixed = find_mixed_regions(cloud, labels, fits.of(labels), config, chunk_size)
        if mixed is not None:
            cores = number_by_size(grow(mixed.part, config, chunk_size), int(config.min_size))
            labels = cut_bridges(cloud, labels, mixed, cores, config, chunk_size)
            labels = number_by_size(labels, fitted)
    if config.facet_tolerance is not None and bool((labels >= 0).any()):
        contacts = NearestPoints(cloud.neighbors).contacts(labels)
        tolerance = float(config.facet_tolerance)
        labels = merge_facets(labels, contacts, fits.of(labels), tolerance=tolerance)
        labels = number_by_size(labels, least)
    if config.cut_bridges and bool((labels >= 0).any()):
        split = split_levels(cloud, labels, fits.of(labels), config)
        labels = labels if split is labels else number_by_size(split, 1)
    if config.absorb or config.merge_coplanar or config.max_plane_residual is not None:
        labels = number_by_size(refine_regions(cloud, labels, config, fits), int(config.min_size))
    return labels


def checked_cloud(
    config: GrowingConfig,
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    curvature: Tensor | NDArray[np.floating],
    neighbors: Neighbors,
    valid: Tensor | None,
    residual_rms: Tensor | NDArray[np.floating] | None,
) -> GrowingCloud:
    """Check what the user passed to :func:`grow_regions`, in the order it came in."""
    caller = "grow_regions"
    points = as_tensor(caller, "points", points).detach()
    normals = as_tensor(caller, "normals", normals).detach()
    curvature = as_tensor(caller, "curvature", curvature).detach()
    valid = None if valid is None else as_tensor(caller, "valid", valid)
    check_shapes(
        caller,
        points=(points, "N 3"),
        normals=(normals, "N 3"),
        curvature=(curvature, "N"),
        valid=(valid, "N"),
    )
    check_floating(caller, points=points, normals=normals, curvature=curvature)
    check_neighbors(caller, neighbors, points)
    if valid is not None and valid.dtype != torch.bool:
        raise ShapeError(f"{caller}: expected valid of bool, got {valid.dtype}.")
    reach = None
    if config.plane_reach is not None:
        if residual_rms is None:
            raise ConfigError(
                f"{caller}: expected residual_rms, which plane_reach needs, got None; pass that of "
                "the normals or set plane_reach to None."
            )
        residual_rms = as_tensor(caller, "residual_rms", residual_rms).detach()
        check_shapes(caller, points=(points, "N 3"), residual_rms=(residual_rms, "N"))
        check_floating(caller, points=points, residual_rms=residual_rms)
        # Where the fit is exact nothing is known of the noise.
        floor = config.coplanarity_floor * neighborhood_radii(points, neighbors)
        reach = torch.where(residual_rms > floor, config.plane_reach * residual_rms, torch.inf)
    finite = normals.isfinite().all(dim=1) & curvature.isfinite()
    valid = finite if valid is None else finite & valid
    columns = by_column(points), by_column(normals)
    return GrowingCloud(*columns, curvature, neighbors, valid, reach)


def _with_colors(
    cloud: GrowingCloud, colors: Tensor | NDArray[np.generic] | None, max_distance: float
) -> GrowingCloud:
    """Return the cloud with colours, and how much they may differ."""
    if colors is None or max_distance < 0:
        raise ConfigError(
            "grow_regions: expected colors and max_color_distance >= 0, got "
            f"{max_distance!r} and {'no' if colors is None else 'some'} colors."
        )
    colors = as_tensor("grow_regions", "colors", colors)
    check_shapes("grow_regions", points=(cloud.points, "N 3"), colors=(colors, "N C"))
    colors = by_column(colors.to(cloud.points.dtype))
    return cloud._replace(colors=colors, max_color_distance=max_distance)


def _reordered(cloud: GrowingCloud, order: Tensor) -> GrowingCloud:
    """Return the cloud, and the rows its neighbours name, in an order ``(N,)`` of old rows."""
    row_of = torch.empty(len(order), dtype=torch.int32, device=order.device)
    row_of[order] = torch.arange(len(order), dtype=torch.int32, device=order.device)
    neighbors = cloud.neighbors.at(order)
    return cloud._replace(
        points=by_column(cloud.points[order]),
        normals=by_column(cloud.normals[order]),
        curvature=cloud.curvature[order],
        neighbors=neighbors._replace(indices=neighbors.of(row_of)),
        valid=cloud.valid[order],
        reach=None if cloud.reach is None else cloud.reach[order],
        colors=None if cloud.colors is None else by_column(cloud.colors[order]),
    )


def by_column(vectors: Tensor) -> Tensor:
    """Return vectors ``(N, C)`` laid out column by column."""
    return vectors.T.contiguous().T


def number_by_size(regions: Tensor, min_size: int) -> Tensor:
    """Number regions by descending size, those of equal size by their first point.

    ``regions`` ``(N,)`` holds a number below N for each region, -1 for none. Those smaller than
    ``min_size`` become :data:`torchrg.UNLABELED`.
    """
    old = regions.cpu().numpy()
    # Runs of equal numbers are counted at once: many are long.
    starts = np.append(0, np.flatnonzero(old[1:] != old[:-1]) + 1)[: len(old)]
    lengths, of_run = np.diff(starts, append=len(old)), old[starts]
    num = int(of_run.max(initial=UNLABELED)) + 1
    sizes = np.bincount(of_run + 1, lengths, minlength=num + 1)[1:]
    large = np.flatnonzero(sizes >= max(min_size, 1))
    firsts = np.empty(num + 1, dtype=np.int32)
    # Of several writes to one place the last one stays: in reverse, the first.
    firsts[of_run[::-1]] = starts[::-1]
    large = large[np.lexsort((firsts[large], -sizes[large]))]
    # The last entry is what -1 finds.
    numbers = np.full(num + 1, UNLABELED)
    numbers[large] = np.arange(len(large))
    return torch.from_numpy(np.repeat(numbers[of_run], lengths)).to(regions.device)


def number_by_count(labels: Tensor) -> Tensor:
    """Return new numbers of regions, by their points: descending, equal counts in their order.

    ``labels`` ``(N,)`` are those of points, -1 for none. The last of the numbers ``(M + 1,)`` is
    that of -1, so that they can be indexed by labels.

    Example:
        >>> number_by_count(torch.tensor([0, 1, 1, -1])).tolist()
        [1, 0, -1]
    """
    counts = torch.bincount(labels + 1, minlength=1)[1:]
    numbers = counts.argsort(descending=True, stable=True).argsort()
    return torch.cat([numbers, numbers.new_tensor([UNLABELED])])


def grow(cloud: GrowingCloud, config: GrowingConfig, chunk_size: int) -> Tensor:
    """Return the root of each point's region ``(N,)``: the point it began with, or -1.

    Points that are not valid have none, and some of those whose region is too small to count.
    """
    growing, indices = cloud.curvature[cloud.valid], cloud.neighbors.indices.cpu()
    limit = curvature_limit(growing, config.curvature_quantile)
    is_seed, valid = (cloud.curvature <= limit).cpu(), cloud.valid.cpu()
    order = ascending_rows(cloud.curvature.cpu())
    order = order[valid[order]].int()
    joins, makes_seed = mark_edges(cloud, config, limit, chunk_size=chunk_size)
    if makes_seed is None and int(config.min_size) > indices.shape[1]:
        order = order[: int(torch.count_nonzero(growing <= limit))]
    tables, late = (indices, joins, makes_seed, is_seed, valid), promotes_late(config)
    if kernels.serve(indices, valid):
        roots = torch.full(valid.shape, UNLABELED, dtype=torch.int32, device="cpu")
        queue = torch.empty_like(roots)
        at_once = _ROOTS_AT_ONCE if scratch.is_active() else max(len(order), 1)
        for some in torch.split(order, at_once):
            kernels.call("grow_regions", *tables, some, late, roots, queue)
            scratch.release()
    else:
        roots = grow_first_in_first_out(*tables, order, late=late)
    return roots.to(cloud.points.device)


def curvature_limit(curvature: Tensor, quantile: float) -> Tensor:
    """Return the lower quantile of curvatures ``(n,)``, one of the values; 0 where n is 0."""
    if len(curvature) == 0:
        return curvature.new_zeros(())
    return curvature.kthvalue(int(quantile * (len(curvature) - 1)) + 1).values


def grow_first_in_first_out(
    neighbors: Tensor,
    joins: Tensor,
    makes_seed: Tensor | None,
    is_seed: Tensor,
    valid: Tensor,
    order: Tensor,
    *,
    late: bool,
) -> Tensor:
    """Grow one region after the other, each from a first-in-first-out queue of seeds (Algorithm 2).

    A point belongs to the first seed in the queue that it joins. Whether it becomes a seed itself
    is a property of that edge, or its own where edges say nothing of it; :func:`mark_edges` returns
    the bits of both. With ``late`` promotion any edge of its region may make a point a seed,
    whichever claimed it: those that merely join do so when all seeds are known.

    All waiting seeds are taken at a time, their edges in the order of the queue: this claims
    exactly what one seed after the other does. Returns the root of each point's region.
    """
    lists, free, is_seed_itself = neighbors.numpy(), valid.numpy().copy(), is_seed.numpy()
    roots, slots = np.full(len(free), UNLABELED, dtype=np.int32), np.empty(len(free), np.int32)

    def claim(root: int, seeds: NDArray[np.integer], *, promoted: bool) -> NDArray[np.integer]:
        """Give a region the free neighbours of its seeds, and return those that become seeds."""
        near = lists[seeds]
        claims = _flags(joins, seeds, near) & free[near]
        by_edge = None if makes_seed is None else _flags(makes_seed, seeds, near)
        if promoted:
            claims &= by_edge
        targets = near[claims]
        # Of several writes to one place the last one stays: in reverse, the first edge to a point.
        numbers = np.arange(len(targets), dtype=np.int32)
        slots[targets[::-1]] = numbers[::-1]
        free[targets], roots[targets] = False, root
        becomes_seed = is_seed_itself[targets] if by_edge is None else by_edge[claims]
        new: NDArray[np.integer] = targets[becomes_seed & (slots[targets] == numbers)]
        return new

    for root in _still_free(order.numpy(), free):
        if not free[root]:
            continue
        free[root], roots[root] = False, root
        waves: list[NDArray[np.integer]] = [np.array([root])]
        while len(waves[-1]):
            waves.append(claim(root, waves[-1], promoted=late))
        for seeds in waves if late else ():
            claim(root, seeds, promoted=False)
    return torch.from_numpy(roots)


def _flags(bits: Tensor, rows: NDArray[np.integer], near: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return the bits of some rows, one for each of the neighbours ``(n, K)``."""
    of_rows = bits.numpy()[rows].view(np.uint8)
    flags = np.unpackbits(of_rows, axis=1, count=near.shape[1], bitorder="little")
    return flags.view(np.bool_)


def _still_free(order: NDArray[np.int32], free: NDArray[np.bool_]) -> Iterator[int]:
    """Give the points that are free when their chunk begins: a list of all takes 36 bytes each."""
    for rows in chunks_of(len(order), ROWS_AT_ONCE):
        chunk = order[rows]
        yield from chunk[free[chunk]].tolist()
