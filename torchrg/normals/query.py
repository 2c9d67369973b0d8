"""The query point of a neighbourhood, and the others about it."""

import torch
from torch import Tensor


def about_query(patches: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the first point of each patch that counts, and all points relative to it.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold NaN. Default: all.

    Returns:
        Query points, shape ``(*, 3)``, and differences to them, shape ``(*, K, 3)``, zero for
        points that do not count.

    Example:
        >>> patches, mask = torch.tensor([[5.0, 5, 5], [1, 2, 3]]), torch.tensor([False, True])
        >>> about_query(patches, mask)[0]
        tensor([1., 2., 3.])
    """
    if mask is None:
        return patches[..., 0, :], patches - patches[..., :1, :]
    first = mask.to(torch.uint8).argmax(dim=-1)[..., None, None]
    query = patches.gather(-2, first.expand(*first.shape[:-1], 3))
    query = torch.where(mask.any(dim=-1)[..., None, None], query, 0.0)
    return query.squeeze(-2), torch.where(mask[..., None], patches - query, 0.0)
