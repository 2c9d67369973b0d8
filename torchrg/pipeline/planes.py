"""Plane segmentation of a point cloud."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrg import scratch
from torchrg._checks import as_cloud, as_tensor, check_shapes, eager_only
from torchrg._parallel import ROWS_AT_ONCE, return_freed_memory, split_rows
from torchrg.config import AnyConfig, PipelineConfig, settings_of
from torchrg.errors import CloudWarning, ShapeError, warn
from torchrg.neighbors import (
    canonical_order,
    distinct_points,
    expand_to_points,
    measure_sampling,
    sample_voxels,
)
from torchrg.neighbors.knn import check_num_neighbors, restrict_to_groups, search_distinct
from torchrg.neighbors.order import DistinctPoints
from torchrg.neighbors.voxels import warn_about_voxel
from torchrg.normals.estimators import run_estimator
from torchrg.normals.orient import Orientation, choose_side, find_directions, turn_faces
from torchrg.regions import grow_regions, summarize_planes
from torchrg.regions.classes import find_kinds
from torchrg.regions.growth import needs_sampling, rank_by_count
from torchrg.regions.selection import keep_planes, selected_rows
from torchrg.structures import UNLABELED, AnyCloud, Cloud, Neighbors, Planes, Segmentation
from torchrg.structures.planes import Deferred
from torchrg.structures.points import Labels, Points, Rows
from torchrg.structures.precision import warn_about_coordinates

_MIN_NEIGHBORHOODS = 2
"""Minimum number of points of a cloud, in neighborhoods; fewer points have one plane for all."""
_UP = torch.tensor([0.0, 0.0, 1.0])
"""Up axis of clouds for which none is set."""


@eager_only
def segment_planes(
    points: AnyCloud,
    config: AnyConfig | None = None,
    *,
    orient: Orientation = "auto",
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
    voxel: float | None = None,
    within: Labels | None = None,
    keep_neighbors: bool = False,
    on_stage: Callable[[str], None] | None = None,
    **changes: Any,  # noqa: ANN401
) -> Segmentation:
    """Segment a point cloud into planes.

    Most of the memory goes to the neighbor and edge lists. If a cloud does not fit in memory,
    :func:`torchrg.scratch.on_disk` spills these lists to unnamed temporary files.

    Convention:
        The result does not depend on the order of the points, the chunk size, the number of
        threads, or spilling to disk. Lengths are in the unit of the cloud. Another unit, another
        origin, or float64 instead of float32 changes results only where rounding decides, such as
        between equal distances. Scaling by a power of two changes nothing, except settings that are
        measured from the cloud, which have three digits.

        Points with equal coordinates are duplicates. Neighbors are searched among distinct points,
        and duplicates share one result. ``min_size`` and the table count duplicates once, except
        the table's ``count``. Labels are sorted by ``count``.

        Normals are oriented in the same way by every command and transform. Orientation takes a
        tenth of the time; ``orient="none"`` skips it.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64, a cloud, or the path of a file.
            Planes of a cloud or a file are relative to :attr:`torchrg.Cloud.origin`, like its
            points. Use float64 for tensors far from the origin, or shift them first.
        config: Configuration, dictionary as ``{"normals.k": 30}``, preset name, or file. Default:
            see :func:`torchrg.load_config`.
        orient: Normal orientation, as in :func:`torchrg.normals.orient_normals`. Default: the front
            of the surface if the cloud has it, else the interior of rooms.
        viewpoint: Scanner position for ``orient="viewpoint"``, as in ``orient_normals``.
        front: Direction from each point to the side from which its surface was seen, shape
            ``(N, 3)``, as in ``orient_normals``. Default: that of the cloud.
        voxel: Voxel size, in the unit of the cloud. One point per voxel is segmented, and every
            point gets the result of its voxel. Region sizes are then in voxels and the adjacency is
            that of the voxels; the table describes all points. Default: segment all points.
        within: Object ID of each point, shape ``(N,)``, integers. No plane crosses objects, and the
            table has the object of each plane. A position or voxel shared by several objects counts
            once per object. Default: no restriction.
        keep_neighbors: Whether to return the neighbors, at 4 bytes per neighbor, so
            :func:`make_superpoints` need not search them again. Default: False.
        on_stage: Callback that receives the name of each stage at its start, and ``"done"``.
        **changes: Individual settings, as in ``min_area=0.5``.

    Returns:
        Labels, normals, curvature and masks in the order of the points, and the plane table. Points
        with NaN or Inf are not ``valid``: label :data:`torchrg.UNLABELED`, zero normal. A cloud of
        fewer than ``k`` points uses all of them; fewer than three points give no plane.

    Raises:
        ShapeError: If ``points`` or ``within`` has the wrong shape or dtype.
        ConfigError: If ``voxel`` is not positive, or a setting is invalid.
        FormatError: If arrays spill to disk and the disk is full.

    Warns:
        PrecisionWarning: If the rounding step of float32 exceeds a tenth of the point spacing, as
            it does far from the origin, or the axes seem to have different units.
        CloudWarning: If the cloud has fewer than ``2 k`` points. If another axis seems to be up,
            when planes are classified.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> seg = segment_planes(grid, "classic")
        >>> seg.planes.count.tolist(), seg.planes.normal.abs().tolist()
        ([400], [[0.0, 0.0, 1.0]])
        >>> segment_planes(grid, "classic", voxel=2.0).planes.count.tolist()
        [400]
        >>> halves = segment_planes(grid, "classic", within=torch.arange(400) // 200 + 5).planes
        >>> halves.count.tolist(), halves.object.tolist()
        ([200, 200], [5, 6])
    """
    points = as_cloud(points)
    is_cloud = isinstance(points, Cloud)  # It warns on access to its points.
    points, directions = find_directions(
        "segment_planes", points, orient, viewpoint=viewpoint, front=front
    )
    if not is_cloud:
        warn_about_coordinates("segment_planes", points)
    objects = None if within is None else as_tensor("segment_planes", "within", within)
    objects = None if objects is None else objects.to(points.device)
    check_shapes("segment_planes", points=(points, "N 3"), within=(objects, "N"))
    if objects is not None and (objects.is_floating_point() or objects.is_complex()):
        raise ShapeError(
            f"segment_planes: expected integer within, got {objects.dtype}; number the objects."
        )
    settings = config
    if not isinstance(settings, PipelineConfig) or changes:
        settings = settings_of("segment_planes", PipelineConfig, config, changes)

    def begin(stage: str) -> None:
        if scratch.is_active():
            return_freed_memory()
        if on_stage is not None:
            on_stage(stage)

    objects = None if objects is None else objects.long()
    side = orient, directions
    if settings.min_area > 0 or settings.kinds is not None or settings.sort != "points":
        seg = _segment(points, settings.without_selection(), side, voxel, objects, begin)
        seg = keep_planes(seg, selected_rows(seg.planes, settings))
    else:
        seg = _segment(points, settings, side, voxel, objects, begin)
    return seg if keep_neighbors else replace(seg, neighbors=None)


def _segment(
    points: Tensor,
    config: PipelineConfig,
    side: tuple[Orientation, Tensor | None],
    voxel: float | None,
    objects: Tensor | None,
    begin: Callable[[str], None],
) -> Segmentation:
    """Run the stages of :func:`segment_planes`.

    ``side`` is the orientation of the normals, with the front directions ``(N, 3)`` if known.
    """
    begin("neighbors")
    distinct = DistinctPoints(*map(scratch.store, distinct_points(points)))
    sites = _find_sites(distinct, voxel)
    num_sites, k = len(sites.points), config.normals.k
    check_num_neighbors("segment_planes", num_sites, k=k, adaptive_k=config.normals.adaptive_k)
    if num_sites < _MIN_NEIGHBORHOODS * k and (voxel is not None or min(num_sites, k) > 2):
        warn(
            f"segment_planes: expected at least {_MIN_NEIGHBORHOODS * k:,} distinct points for "
            f"neighborhoods of {k:,}, got {num_sites:,}; add points, or reduce normals.k or the "
            "voxel size.",
            CloudWarning,
        )
    neighbors, sampling = search_distinct(sites.points, k), None
    is_auto = config.normals.method == "consensus" and config.normals.noise_scope == "auto"
    if is_auto or needs_sampling(config.growing):
        sampling = measure_sampling(sites.points, neighbors)
    config = config if sampling is None else config.with_sampling(sampling)

    begin("normals")
    fit = run_estimator(sites.points, neighbors, config.normals, config.chunk_size)
    fit = fit.map(scratch.store)

    begin("regions")
    parts = _split_by_object(sites, neighbors, objects, config.chunk_size)
    normals, curvature, valid, residual_rms = (values[parts.rows] for values in fit[:4])
    labels = grow_regions(
        sites.points[parts.rows],
        normals,
        curvature,
        parts.neighbors,
        config.growing,
        valid=valid,
        residual_rms=residual_rms,
        canonical=True,
        chunk_size=config.chunk_size,
    )
    point_labels = expand_to_points(labels, parts.inverse, fill=UNLABELED)
    numbers = rank_by_count(point_labels)
    labels, point_labels = (scratch.store(numbers[each]) for each in (labels, point_labels))

    begin("planes")
    growing = config.growing
    describe = partial(
        summarize_planes,
        up=config.planes.up,
        outline=config.planes.outline,
        facet_tolerance=growing.facet_tolerance if growing.faceted is True else None,
    )
    site_planes = describe(
        sites.points[parts.rows], normals, labels, neighbors=parts.surrounding, canonical=True
    )
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    found_normals, found_curvature, found_sharp, found_valid = (
        scratch.store(sites.restore(values))
        for values in (fit.normals, fit.curvature, sharp, fit.valid)
    )
    planes = site_planes
    if voxel is not None:
        rows: Rows = distinct.rows if objects is None else slice(None)
        columns = points, found_normals, point_labels
        cloud = (scratch.store(values[rows]) for values in columns)
        table = describe(*cloud, canonical=objects is None)
        planes = replace(table, adjacency=planes.adjacency)
    planes = _complete(planes, points, point_labels, objects, config)

    begin("orientation")
    site_labels = parts.to_sites(labels, len(sites.points))

    def turn(orient: Orientation) -> Tensor:
        axes = site_planes.normal
        turned = turn_faces(sites.points, fit.normals, orient, neighbors, site_labels, axes)
        return scratch.store(sites.restore(turned))

    normals = choose_side(points, found_normals, *side, turn)
    begin("done")
    return Segmentation(
        point_labels,
        normals,
        found_curvature,
        found_sharp,
        found_valid,
        planes,
        points,
        neighbors if voxel is None else None,
        sampling,
        distinct.num_copies,
    )


def _find_sites(distinct: DistinctPoints, voxel: float | None) -> DistinctPoints:
    """Return distinct points, or one point per voxel, in canonical order.

    Warn if the voxel size is probably in another unit.
    """
    if voxel is None:
        return distinct
    voxels = sample_voxels(distinct.points, voxel)
    order = canonical_order(distinct.points[voxels.rows])
    site, inverse = order.argsort(), scratch.new_empty(distinct.inverse, distinct.inverse.shape)
    for rows in split_rows(len(inverse), ROWS_AT_ONCE):
        known = expand_to_points(voxels.inverse, distinct.inverse[rows], fill=UNLABELED)
        inverse[rows] = expand_to_points(site, known, fill=UNLABELED)
    warn_about_voxel("segment_planes", voxel, len(order), len(distinct.points))
    chosen = voxels.rows[order]
    return DistinctPoints(scratch.store(distinct.points[chosen]), distinct.rows[chosen], inverse)


class _Parts(NamedTuple):
    """Points of one object at a site, in which regions grow; the sites without objects.

    Attributes:
        rows: Site of each part.
        inverse: Part of each point of the cloud, shape ``(N,)``, or -1.
        neighbors: Neighbors of the same object; growth and refinement only join neighbors.
        surrounding: Neighbors of all objects.
    """

    rows: Rows
    inverse: Tensor
    neighbors: Neighbors
    surrounding: Neighbors

    def to_sites(self, labels: Tensor, num_sites: int) -> Tensor:
        """Return the label of each site, the largest of its parts."""
        if isinstance(self.rows, slice):
            return labels
        none = torch.full((num_sites,), UNLABELED, device=labels.device)
        return none.scatter_reduce(0, self.rows, labels, "amax")


def _split_by_object(
    sites: DistinctPoints, neighbors: Neighbors, objects: Tensor | None, chunk_size: int
) -> _Parts:
    """Return the parts of the sites."""
    if objects is None:
        return _Parts(slice(None), sites.inverse, neighbors, neighbors)
    rows, groups, inverse = _number_parts(sites.inverse, objects, len(sites.points))
    restricted = restrict_to_groups(neighbors, groups, chunk_size, rows)
    if len(groups) > len(sites.points):
        neighbors = search_distinct(sites.points[rows], neighbors.indices.shape[1])
    return _Parts(rows, inverse, restricted, neighbors)


def _complete(
    planes: Planes, points: Tensor, labels: Tensor, objects: Tensor | None, config: PipelineConfig
) -> Planes:
    """Add the number of points, the objects and the classes to a plane table."""
    planes = replace(planes, count=torch.bincount(labels + 1, minlength=1)[1:])
    if objects is not None:
        of_plane = objects.new_zeros(len(planes))
        of_plane[labels[labels >= 0]] = objects[labels >= 0]
        planes = replace(planes, object=of_plane)
    if config.planes.up is None:
        deferred: Any = Deferred(partial(find_kinds, points=points, labels=labels, up=_UP))
        planes = replace(planes, kind=deferred)
    return planes


def _number_parts(inverse: Tensor, objects: Tensor, num_sites: int) -> tuple[Rows, Tensor, Tensor]:
    """Return the sites and objects of parts in ascending order, and the part of each point.

    Objects are numbered from 0 unless each site has one point.
    """
    has_site = inverse >= 0
    if num_sites == int(torch.count_nonzero(has_site)):
        object_of_site = objects.new_empty(num_sites)
        object_of_site[inverse[has_site]] = objects[has_site]
        return slice(None), object_of_site, inverse
    values, groups = torch.unique(objects, return_inverse=True)
    keys, part = torch.unique(inverse * len(values) + groups, return_inverse=True)
    num_bad = int(torch.count_nonzero(keys < 0))
    keys, part = keys[num_bad:], (part - num_bad).clamp(min=UNLABELED)
    return keys // len(values), keys % len(values), part
