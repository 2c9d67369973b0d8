"""Which predicted region belongs to which true face."""

import torch
from torch import Tensor

from torchrg.metrics.contingency import ContingencyTable


def match_regions(table: ContingencyTable) -> Tensor:
    """Pair each region with the face that it overlaps most and that it is overlapped most by.

    A region and a face correspond when each is the other's largest overlap, in points [1].

    Convention:
        Equal overlaps are decided by the larger intersection over union, that is the smaller
        partner; then by the lower label. The order of the points plays no part.

    Args:
        table: Overlaps of regions and faces.

    Returns:
        The rows of the table's overlaps that are pairs, shape ``(P,)``, int64; no region and no
        face occurs twice. Empty if nothing overlaps.

    References:
        [1] Indoor Point Cloud Segmentation Using a Modified Region Growing Algorithm and Accurate
        Normal Estimation, section III.B.

    Example:
        >>> from torchrg.metrics.contingency import contingency_table
        >>> table = contingency_table(torch.tensor([4, 4, 4, 5, 5]), torch.tensor([0, 0, 1, 1, 1]))
        >>> pairs = match_regions(table)
        >>> table.region_labels[table.regions[pairs]].tolist()
        [4, 5]
        >>> table.face_labels[table.faces[pairs]].tolist()
        [0, 1]
    """
    face_sizes, region_sizes = table.face_sizes[table.faces], table.region_sizes[table.regions]
    of_region = _first_of_each(table.regions, (-table.overlaps, face_sizes, table.faces))
    of_face = _first_of_each(table.faces, (-table.overlaps, region_sizes, table.regions))
    return (of_region & of_face).nonzero().squeeze(1)


def best_iou(groups: Tensor, iou: Tensor, num_groups: int) -> Tensor:
    """Return the largest IoU of each group, 0 for a group without overlaps, shape ``(G,)``."""
    return iou.new_zeros(num_groups).scatter_reduce(0, groups, iou, "amax")


def _first_of_each(groups: Tensor, keys: tuple[Tensor, ...]) -> Tensor:
    """Mark the entry of each group that comes first by the keys, shape ``(E,)``, bool."""
    order = torch.arange(len(groups), device=groups.device)
    for key in (*reversed(keys), groups):
        order = order[key[order].argsort(stable=True)]
    ordered = groups[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return torch.zeros_like(first).index_put((order,), first)
