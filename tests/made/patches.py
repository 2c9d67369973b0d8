"""Neighbourhoods with outliers."""

import torch
from torch import Tensor

OUTLIERS = ("cluster", "shell", "far")
"""Kinds: a compact cluster beside the plane, a shell around the point, and a cluster far away."""
_SIZE = 50
"""Points of a neighbourhood."""


def contaminated(
    kind: str, share: float, rng: torch.Generator, count: int = 30
) -> tuple[Tensor, Tensor]:
    """Return noisy planes turned at random, a share of the points outliers, and their normals.

    Example:
        >>> patches, normals = contaminated("shell", 0.1, torch.Generator(), count=3)
        >>> patches.shape, normals.shape
        (torch.Size([3, 50, 3]), torch.Size([3, 3]))
    """
    patches = torch.rand(count, _SIZE, 3, generator=rng) - 0.5
    patches[..., 2] = 0.01 * torch.randn(count, _SIZE, generator=rng)
    number = round(share * _SIZE)
    scatter = torch.randn(count, number, 3, generator=rng)
    patches[:, :number] = {
        "cluster": torch.tensor([0.2, 0.1, 0.4]) + 0.05 * scatter,
        "shell": 0.5 * scatter / scatter.norm(dim=-1, keepdim=True),
        "far": torch.tensor([5.0, 5.0, 10.0]) + scatter,
    }[kind]
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=rng)).Q
    return patches @ turn, turn[:, 2]
