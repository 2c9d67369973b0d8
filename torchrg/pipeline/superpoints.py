"""Superpoint partition of a point cloud or a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_kinds, check_points, check_shapes, eager_only
from torchrg.config import AnyConfig, SuperpointsConfig, settings_of
from torchrg.errors import ConfigError, ShapeError, warn
from torchrg.neighbors import expand_to_points, sample_voxels
from torchrg.pipeline.planes import segment_planes
from torchrg.regions import partition_points
from torchrg.regions.superpoints import merge_duplicates
from torchrg.structures import UNLABELED, AnyCloud, Segmentation, Superpoints
from torchrg.structures.colors import read_colors
from torchrg.structures.points import Colors, Labels

_STRENGTH_OF_K = 100.0
"""Superpoint strength per unit of the threshold of ScanNet's Segmentator. At its default of 0.01,
meshed depth frames get about the same number of superpoints as Segmentator's segments."""


@eager_only
def make_superpoints(
    points: AnyCloud,
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
    :func:`torchrg.regions.superpoints.partition_points` for details and sources. If coordinates are
    quantized, as in one frame of a depth camera, points are first moved to their plane.

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
            :func:`torchrg.structures.colors.find_white`. Duplicates share the midrange of each
            channel. Default: colors are ignored.
        voxel: Voxel size, in the unit of the cloud. One point per voxel is partitioned, and every
            point gets the superpoint of its voxel. Sizes and the numbering then count voxels.
            Default: partition all points.
        **changes: Individual settings, as in ``counts=100``.

    Returns:
        The partition of each strength, as levels from fine to coarse. A superpoint smaller than
        ``min_size`` has no neighbor that it could join within ``max_extent``.

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
    check_kinds("make_superpoints", "pass seg, then settings", seg=(seg, Segmentation))
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
        near = seg.neighbors if is_searched else None
        return partition_points(tensor, seg.normals, seg.labels, settings, shades, neighbors=near)
    distinct, shades = merge_duplicates(tensor, seg.normals, seg.labels, shades)
    rows, inverse = sample_voxels(distinct.points, voxel)
    shades = None if shades is None else shades[rows]
    rows, inverse = distinct.rows[rows], distinct.restore(inverse, fill=UNLABELED)
    normals, plane = seg.normals[rows], seg.labels[rows]
    partition = partition_points(tensor[rows], normals, plane, settings, shades)
    of_sample = (partition.labels, *partition.levels)
    labels, *levels = (expand_to_points(each, inverse, fill=UNLABELED) for each in of_sample)
    return Superpoints(labels, partition.plane, tuple(levels))


def _unit_colors(caller: str, points: Tensor, colors: Colors | None) -> Tensor | None:
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
    vertices: AnyCloud,
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
    check_points("segment_mesh", tensor, "vertices")
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
