"""Borders between regions at the line where their planes meet."""

import torch
from torch import Tensor

from torchrg.regions.fitting import FittedPlanes
from torchrg.structures import Neighbors

# In pixels: no window reaches farther from its middle.
_MOST_ROUNDS = 16
_STRAIGHT = 0.85


def move_to_creases(
    points: Tensor, labels: Tensor, touching: Neighbors, fit: FittedPlanes, reach: Tensor
) -> Tensor:
    """Move borders between flat regions to where their planes meet.

    Within the noise of a crease a pixel lies on both planes, and which region took it is chance.
    Where the middles of two regions are on opposite sides of the line in which their planes meet,
    each off the other's plane, a pixel on the other's side goes to the other region, if it is on
    its plane and next to a pixel of it that is straight behind, as seen from the crease: borders
    move across to the crease, never along it. Pixels that went are followed by those beside them.

    Args:
        points: An image as a cloud whose first two coordinates are the slopes of the rays, shape
            ``(N, 3)``, float64.
        labels: Region of each pixel, shape ``(N,)``, negative for none.
        touching: The pixels around each pixel, itself first.
        fit: Planes of the regions in that cloud.
        reach: Distance along the last coordinate that counts as on the plane, shape ``(M,)``; NaN
            for regions that are no planes.

    Returns:
        Labels, shape ``(N,)``.

    Example:
        >>> x = torch.arange(-4.0, 5).double()
        >>> points = torch.stack([x, torch.zeros(9).double(), x.abs()], dim=1)
        >>> rows = torch.arange(9)[:, None]
        >>> touching = Neighbors(torch.cat([rows, rows - 1, rows + 1], dim=1).clamp(0, 8))
        >>> normal = torch.tensor([[1.0, 0, 1], [-1, 0, 1]]).double()
        >>> center = torch.tensor([[-2.0, 0, 2], [2, 0, 2]]).double()
        >>> fit = FittedPlanes(normal, center, *[normal] * 4)
        >>> labels = torch.tensor([0, 0, 0, 0, 0, 0, 0, 1, 1])
        >>> move_to_creases(points, labels, touching, fit, torch.ones(2)).tolist()
        [0, 0, 0, 0, 0, 1, 1, 1, 1]
    """
    offset = (fit.normal * fit.center).sum(dim=1, keepdim=True)
    planes = torch.cat([-fit.normal[:, :2], offset], dim=1) / fit.normal[:, 2:]
    middles = torch.cat([fit.center[:, :2], torch.ones_like(offset)], dim=1)
    around = touching.indices[:, 1:].long()
    counted = None if touching.valid is None else touching.valid[:, 1:]
    rays = torch.cat([points[:, :2], torch.ones_like(points[:, :1])], dim=1)
    labels = labels.clone()
    rows = (labels >= 0).nonzero().squeeze(1)
    for _ in range(_MOST_ROUNDS):
        near = labels[around[rows]]
        other = (near >= 0) & (near != labels[rows][:, None])
        if counted is not None:
            other &= counted[rows]
        at_border = other.any(dim=1)
        rows, near, other = rows[at_border], near[at_border].clamp(min=0), other[at_border]
        own = labels[rows][:, None]
        around_rays = rays[around[rows]]
        ray = rays[rows][:, None]
        apart = planes[own] - planes[near]
        here, there = (apart * ray).sum(dim=2), (apart * around_rays).sum(dim=2)
        mine, theirs = (apart * middles[own]).sum(dim=2), (apart * middles[near]).sum(dim=2)
        slope, step = apart[..., :2].norm(dim=2), (around_rays - ray)[..., :2].norm(dim=2)
        straight = there.abs() - here.abs() >= _STRAIGHT * slope * step
        away = (points[rows, 2:] - (planes[near] * ray).sum(dim=2)).abs()
        goes = other & straight & (here * mine < 0) & (mine * theirs < 0) & (away <= reach[near])
        goes &= (mine.abs() > reach[near]) & (theirs.abs() > reach[own])
        away = torch.where(goes, away, torch.inf)
        least = away.amin(dim=1, keepdim=True)
        moved = goes.any(dim=1)
        if not bool(moved.any()):
            break
        choice = torch.where(away == least, near, len(planes)).amin(dim=1)
        labels[rows[moved]] = choice[moved]
        rows = torch.unique(torch.cat([rows[moved], around[rows[moved]].flatten()]))
        rows = rows[labels[rows] >= 0]
    return labels
