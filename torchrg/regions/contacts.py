"""Where regions touch: points among the few nearest neighbours of points of another region."""

import torch
from torch import Tensor

from torchrg._take import places_of
from torchrg.structures import Neighbors

NUM_CONTACTS = 8
"""So many neighbours surround a point of a surface; more reach across gaps."""


def contact_neighbors(neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return the nearest neighbours of each point, and which of these entries count.

    Args:
        neighbors: Neighbours, by distance, the point itself first.

    Returns:
        Rows ``(N, n)``, int64, and mask ``(N, n)``, with n = 8 or what there is.

    Example:
        >>> contact_neighbors(Neighbors(torch.tensor([[0, 1], [1, 0]])))[0].tolist()
        [[1], [0]]
    """
    nearest = neighbors.indices[:, 1 : NUM_CONTACTS + 1].long()
    if neighbors.valid is None:
        return nearest, torch.ones_like(nearest, dtype=torch.bool)
    return nearest, neighbors.valid[:, 1 : NUM_CONTACTS + 1]


def count_contacts(labels: Tensor, neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return the pairs of regions that touch, and the number of contacts of each pair.

    Args:
        labels: Region of each point, shape ``(N,)``, negative for none.
        neighbors: Neighbours of each point.

    Returns:
        Pairs ``(E, 2)``, the smaller label first, ascending, and counts ``(E,)``.

    Example:
        >>> neighbors = Neighbors(torch.tensor([[0, 1], [1, 0], [2, 1]]))
        >>> count_contacts(torch.tensor([0, 1, 1]), neighbors)
        (tensor([[0, 1]]), tensor([2]))
    """
    nearest, counted = contact_neighbors(neighbors)
    other = labels[nearest]
    touches = counted & (other != labels[:, None]) & (other >= 0) & (labels[:, None] >= 0)
    places = places_of(touches)
    own, other = labels[places // touches.shape[1]], other.reshape(-1)[places]
    num_regions = int(labels.max()) + 1 if len(labels) else 0
    keys = torch.minimum(own, other) * num_regions + torch.maximum(own, other)
    found, counts = torch.unique(keys, return_counts=True)
    width = max(num_regions, 1)
    return torch.stack([found // width, found % width], dim=1), counts
