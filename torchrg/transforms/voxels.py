"""One point of each voxel, and the way back to every point."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.config import PipelineConfig, load_config
from torchrg.errors import ConfigError
from torchrg.neighbors import finite_rows, restore_points, sample_voxels
from torchrg.pipeline import segment_planes
from torchrg.regions import summarize_planes
from torchrg.structures import UNLABELED, PlaneAdjacency, Segmentation
from torchrg.transforms.sample import SampleTransform, rows_of_clouds, select_points


class SampleVoxels(SampleTransform):
    """Keep one point of each voxel, and remember the voxel of every point.

    Reads ``coord`` ``(N, 3)``; reduces every entry with a row for each point to ``(V, ...)``, and
    adds ``inverse`` ``(N,)``, int64: :func:`restore_points` takes labels of the voxels back to all
    points. No voxel crosses the clouds of a batch. See :func:`sample_voxels`.

    Args:
        size: Side of a voxel, in the unit of the cloud.
        keys: Other names for the keys.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]])
        >>> sample = SampleVoxels(0.1)({"coord": points})
        >>> len(sample["coord"]), sample["inverse"].tolist()
        (2, [0, 0, 1])
    """

    def __init__(self, size: float, *, keys: Mapping[str, str] | None = None) -> None:
        super().__init__(keys=keys)
        if not 0 < size < float("inf"):
            raise ConfigError(f"SampleVoxels: expected size > 0, got {size!r}.")
        self.size = size

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample of voxels."""
        coord = self.read(sample, "coord")
        rows, inverse, num_voxels = [], [], 0
        for cloud in rows_of_clouds(sample, len(coord)):
            voxels = sample_voxels(coord[cloud], self.size)
            rows.append(voxels.rows + cloud.start)
            inverse.append(torch.where(voxels.inverse >= 0, voxels.inverse + num_voxels, UNLABELED))
            num_voxels += len(voxels.rows)
        selected = select_points(sample, torch.cat(rows), num_points=len(coord))
        selected[self.key(sample, "inverse")] = torch.cat(inverse)
        return self.changed(sample, selected)

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"size={self.size}"


def segment_voxels(
    points: Tensor | NDArray[np.floating],
    size: float,
    config: PipelineConfig | None = None,
    *,
    on_stage: Callable[[str], None] | None = None,
) -> Segmentation:
    """Segment one point of each voxel, and give every point the result of its voxel.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        size: Side of a voxel, in the unit of the cloud.
        config: See :func:`torchrg.segment_planes`; sizes of regions are counted in voxels.
        on_stage: See :func:`torchrg.segment_planes`.

    Returns:
        A segmentation of all points. Its planes are those of the voxels, described from all points
        and numbered by their number; which planes meet is found on the voxels.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.
        ConfigError: If ``size`` is not positive.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.zeros(1))
        >>> seg = segment_voxels(grid, 2.0)
        >>> seg.labels.shape, seg.planes.count.tolist()
        (torch.Size([1600]), [1600])
    """
    tensor = as_tensor("segment_voxels", "points", points)
    config = load_config() if config is None else config
    voxels = sample_voxels(tensor, size)
    seg = segment_planes(tensor[voxels.rows], config, on_stage=on_stage)
    labels = restore_points(seg.labels, voxels.inverse, fill=UNLABELED)
    counts = torch.bincount(labels[labels >= 0], minlength=len(seg.planes.count))
    place = counts.argsort(descending=True, stable=True).argsort()
    labels = torch.where(labels >= 0, place[labels], labels) if len(place) else labels
    normals, curvature, sharp, valid = (
        restore_points(values, voxels.inverse) for values in seg[1:5]
    )
    rows, up, outline = finite_rows(tensor), config.planes.up_direction, config.planes.outline
    planes = summarize_planes(tensor[rows], normals[rows], labels[rows], up=up, outline=outline)
    planes = planes._replace(adjacency=_renumbered(seg.planes.adjacency, place))
    return Segmentation(labels, normals, curvature, sharp, valid, planes, tensor)


def _renumbered(adjacency: PlaneAdjacency | None, place: Tensor) -> PlaneAdjacency | None:
    """Return which planes meet after the planes were given other numbers."""
    if adjacency is None:
        return None
    pairs = place[adjacency.pairs].sort(dim=-1).values
    order = (pairs[:, 0] * len(place) + pairs[:, 1]).argsort()
    return PlaneAdjacency(*(part[order] for part in (pairs, *adjacency[1:])))
