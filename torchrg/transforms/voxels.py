"""One point of each voxel, and the way back to every point."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.config import PipelineConfig, SuperpointsConfig, load_config
from torchrg.errors import ConfigError
from torchrg.neighbors import Voxels, finite_rows, restore_points, sample_voxels
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.regions import summarize_planes
from torchrg.structures import UNLABELED, PlaneAdjacency, Segmentation, Superpoints
from torchrg.transforms.rows import rows_of_clouds
from torchrg.transforms.sample import SampleTransform

_NEVER_A_ROW = torch.iinfo(torch.int64).min
"""Instead of -1 in a PyG ``Data``: negative still when PyG adds the rows of the clouds before."""


class SampleVoxels(SampleTransform):
    """Keep one point of each voxel, and remember the voxel of every point.

    Reads ``coord`` ``(N, 3)``; reduces every entry with a row for each point to ``(V, ...)``, and
    adds ``inverse`` ``(N,)``, int64, negative for none: :func:`restore_points` takes labels of the
    voxels back to all points. It names rows of the whole sample, in a batch too; in a PyG ``Data``
    it is ``inverse_index``, which PyG keeps so when it batches. Where ``inverse`` is there already,
    it goes on from its points. No voxel crosses the clouds of a batch. See :func:`sample_voxels`.

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

    def transform(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample of voxels."""
        coord = self.read(sample, "coord")
        rows, inverse, num_voxels = [], [], 0
        for cloud in rows_of_clouds(sample, len(coord)):
            voxels = sample_voxels(coord[cloud], self.size)
            rows.append(voxels.rows + cloud.start)
            inverse.append(torch.where(voxels.inverse >= 0, voxels.inverse + num_voxels, UNLABELED))
            num_voxels += len(voxels.rows)
        voxel_of = torch.cat(inverse)
        if not isinstance(sample, Mapping):
            voxel_of = voxel_of.where(voxel_of >= 0, _NEVER_A_ROW)
        selected = self.selected(sample, torch.cat(rows), len(coord))
        found = {self.key(sample, "inverse"): voxel_of} | self.moved_inverse(sample, voxel_of)
        return self.changed(sample, selected | found)

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"size={self.size}"


def segment_voxels(
    points: Tensor | NDArray[np.floating],
    size: float | Voxels,
    config: PipelineConfig | None = None,
    *,
    on_stage: Callable[[str], None] | None = None,
) -> Segmentation:
    """Segment one point of each voxel, and give every point the result of its voxel.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        size: Side of a voxel, in the unit of the cloud; or the voxels of the points, if they are
            known already.
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
    voxels = size if isinstance(size, Voxels) else sample_voxels(tensor, size)
    seg = segment_planes(tensor[voxels.rows], config, on_stage=on_stage)
    labels, place = _by_points(seg, voxels.inverse)
    labels = restore_points(labels, voxels.inverse, fill=UNLABELED)
    normals, curvature, sharp, valid = (
        restore_points(values, voxels.inverse) for values in seg[1:5]
    )
    rows, up, outline = finite_rows(tensor), config.planes.up, config.planes.outline
    ordered = (values.index_select(0, rows) for values in (tensor, normals, labels))
    planes = summarize_planes(*ordered, up=up, outline=outline)
    planes = planes._replace(adjacency=_renumbered(seg.planes.adjacency, place))
    return Segmentation(labels, normals, curvature, sharp, valid, planes, tensor)


def partition_voxels(
    points: Tensor | NDArray[np.floating],
    voxels: Voxels | None,
    seg: Segmentation,
    config: SuperpointsConfig | None = None,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
) -> Superpoints:
    """Make superpoints of the points that stand for voxels, and give every point that of its voxel.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        voxels: What :func:`sample_voxels` said about them. None: every point stands for itself.
        seg: What :func:`segment_voxels` said about all of them.
        config: See :func:`torchrg.make_superpoints`; sizes are counted in voxels.
        colors: See there.

    Returns:
        A partition of all points, superpoints numbered by their number of voxels.

    Raises:
        ShapeError: If a shape or dtype is wrong.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.zeros(1))
        >>> voxels = sample_voxels(grid, 2.0)
        >>> found = partition_voxels(grid, voxels, segment_voxels(grid, voxels))
        >>> found.labels.shape, found.plane.tolist()
        (torch.Size([1600]), [0])
    """
    if voxels is None:
        return make_superpoints(points, seg, config, colors=colors)
    tensor = as_tensor("partition_voxels", "points", points)
    shades = None if colors is None else as_tensor("partition_voxels", "colors", colors)
    rows = voxels.rows
    found = make_superpoints(
        tensor[rows],
        seg._replace(labels=seg.labels[rows], normals=seg.normals[rows]),
        config,
        colors=None if shades is None else shades[rows],
    )
    labels, *levels = (
        restore_points(level, voxels.inverse, fill=UNLABELED)
        for level in (found.labels, *found.levels)
    )
    return Superpoints(labels, found.plane, tuple(levels))


def _by_points(seg: Segmentation, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Number the planes of voxels by descending number of points: labels, and the new numbers."""
    num_planes, num_voxels = len(seg.planes.count), len(seg.labels)
    # Points and voxels of none are counted in a last place that is cut off.
    weights = torch.bincount(inverse.where(inverse >= 0, num_voxels), minlength=num_voxels + 1)
    numbers = seg.labels.where(seg.labels >= 0, num_planes)
    counts = torch.zeros(num_planes + 1, dtype=torch.int64, device=numbers.device)
    counts.index_add_(0, numbers, weights[:-1])
    place = counts[:-1].argsort(descending=True, stable=True).argsort()
    return torch.cat([place, place.new_tensor([UNLABELED])])[numbers], place


def _renumbered(adjacency: PlaneAdjacency | None, place: Tensor) -> PlaneAdjacency | None:
    """Return which planes meet after the planes were given other numbers."""
    if adjacency is None:
        return None
    pairs = place[adjacency.pairs].sort(dim=-1).values
    order = (pairs[:, 0] * len(place) + pairs[:, 1]).argsort()
    return PlaneAdjacency(*(part[order] for part in (pairs, *adjacency[1:])))
