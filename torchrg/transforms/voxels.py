"""One point of each voxel, and the way back to every point."""

from collections.abc import Mapping
from typing import Any

import torch

from torchrg.errors import ConfigError
from torchrg.neighbors import sample_voxels
from torchrg.structures import UNLABELED
from torchrg.transforms.rows import rows_of_clouds
from torchrg.transforms.sample import SampleTransform

_NEVER_A_ROW = torch.iinfo(torch.int64).min
"""Instead of -1 in a PyG ``Data``: negative still when PyG adds the rows of the clouds before."""


class SampleVoxels(SampleTransform):
    """Keep one point of each voxel, and remember the voxel of every point.

    Reads ``coord`` ``(N, 3)``; reduces every entry with a row for each point to ``(V, ...)``, and
    adds ``inverse`` ``(N,)``, int64, negative for none: ``restore_points`` takes labels of the
    voxels back to all points. It names rows of the whole sample, in a batch too; in a PyG ``Data``
    it is ``inverse_index``, which PyG keeps so when it batches. Where ``inverse`` is there already,
    it goes on from its points. No voxel crosses the clouds of a batch. See ``sample_voxels``.

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
