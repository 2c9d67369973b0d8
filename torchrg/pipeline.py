"""From points to planes, and to superpoints: each in one function."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import scratch
from torchrg._checks import as_tensor, check_floating, check_points, check_shapes, eager_only
from torchrg._parallel import return_freed_memory, sequential_operations
from torchrg.config import AnyConfig, PipelineConfig, SuperpointsConfig, settings_of
from torchrg.errors import ConfigError, ShapeError
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
from torchrg.normals import ESTIMATORS
from torchrg.normals.orient import Orientation, Points, choose_side, find_directions, turn_faces
from torchrg.precision import warn_about_steps
from torchrg.regions import grow_regions, partition_points, summarize_planes
from torchrg.regions.growth import needs_sampling, rank_by_count
from torchrg.regions.selection import choose_planes, keep_planes
from torchrg.regions.superpoints import merge_duplicates
from torchrg.structures import UNLABELED, Cloud, Neighbors, Rows, Segmentation, Superpoints

_STRENGTH_OF_K = 100.0
"""Strength of superpoints for a threshold of 1 of ScanNet's Segmentator. At its usual 0.01 there
shall be about as many superpoints as it makes segments of meshed depth frames."""


@eager_only
@sequential_operations()
def segment_planes(
    points: Points | Cloud | str | os.PathLike[str],
    config: AnyConfig | None = None,
    *,
    orient: Orientation = "auto",
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
    voxel: float | None = None,
    within: Tensor | NDArray[np.integer] | None = None,
    keep_neighbors: bool = False,
    on_stage: Callable[[str], None] | None = None,
    **changes: Any,  # noqa: ANN401
) -> Segmentation:
    """Segment a cloud into planes: neighbours, normals, regions, plane table.

    Of the memory that this takes most is in the lists of neighbours and edges. For a cloud that is
    too large for it, :func:`torchrg.scratch.on_disk` keeps these in files without a name.

    Convention:
        The result does not depend on the order of the points, on chunk size, on the number of
        threads or on where arrays are. Lengths are in the unit of the cloud. Another unit, another
        origin, and float64 in place of float32 change results where rounding decides, as between
        equal distances. A unit that is a power of two times another changes nothing, but for
        settings that are measured, in three digits.

        Points with equal coordinates are copies. Neighbors are searched among distinct points, and
        copies of a point have its result, so the normals and planes are those of the distinct
        points. ``min_size`` and the table count copies once, except the table's ``count``. Labels
        are numbered by ``count``.

        Normals point to one side, and every command and transform chooses the same one. This takes
        a tenth of the time; ``orient="none"`` saves it.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64, a cloud, or the path of a file.
            Planes of a cloud or a file are about :attr:`torchrg.Cloud.origin`, as its points are.
            Tensors far from the origin should be float64, or moved to it first.
        config: Settings, a dictionary of them, or the name of a preset or a file. Default: that of
            :func:`torchrg.load_config`.
        orient: Side to which normals point, as in :func:`torchrg.normals.orient_normals`. Default:
            to the front of the surface where the cloud knows it, else into the free space of rooms.
        viewpoint: Where the scanner stood, for ``orient="viewpoint"``; see there.
        front: Direction from each point to where its surface was seen from, shape ``(N, 3)``; see
            there. Default: that of the cloud.
        voxel: Side of voxels, in the unit of the cloud: one point of each is segmented, and every
            point has the result of its voxel. Sizes of regions are counted in voxels then; planes
            are described from all points and numbered by their number, and which of them meet is
            found on the voxels. Default: all points are segmented.
        within: Object of each point, shape ``(N,)``, integers, to keep planes within objects: no
            plane has points of two of them, and the table names that of each. Where objects share
            a position or a voxel, it counts once for each of them. Default: planes go across.
        keep_neighbors: Whether the result carries the neighbours, 4 bytes for each of a point, so
            that :func:`make_superpoints` need not search them again.
        on_stage: Called with the name of each stage when it starts, and with ``"done"``.
        **changes: Single settings, as in ``**{"normals.k": 30}``.

    Returns:
        Labels, normals, curvature and masks in the order of the points, and the table of planes. A
        point with NaN or Inf is not ``valid``: label :data:`torchrg.UNLABELED`, normal zero. A
        cloud with fewer points than ``k`` uses those it has; fewer than three points give no plane.

    Raises:
        ShapeError: If ``points`` or ``within`` has another shape or dtype.
        ConfigError: If ``voxel`` is not positive, or a setting is wrong.
        FormatError: If arrays are kept on a disk, and it is full.

    Warns:
        PrecisionWarning: If the steps of float32 are more than a tenth of the spacing of the
            points, as they are far from the origin.

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
    points, directions = find_directions(
        "segment_planes", points, orient, viewpoint=viewpoint, front=front
    )
    warn_about_steps("segment_planes", points)
    objects = None if within is None else as_tensor("segment_planes", "within", within)
    check_shapes("segment_planes", points=(points, "N 3"), within=(objects, "N"))
    if objects is not None and (objects.is_floating_point() or objects.is_complex()):
        raise ShapeError(
            f"segment_planes: expected within of integers, got {objects.dtype}; number the objects."
        )
    settings = config
    if not isinstance(settings, PipelineConfig) or changes:
        settings = settings_of("segment_planes", PipelineConfig, config, changes)

    def begin(stage: str) -> None:
        if scratch.is_active():
            return_freed_memory()
        if on_stage is not None:
            on_stage(stage)

    objects = None if objects is None else objects.long().to(points.device)
    side = _Side(orient, directions)
    if settings.min_area > 0 or settings.kinds is not None or settings.sort != "points":
        seg = _segment(points, settings.without_selection(), side, voxel, objects, begin)
        seg = keep_planes(seg, choose_planes(seg.planes, settings))
    else:
        seg = _segment(points, settings, side, voxel, objects, begin)
    return seg if keep_neighbors else replace(seg, neighbors=None)


