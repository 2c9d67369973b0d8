"""Plane segmentation and superpoint partition of a point cloud."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg import scratch
from torchrg._checks import as_tensor, check_floating, check_points, check_shapes, eager_only
from torchrg._parallel import return_freed_memory
from torchrg.config import AnyConfig, PipelineConfig, SuperpointsConfig, settings_of
from torchrg.errors import CloudWarning, ConfigError, ShapeError, warn
from torchrg.io import read_cloud
from torchrg.io.colors import read_colors
from torchrg.neighbors import (
    DistinctPoints,
    canonical_order,
    distinct_points,
    expand_to_points,
    measure_sampling,
    sample_voxels,
    search_knn,
)
from torchrg.neighbors.knn import restrict_to_groups
from torchrg.normals import run_estimator
from torchrg.normals.orient import Orientation, choose_side, find_directions, turn_faces
from torchrg.precision import warn_about_coordinates
from torchrg.regions import grow_regions, partition_points, summarize_planes
from torchrg.regions.growth import needs_sampling, rank_by_count
from torchrg.regions.kinds import find_kinds
from torchrg.regions.selection import choose_planes, keep_planes
from torchrg.regions.superpoints import merge_duplicates
from torchrg.structures import (
    UNLABELED,
    Cloud,
    Colors,
    DeferredKind,
    FilePath,
    Labels,
    Neighbors,
    Points,
    Rows,
    Segmentation,
    Superpoints,
)

__all__ = [
    "make_superpoints",
    "segment_mesh",
    "segment_planes",
]
__dir__ = __all__.copy

_MIN_NEIGHBORHOODS = 2
"""Minimum number of points of a cloud, in neighborhoods; fewer points have one plane for all."""
_UP = torch.tensor([0.0, 0.0, 1.0])
"""Up axis of clouds for which none is set."""
_STRENGTH_OF_K = 100.0
"""Superpoint strength per unit of the threshold of ScanNet's Segmentator. At its default of 0.01,
meshed depth frames get about the same number of superpoints as Segmentator's segments."""


_MIN_SITES = 3
"""Minimum number of points with a plane."""


