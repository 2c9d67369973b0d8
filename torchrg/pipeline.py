"""From points to planes, and to superpoints: each in one function."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import sequential_operations
from torchrg.config import PipelineConfig, SuperpointsConfig, load_config
from torchrg.errors import ShapeError
from torchrg.neighbors import finite_rows, restore_rows, search_knn
from torchrg.normals import ESTIMATORS
from torchrg.regions import grow_regions, partition_points, summarize_planes
from torchrg.structures import UNLABELED, Neighbors, Segmentation, Superpoints

BYTES_PER_POINT = 1_100
"""Memory that a point adds at the peak of :func:`segment_planes` with any preset, or a pixel at
that of :func:`torchrg.depth.segment_depth`, which takes half of it."""


@sequential_operations()
def segment_planes(
    points: Tensor | NDArray[np.floating],
    config: PipelineConfig | None = None,
    *,
    on_stage: Callable[[str], None] | None = None,
) -> Segmentation:
    """Segment a cloud into planes: neighbours, normals, regions, plane table.

    Convention:
        The result does not depend on the order of the points, on chunk size, or on the number of
        threads; only exact duplicates may swap. Lengths are in the unit of the cloud.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64. Clouds far from the origin should be
            float64, or moved to it first, as :func:`torchrg.read_cloud` does.
        config: Settings. Default: the preset ``consensus``.
        on_stage: Called with the name of each stage when it starts, and with ``"done"``.

    Returns:
        Labels, normals, curvature and masks in the order of the points, and the table of planes. A
        point with NaN or Inf is not ``valid``: label :data:`torchrg.UNLABELED`, normal zero. A
        cloud with fewer points than ``k`` uses those it has; fewer than three points give no plane.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> seg = segment_planes(grid, load_config("classic"))
        >>> seg.planes.count.tolist(), seg.planes.normal.abs().tolist()
        ([400], [[0.0, 0.0, 1.0]])
    """
    tensor = as_tensor("segment_planes", "points", points)
    check_shapes("segment_planes", points=(tensor, "N 3"))
    check_floating("segment_planes", points=tensor)
    config = load_config() if config is None else config
    begin = on_stage or (lambda stage: None)

    begin("neighbors")
    rows = finite_rows(tensor)
    cloud = tensor[rows]
    if len(cloud) == 0:
        neighbors = Neighbors(torch.empty(0, 1, dtype=torch.int32, device=cloud.device))
    else:
        neighbors = search_knn(cloud, min(config.normals.k, len(cloud)), canonical=True)

    begin("normals")
    estimate = ESTIMATORS[config.normals.method]
    fit = estimate(cloud, neighbors, config.normals, config.chunk_size)

    begin("regions")
    labels = grow_regions(
        cloud,
        fit.normals,
        fit.curvature,
        neighbors,
        config.growing,
        valid=fit.valid,
        residual_rms=fit.residual_rms,
        canonical=True,
        chunk_size=config.chunk_size,
    )

    begin("planes")
    planes = summarize_planes(
        cloud,
        fit.normals,
        labels,
        neighbors=neighbors,
        up=config.planes.up,
        outline=config.planes.outline,
    )
    begin("done")
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    num_points = len(tensor)
    return Segmentation(
        restore_rows(labels, rows, num_points, fill=UNLABELED),
        restore_rows(fit.normals, rows, num_points),
        restore_rows(fit.curvature, rows, num_points),
        restore_rows(sharp, rows, num_points),
        restore_rows(fit.valid, rows, num_points),
        planes,
        tensor,
    )


@sequential_operations()
def make_superpoints(
    points: Tensor | NDArray[np.floating],
    seg: Segmentation | None = None,
    config: SuperpointsConfig | None = None,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
) -> Superpoints:
    """Partition a cloud into superpoints: every finite point in exactly one, in nested levels.

    Superpoints are connected (of a chain of points between any two, each is one of the 8 nearest
    neighbours of the one before or after it), of one orientation, and keep to the borders of
    objects. Planes come first: their compact pieces, or whole planes, are regions from the start.
    Regions merge while that costs an energy like that of cut pursuit [1] at most the strength of
    the level; see :func:`torchrg.regions.superpoints.partition_points` for it and its sources.

    Convention:
        The result does not depend on the order of the points or on the number of threads. Exact
        duplicates are in one superpoint. Sizes are counted in distinct points. Neither a voxel grid
        nor weights by local density made partitions of clouds of varying density better, so each
        point counts once.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        seg: What :func:`segment_planes` said about them. Default: it is asked, with the preset
            ``consensus``.
        config: Settings.
        colors: Colours, shape ``(N, 3)``, integers up to the largest of their type, or floating in
            [0, 1]. Default: they play no part.

    Returns:
        The partition of the first strength, and those of the others. A superpoint smaller than
        ``min_size`` has no neighbour to join, or only beyond ``max_extent``.

    Raises:
        ShapeError: If a shape or dtype is wrong, or ``seg`` is of another number of points.

    References:
        [1] L. Landrieu, G. Obozinski. Cut pursuit: fast algorithms to learn piecewise constant
        functions on general weighted graphs. SIAM J. Imaging Sciences, 2017.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> step = torch.stack([x, y, 10 * (x > 9)], dim=1)
        >>> found = make_superpoints(step)
        >>> found.labels.unique(return_counts=True)[1].tolist(), found.plane.tolist()
        ([200, 200], [0, 1])
    """
    tensor = as_tensor("make_superpoints", "points", points)
    check_shapes("make_superpoints", points=(tensor, "N 3"))
    check_floating("make_superpoints", points=tensor)
    shades = None if colors is None else as_tensor("make_superpoints", "colors", colors)
    check_shapes("make_superpoints", points=(tensor, "N 3"), colors=(shades, "N 3"))
    seg = segment_planes(tensor) if seg is None else seg
    if len(seg.labels) != len(tensor):
        raise ShapeError(
            f"make_superpoints: expected seg of {len(tensor):,} points, got {len(seg.labels):,}; "
            "pass the segmentation of these points."
        )
    config = SuperpointsConfig() if config is None else config
    return partition_points(tensor, seg.normals, seg.labels, config, shades)
