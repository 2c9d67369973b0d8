"""Small changes of clouds that other transforms and models ask for."""

from typing import Any

import torch
from torch import Tensor

from torchrg.transforms.sample import SampleTransform, cloud_ends
from torchrg.transforms.selection import select_points


class CenterCloud(SampleTransform):
    """Move each cloud so that the middle of its bounding box is the origin.

    Reads ``coord`` ``(N, 3)``; changes it, and adds ``origin`` ``(B, 3)``, float64, where the
    origin of the new coordinates is in the old ones (an ``origin`` that is there is added up), so
    that ``coord + origin`` is what it was. Points that are not finite do not count.

    Example:
        >>> corner = torch.tensor([[5.0, 5.0, 5.0], [7.0, 5.0, 5.0]])
        >>> sample = CenterCloud()({"coord": corner})
        >>> sample["coord"].tolist(), sample["origin"].tolist()
        ([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[6.0, 5.0, 5.0]])
    """

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample with moved coordinates."""
        coord = self.read(sample, "coord")
        ends = cloud_ends(sample, len(coord))
        clouds = [coord[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]
        middles = torch.stack([_middle(cloud) for cloud in clouds])
        moved = [
            (cloud.double() - middle).to(cloud.dtype)
            for cloud, middle in zip(clouds, middles, strict=True)
        ]
        key = self.key(sample, "origin")
        if key in sample:
            middles = middles + self.read(sample, "origin").reshape(-1, 3)
        return self.changed(sample, {self.key(sample, "coord"): torch.cat(moved), key: middles})


class KeepFinite(SampleTransform):
    """Leave out points whose coordinates are not finite, from every entry with a row a point.

    Example:
        >>> sample = {"coord": torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0]]), "name": "a"}
        >>> KeepFinite()(sample)
        {'coord': tensor([[0., 0., 0.]]), 'name': 'a'}
    """

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample with the finite points."""
        coord = self.read(sample, "coord")
        rows = coord.isfinite().all(dim=-1).nonzero().squeeze(-1)
        return self.changed(sample, select_points(sample, rows, num_points=len(coord)))


def _middle(cloud: Tensor) -> Tensor:
    """Return the middle of the box around the finite points, float64; zero if there is none."""
    finite = cloud[cloud.isfinite().all(dim=-1)].double()
    if len(finite) == 0:
        return torch.zeros(3, dtype=torch.float64, device=cloud.device)
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    return low + (high - low) / 2