class _Side(NamedTuple):
    """The side that normals point to, and the directions to it ``(N, 3)``, if there are any."""

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
    """Do what :func:`segment_planes` says: the steps, in their order.

    Places are distinct points, or one point of each voxel, and ``inverse`` is the place of each
    point. Regions grow on parts: the points of one object at a place are one part.
    """
    begin("neighbors")
    distinct = distinct_points(points)
    places, inverse = distinct.points, distinct.inverse
    if voxel is not None:
        places, inverse = _sample_places(distinct, voxel)
    neighbors = Neighbors(torch.empty(0, 1, dtype=torch.int32, device=points.device))
    if len(places):
        k = min(config.normals.k, len(places))
        neighbors = search_knn(places, k, canonical=True)
    sampling = None
    if _has_auto(config):
        sampling = measure_sampling(places, neighbors)
        config = config.with_sampling(sampling)

    begin("normals")
    estimate = ESTIMATORS[config.normals.method]
    fit = estimate(places, neighbors, config.normals, config.chunk_size)

    begin("regions")
    parts: Rows = slice(None)
    beside, around, part_of = neighbors, neighbors, inverse
    if objects is not None:
        parts, groups, part_of = _split_places(inverse, objects, len(places))
        # Growth, and all steps after it, join neighbours alone.
        beside = restrict_to_groups(neighbors, groups, config.chunk_size, parts)
        if len(groups) > len(places):
            around = search_knn(places[parts], neighbors.indices.shape[1], canonical=True)
    normals, curvature, valid, residual_rms = (values[parts] for values in fit[:4])
    labels = grow_regions(
        places[parts],
        normals,
        curvature,
        beside,
        config.growing,
        valid=valid,
        residual_rms=residual_rms,
        canonical=True,
        chunk_size=config.chunk_size,
    )

    begin("planes")
    of_points = expand_to_points(labels, part_of, fill=UNLABELED)
    numbers = rank_by_count(of_points)
    labels, of_points = numbers[labels], numbers[of_points]
    growing = config.growing
    describe = partial(
        summarize_planes,
        up=config.planes.up,
        outline=config.planes.outline,
        facet_tolerance=growing.facet_tolerance if growing.faceted is True else None,
    )
    planes = describe(places[parts], normals, labels, neighbors=around, canonical=True)
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    normals, curvature, sharp, valid = (
        expand_to_points(values, inverse)
        for values in (fit.normals, fit.curvature, sharp, fit.valid)
    )
    axes = planes.normal
    if voxel is not None:
        rows: Rows = distinct.rows if objects is None else slice(None)
        cloud = points[rows], normals[rows], of_points[rows]
        whole = describe(*cloud, canonical=objects is None)
        planes = replace(whole, adjacency=planes.adjacency)
    planes = replace(planes, count=torch.bincount(of_points + 1, minlength=1)[1:])
    if objects is not None:
        of_plane = objects.new_zeros(len(planes))
        of_plane[of_points[of_points >= 0]] = objects[of_points >= 0]
        planes = replace(planes, object=of_plane)

    begin("orientation")
    if isinstance(parts, Tensor):
        none = torch.full((len(places),), UNLABELED, device=labels.device)
        labels = none.scatter_reduce(0, parts, labels, "amax")

    def turn(side: Orientation) -> Tensor:
        turned = turn_faces(places, fit.normals, side, neighbors, labels, axes)
        return expand_to_points(turned, inverse)

    normals = choose_side(points, normals, side.orient, side.front, turn)
    begin("done")
    searched = neighbors if voxel is None else None
    return Segmentation(
        of_points,
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


def _sample_places(distinct: DistinctPoints, voxel: float) -> tuple[Tensor, Tensor]:
    """Return one point of each voxel, in canonical order, and the place of each point there."""
    voxels = sample_voxels(distinct.points, voxel)
    order = canonical_order(distinct.points[voxels.rows])
    place = order.argsort()[voxels.inverse]
    return distinct.points[voxels.rows[order]], distinct.restore(place, fill=UNLABELED)


def _split_places(inverse: Tensor, objects: Tensor, num_places: int) -> tuple[Rows, Tensor, Tensor]:
    """Return the places and the objects of parts, ascending, and the part of each point.

    Objects are numbered from 0 unless each place has one point.
    """
    has_place = inverse >= 0
    if num_places == int(torch.count_nonzero(has_place)):
        of_place = objects.new_empty(num_places)
        of_place[inverse[has_place]] = objects[has_place]
        return slice(None), of_place, inverse
    values, groups = torch.unique(objects, return_inverse=True)
    keys, part = torch.unique(inverse * len(values) + groups, return_inverse=True)
    num_bad = int(torch.count_nonzero(keys < 0))
    keys, part = keys[num_bad:], (part - num_bad).clamp(min=UNLABELED)
    return keys // len(values), keys % len(values), part


def _has_auto(config: PipelineConfig) -> bool:
    """Return whether a setting that counts is measured."""
    scope = config.normals.method == "consensus" and config.normals.noise_scope
    return scope == "auto" or needs_sampling(config.growing)


@eager_only
@sequential_operations()
def make_superpoints(
    points: Tensor | NDArray[np.floating],
    seg: Segmentation | None = None,
    config: SuperpointsConfig | Mapping[str, Any] | None = None,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
    voxel: float | None = None,
    **changes: Any,  # noqa: ANN401
) -> Superpoints:
    """Partition a cloud into superpoints: every finite point in exactly one, in nested levels.

    Superpoints are connected (of a chain of points between any two, each is one of the 8 nearest
    neighbours of the one before or after it), of one orientation, and keep to the borders of
    objects and of planes. Each point is a region at first, or each plane. Regions merge while that
    costs an energy like that of cut pursuit at most the strength of the level; see
    :func:`torchrg.regions.superpoints.partition_points` for it and its sources.

    Convention:
        The result does not depend on the order of the points or on the number of threads. Copies of
        a point are in one superpoint. Sizes are counted in distinct points, of any density, and
        superpoints are numbered by all their points. A few points may lie on another plane than
        the rest of their superpoint.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        seg: What :func:`segment_planes` said about them. Default: it is asked, with the preset
            ``consensus``.
        config: Settings, or a dictionary of them.
        colors: Colors, shape ``(N, 3)``, in 0..1, 0..255 or 0..65535, as
            :func:`torchrg.io.colors.find_white` tells. Copies of a point have one color, halfway
            between the least and the largest of each channel. Default: colors play no part.
        voxel: Side of voxels, in the unit of the cloud: the points that stand for voxels are
            partitioned, and every point is in the superpoint of its voxel. Sizes are counted in
            voxels then, and superpoints numbered by their number. Default: all points are.
        **changes: Single settings, as in ``counts=100``.

    Returns:
        The partition of the first strength, and those of the others. A superpoint smaller than
        ``min_size`` has no neighbour to join, or only beyond ``max_extent``.

    Raises:
        ShapeError: If a shape or dtype is wrong, or ``seg`` is of another number of points.
        ConfigError: If a setting is wrong, or if colors are in none of these ranges.

    Warns:
        UserWarning: If a range of colors is not the usual one of their type, or some are clipped.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> step = torch.stack([x, y, 10 * (x > 9)], dim=1)
        >>> found = make_superpoints(step)
        >>> found.labels.unique(return_counts=True)[1].tolist(), found.plane.tolist()
        ([200, 200], [0, 1])
    """
    tensor = as_tensor("make_superpoints", "points", points).detach()
    check_points("make_superpoints", tensor)
    shades = _unit_colors("make_superpoints", tensor, colors, num_decorators=2)
    seg = segment_planes(tensor, voxel=voxel, keep_neighbors=True) if seg is None else seg
    if len(seg.labels) != len(tensor):
        raise ShapeError(
            f"make_superpoints: expected seg of {len(tensor):,} points, got {len(seg.labels):,}; "
            "pass the segmentation of these points."
        )
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
    colors: Tensor | NDArray[np.generic] | None,
    *,
    num_decorators: int,
) -> Tensor | None:
    """Return the colors of points in [0, 1], float64, for a function with so many decorators.

    Warns:
        UserWarning: The caller of that function, if the values decided their range, or some are
            clipped.
    """
    if colors is None:
        return None
    shades = as_tensor(caller, "colors", colors).detach()
    check_shapes(caller, points=(points, "N 3"), colors=(shades, "N 3"))
    shades = shades.float() if shades.dtype == torch.bfloat16 else shades
    found, notes = read_colors(caller, shades.cpu().numpy(), error=ConfigError)
    for note in notes:
        warnings.warn(f"{caller}: {note}.", stacklevel=3 + num_decorators)
    unit = torch.from_numpy(found.astype(np.float64)) / np.iinfo(found.dtype).max
    return unit.to(points.device)


