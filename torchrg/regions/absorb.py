"""Points without a region join the region next to them whose plane they are on."""

import torch
from torch import Tensor

from torchrg.regions.contacts import contact_neighbors
from torchrg.regions.criteria import sq_chord_limit, sq_chords
from torchrg.structures import UNLABELED, Neighbors


def absorb_points(
    points: Tensor,
    normals: Tensor,
    labels: Tensor,
    neighbors: Neighbors,
    planes: tuple[Tensor, Tensor, Tensor],
    *,
    valid: Tensor,
    max_angle_deg: float,
) -> Tensor:
    """Give points without a region to regions they touch, until none can be given.

    A point may join a region when one of its 8 nearest neighbours belongs to it, its distance to
    the region's plane is within reach, and its normal is within the angle of the plane's. Of
    several regions it joins the one whose plane is nearest. Points that joined in one round are
    neighbours in the next.

    Args:
        points: Points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``.
        labels: Region of each point, shape ``(N,)``, or :data:`torchrg.UNLABELED`.
        neighbors: Neighbours of each point.
        planes: Unit normal ``(M, 3)``, a point ``(M, 3)`` and the reach ``(M,)`` of each region,
            in float64; reach 0 keeps all but the points exactly on the plane out, NaN all.
        valid: Points that may join, shape ``(N,)``, bool.
        max_angle_deg: See above.

    Returns:
        Labels, shape ``(N,)``.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 1]])
        >>> neighbors = Neighbors(torch.tensor([[0, 1], [1, 0], [2, 1], [3, 2]]))
        >>> plane = torch.tensor([[0.0, 0, 1]]).double()
        >>> planes = (plane, torch.zeros(1, 3).double(), torch.full((1,), 0.1).double())
        >>> absorb_points(
        ...     points, plane.float().expand(4, 3), torch.tensor([0, -1, -1, -1]), neighbors,
        ...     planes, valid=torch.ones(4).bool(), max_angle_deg=30.0,
        ... ).tolist()
        [0, 0, 0, -1]
    """
    normal, center, reach = planes
    labels = labels.clone()
    nearest, counted = contact_neighbors(neighbors)
    limit = sq_chord_limit(max_angle_deg)
    waiting = ((labels == UNLABELED) & valid).nonzero().squeeze(1)
    while len(waiting):
        near = labels[nearest[waiting]]
        near = torch.where(counted[waiting], near, UNLABELED)
        touches = (near >= 0).any(dim=1)
        rows, near = waiting[touches], near[touches]
        if len(rows) == 0:
            break
        region = near.clamp(min=0)
        away = points[rows].double()[:, None] - center[region]
        distance = (away * normal[region]).sum(dim=2).abs()
        own = normals[rows].double()[:, :, None].unbind(dim=1)
        fits = (near >= 0) & (distance <= reach[region])
        fits &= sq_chords(own, normal[region].unbind(dim=2)) <= limit
        distance = torch.where(fits, distance, torch.inf)
        least = distance.amin(dim=1, keepdim=True)
        joined = least.squeeze(1).isfinite()
        if not joined.any():
            break
        choice = torch.where(distance == least, near, len(normal)).amin(dim=1)
        labels[rows[joined]] = choice[joined]
        waiting = waiting[labels[waiting] == UNLABELED]
    return labels