@eager_only
def segment_planes(
    points: Points | Cloud | FilePath,
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
        config: Configuration, dictionary, preset name, or file. Default: see
            :func:`torchrg.load_config`.
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
        **changes: Individual settings, as in ``**{"normals.k": 30}``.

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
    if isinstance(points, str | os.PathLike):
        points = read_cloud(points)
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
    side = _Side(orient, directions)
    if settings.min_area > 0 or settings.kinds is not None or settings.sort != "points":
        seg = _segment(points, settings.without_selection(), side, voxel, objects, begin)
        seg = keep_planes(seg, choose_planes(seg.planes, settings))
    else:
        seg = _segment(points, settings, side, voxel, objects, begin)
    return seg if keep_neighbors else replace(seg, neighbors=None)


class _Side(NamedTuple):
    """Normal orientation, and the front directions ``(N, 3)`` if known."""

    orient: Orientation
    front: Tensor | None


def _segment(
    points: Tensor,
    config: PipelineConfig,
    side: _Side,
    voxel: float | None,
    objects: Tensor | None,
    begin: Callable[[str], None],
) -> Segmentation:
    """Run the stages of :func:`segment_planes`.

    Sites are distinct points, or one point per voxel, and ``inverse`` is the site of each point.
    Regions grow on parts: the points of one object at a site form one part.
    """
    begin("neighbors")
    distinct = distinct_points(points)
    sites, inverse = distinct.points, distinct.inverse
    if voxel is not None:
        sites, inverse = _sample_sites(distinct, voxel)
        _check_voxels(len(sites), len(distinct.points), voxel)
    neighbors = Neighbors(torch.empty(0, 1, dtype=torch.int32, device=points.device))
    if len(sites):
        k = min(config.normals.k, len(sites))
        if voxel is not None or k > 2:
            _warn_about_size(len(sites), config.normals.k)
        neighbors = search_knn(sites, k, canonical=True)
    sampling = None
    if _has_auto(config):
        sampling = measure_sampling(sites, neighbors)
        config = config.with_sampling(sampling)

    begin("normals")
    fit = run_estimator(sites, neighbors, config.normals, config.chunk_size)

    begin("regions")
    parts: Rows = slice(None)
    restricted, full, part_of = neighbors, neighbors, inverse
    if objects is not None:
        parts, groups, part_of = _split_sites(inverse, objects, len(sites))
        # Growth and all later stages only join neighbors.
        restricted = restrict_to_groups(neighbors, groups, config.chunk_size, parts)
        if len(groups) > len(sites):
            full = search_knn(sites[parts], neighbors.indices.shape[1], canonical=True)
    normals, curvature, valid, residual_rms = (values[parts] for values in fit[:4])
    labels = grow_regions(
        sites[parts],
        normals,
        curvature,
        restricted,
        config.growing,
        valid=valid,
        residual_rms=residual_rms,
        canonical=True,
        chunk_size=config.chunk_size,
    )

    begin("planes")
    point_labels = expand_to_points(labels, part_of, fill=UNLABELED)
    numbers = rank_by_count(point_labels)
    labels, point_labels = numbers[labels], numbers[point_labels]
    growing = config.growing
    describe = partial(
        summarize_planes,
        up=config.planes.up,
        outline=config.planes.outline,
        facet_tolerance=growing.facet_tolerance if growing.faceted is True else None,
    )
    planes = describe(sites[parts], normals, labels, neighbors=full, canonical=True)
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    normals, curvature, sharp, valid = (
        expand_to_points(values, inverse)
        for values in (fit.normals, fit.curvature, sharp, fit.valid)
    )
    axes = planes.normal
    if voxel is not None:
        rows: Rows = distinct.rows if objects is None else slice(None)
        cloud = points[rows], normals[rows], point_labels[rows]
        table = describe(*cloud, canonical=objects is None)
        planes = replace(table, adjacency=planes.adjacency)
    planes = replace(planes, count=torch.bincount(point_labels + 1, minlength=1)[1:])
    if objects is not None:
        of_plane = objects.new_zeros(len(planes))
        of_plane[point_labels[point_labels >= 0]] = objects[point_labels >= 0]
        planes = replace(planes, object=of_plane)
    if config.planes.up is None:
        classify = partial(find_kinds, points=points, labels=point_labels, up=_UP)
        deferred: Any = DeferredKind(classify)
        planes = replace(planes, kind=deferred)

    begin("orientation")
    if isinstance(parts, Tensor):
        none = torch.full((len(sites),), UNLABELED, device=labels.device)
        labels = none.scatter_reduce(0, parts, labels, "amax")

    def turn(side: Orientation) -> Tensor:
        turned = turn_faces(sites, fit.normals, side, neighbors, labels, axes)
        return expand_to_points(turned, inverse)

    normals = choose_side(points, normals, side.orient, side.front, turn)
    begin("done")
    searched = neighbors if voxel is None else None
    return Segmentation(
        point_labels,
        normals,
        curvature,
        sharp,
        valid,
        planes,
        points,
        searched,
        sampling,
        distinct.num_copies,
    )


def _warn_about_size(num_points: int, k: int) -> None:
    """Warn if every neighborhood contains more than half of a cloud."""
    if num_points < _MIN_NEIGHBORHOODS * k:
        warn(
            f"segment_planes: expected at least {_MIN_NEIGHBORHOODS * k:,} distinct points for "
            f"neighborhoods of {k:,}, got {num_points:,}; add points, or reduce normals.k or the "
            "voxel size.",
            CloudWarning,
        )


def _sample_sites(distinct: DistinctPoints, voxel: float) -> tuple[Tensor, Tensor]:
    """Return one point per voxel in canonical order, and the site of each point."""
    voxels = sample_voxels(distinct.points, voxel)
    order = canonical_order(distinct.points[voxels.rows])
    site = order.argsort()[voxels.inverse]
    return distinct.points[voxels.rows[order]], distinct.restore(site, fill=UNLABELED)


def _check_voxels(num_voxels: int, num_points: int, voxel: float) -> None:
    """Warn if a voxel size is probably in another unit than the cloud."""
    if num_voxels < _MIN_SITES <= num_points:
        result = f"leaves {num_voxels:,} of {num_points:,} points"
    elif num_voxels == num_points > 0:
        result = f"leaves all {num_points:,} points"
    else:
        return
    warn(
        f"segment_planes: voxel {voxel:g} {result}; check that it is in units of the cloud.",
        CloudWarning,
    )


def _split_sites(inverse: Tensor, objects: Tensor, num_sites: int) -> tuple[Rows, Tensor, Tensor]:
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


def _has_auto(config: PipelineConfig) -> bool:
    """Return whether a setting in use is measured from the cloud (``auto``)."""
    scope = config.normals.method == "consensus" and config.normals.noise_scope
    return scope == "auto" or needs_sampling(config.growing)


@eager_only
def make_superpoints(
    points: Points,
    seg: Segmentation | None = None,
    config: SuperpointsConfig | Mapping[str, Any] | None = None,
    *,
    colors: Colors | None = None,
    voxel: float | None = None,
    **changes: Any,  # noqa: ANN401
) -> Superpoints:
    """Partition a point cloud into nested superpoints.

    Every finite point belongs to exactly one superpoint per level. Superpoints are connected in the
    graph of the 8 nearest neighbors, have one orientation, and respect the boundaries of objects
    and planes. Initially each point, or each plane, is a region. Regions merge while the merging
    cost, an energy like that of cut pursuit, is at most the strength of the level; see
    :func:`torchrg.regions.superpoints.partition_points` for details and sources.

    Convention:
        The result does not depend on the order of the points or the number of threads. Duplicates
        are in one superpoint. Sizes count distinct points regardless of density; superpoints are
        sorted by the number of all their points. A few points may lie on another plane than most of
        their superpoint.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        seg: Segmentation of the same points. Default: :func:`segment_planes` with the preset
            ``consensus``.
        config: Configuration or dictionary.
        colors: Colors, shape ``(N, 3)``, in 0..1, 0..255 or 0..65535, as determined by
            :func:`torchrg.io.colors.find_white`. Duplicates share the midrange of each channel.
            Default: colors are ignored.
        voxel: Voxel size, in the unit of the cloud. One point per voxel is partitioned, and every
            point gets the superpoint of its voxel. Sizes and the numbering then count voxels.
            Default: partition all points.
        **changes: Individual settings, as in ``counts=100``.

    Returns:
        The partition of the first strength, and those of the remaining strengths. A superpoint
        smaller than ``min_size`` has no neighbor that it could join within ``max_extent``.

    Raises:
        ShapeError: If a shape or dtype is wrong, or ``seg`` has another number of points.
        ConfigError: If a setting is invalid, or the colors fit none of these ranges.

    Warns:
        UserWarning: If the colors do not have the default range of their dtype, or are clipped.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> step = torch.stack([x, y, 10 * (x > 9)], dim=1)
        >>> found = make_superpoints(step)
        >>> found.labels.unique(return_counts=True)[1].tolist(), found.plane.tolist()
        ([200, 200], [0, 1])
    """
    tensor = as_tensor("make_superpoints", "points", points).detach()
    check_points("make_superpoints", tensor)
    shades = _unit_colors("make_superpoints", tensor, colors)
    seg = segment_planes(tensor, voxel=voxel, keep_neighbors=True) if seg is None else seg
    if len(seg.labels) != len(tensor):
        raise ShapeError(
            f"make_superpoints: expected seg of {len(tensor):,} points, got {len(seg.labels):,}; "
            "pass the segmentation of these points."
        )
    check_shapes("make_superpoints", points=(tensor, "N 3"), seg=(seg.labels, "N"))
    settings = settings_of("make_superpoints", SuperpointsConfig, config, changes)
    if voxel is None:
        is_searched = seg.points is not None and seg.points.data_ptr() == tensor.data_ptr()
        neighbors = seg.neighbors if is_searched else None
        return partition_points(
            tensor, seg.normals, seg.labels, settings, shades, neighbors=neighbors
        )
    distinct, shades = merge_duplicates(tensor, seg.normals, seg.labels, shades)
    rows, inverse = sample_voxels(distinct.points, voxel)
    shades = None if shades is None else shades[rows]
    rows, inverse = distinct.rows[rows], distinct.restore(inverse, fill=UNLABELED)
    partition = partition_points(
        tensor[rows], seg.normals[rows], seg.labels[rows], settings, shades
    )
    labels, *levels = (
        expand_to_points(level, inverse, fill=UNLABELED)
        for level in (partition.labels, *partition.levels)
    )
    return Superpoints(labels, partition.plane, tuple(levels))


def _unit_colors(
    caller: str,
    points: Tensor,
    colors: Colors | None,
) -> Tensor | None:
    """Return the colors of points in [0, 1], float64.

    Warns:
        UserWarning: If the range was judged from the values, or some are clipped.
    """
    if colors is None:
        return None
    shades = as_tensor(caller, "colors", colors).detach().to(points.device)
    check_shapes(caller, points=(points, "N 3"), colors=(shades, "N 3"))
    shades = shades.float() if shades.dtype == torch.bfloat16 else shades
    found, notes = read_colors(caller, shades.cpu().numpy(), error=ConfigError)
    for note in notes:
        warn(f"{caller}: {note}.")
    unit = torch.from_numpy(found.astype(np.float64)) / np.iinfo(found.dtype).max
    return unit.to(points.device)


@eager_only
def segment_mesh(
    vertices: Points,
    faces: Labels | None = None,
    k_thresh: float = 0.01,
    seg_min_verts: int = 20,
    *,
    colors: Colors | None = None,
    config: AnyConfig | None = None,
) -> Tensor:
    """Return superpoints of mesh vertices, a drop-in replacement for ScanNet's Segmentator.

    Programs that call ``segmentator.segment_mesh(vertices, faces)`` change their import to ``import
    torchrg as segmentator`` to use the superpoints of :func:`make_superpoints`.

    Args:
        vertices: Shape ``(V, 3)``, floating.
        faces: Vertex indices of triangles, shape ``(F, 3)``. Superpoints are connected along mesh
            edges. Default: connect nearest neighbors, for points without a mesh.
        k_thresh: Segmentator's threshold; 0.01 corresponds to a strength of 1 in
            :class:`torchrg.config.SuperpointsConfig`.
        seg_min_verts: Minimum superpoint size, in vertices; smaller ones join a neighbor.
        colors: Colors as in :func:`make_superpoints`; Segmentator has none.
        config: Plane configuration, as in :func:`segment_planes`.

    Returns:
        Superpoint of each vertex, shape ``(V,)``, int64, numbered from 0 by descending size; -1 for
        vertices that are not finite.

    Raises:
        ShapeError: If a shape or dtype is wrong, or a vertex index is out of range.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> fold = torch.stack([x, y, 2 * (x - 9.5).clamp(min=0)], dim=1)
        >>> first = torch.tensor([row for row in range(380) if row % 20 < 19])[:, None]
        >>> faces = torch.cat([first + torch.tensor([0, 1, 20]), first + torch.tensor([1, 21, 20])])
        >>> segment_mesh(fold, faces).unique(return_counts=True)[1].tolist()
        [200, 200]
    """
    tensor = as_tensor("segment_mesh", "vertices", vertices).detach()
    check_shapes("segment_mesh", vertices=(tensor, "V 3"))
    check_floating("segment_mesh", vertices=tensor)
    corners = None if faces is None else as_tensor("segment_mesh", "faces", faces)
    check_shapes("segment_mesh", faces=(corners, "F 3"))
    if corners is not None and len(corners):
        low, high = int(corners.min()), int(corners.max())
        if not 0 <= low <= high < len(tensor):
            raise ShapeError(
                f"segment_mesh: expected vertex indices in [0, {len(tensor):,}), got {low:,} to "
                f"{high:,}; number the vertices from 0."
            )
    shades = _unit_colors("segment_mesh", tensor, colors)
    seg = segment_planes(tensor, config)
    parts = SuperpointsConfig(strengths=(_STRENGTH_OF_K * k_thresh,), min_size=seg_min_verts)
    return partition_points(tensor, seg.normals, seg.labels, parts, shades, corners).labels
