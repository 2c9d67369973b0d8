"""From points to planes: the method in one function."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.config import PipelineConfig, load_config
from torchrg.neighbors import finite_rows, restore_rows, search_knn
from torchrg.normals import ESTIMATORS
from torchrg.regions import grow_regions, summarize_planes
from torchrg.structures import UNLABELED, Neighbors, Segmentation


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
        up=config.planes.up_direction,
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