@eager_only
def segment_mesh(
    vertices: Tensor | NDArray[np.floating],
    faces: Tensor | NDArray[np.integer] | None = None,
    k_thresh: float = 0.01,
    seg_min_verts: int = 20,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
    config: AnyConfig | None = None,
) -> Tensor:
    """Return superpoints of the vertices of a mesh, in the shape of ScanNet's Segmentator.

    Programs that call ``segmentator.segment_mesh(vertices, faces)`` change their import to ``import
    torchrg as segmentator``, and have those of :func:`make_superpoints` then.

    Args:
        vertices: Shape ``(V, 3)``, floating.
        faces: Rows of the corners of triangles, shape ``(F, 3)``. Superpoints are connected along
            their edges. Default: along neighbours, for points without a mesh.
        k_thresh: As of Segmentator, in proportion: 0.01 is a strength of 1 in
            :class:`torchrg.config.SuperpointsConfig`.
        seg_min_verts: Smaller superpoints join a neighbour, in vertices.
        colors: As of :func:`make_superpoints`; Segmentator knows none.
        config: How planes are found, as of :func:`segment_planes`.

    Returns:
        Superpoint of each vertex, shape ``(V,)``, int64, consecutive from 0 on by descending size;
        -1 for vertices that are not finite.

    Raises:
        ShapeError: If a shape or dtype is wrong, or a face has a corner that is no vertex.

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
                f"segment_mesh: expected faces of rows of {len(tensor):,} vertices, got {low:,} to "
                f"{high:,}; number them from 0."
            )
    shades = _unit_colors("segment_mesh", tensor, colors, num_decorators=1)
    seg = segment_planes(tensor, config)
    parts = SuperpointsConfig(strengths=(_STRENGTH_OF_K * k_thresh,), min_size=seg_min_verts)
    return partition_points(tensor, seg.normals, seg.labels, parts, shades, corners).labels
