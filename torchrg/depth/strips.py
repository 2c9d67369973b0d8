"""Strips along rounded edges of a depth image go to the faces beside them."""

import torch
from torch import Tensor

from torchrg.linalg import deg_to_sq_chord, sq_chords
from torchrg.structures import UNLABELED

_MOST_WIDTH = 10.0
"""Pixels; a wider strip is a face of its own."""
_MOST_SHARE = 0.4
"""Width of a strip as a share of that of the face beside it."""
_MOST_TURN_DEG = 35.0
"""Either half of a rounded edge of a right angle is turned by less against its face."""
_LEAST_BESIDE = 0.5
"""Share of the length of a strip along which it meets the face without a step."""
_MOST_NOISE = 3.0
"""A gap of less than this many standard deviations of the noise of a pixel is no step."""
_LEAST_REACH = 2.0
"""Regions meet without a step if their planes cross within so many pixels of the border, or within
half the width of the strip if that is more."""


def join_strips(
    labels: Tensor, rays: Tensor, noise: Tensor, planes: Tensor, normals: Tensor
) -> Tensor:
    """Give narrow regions to the face that they bend away from, and return the labels ``(H, W)``.

    A region is a strip of the face beside it if it is less than 10 pixels wide and at most 0.4 of
    the face, if its plane is turned by at most 35 degrees against the face's, and if along half of
    its length or more the two meet without a step: their planes cross near the border, or are one
    within the noise there. Of several faces it goes to the one that it meets at most pixels, of
    equal ones to the larger. Strips of strips stay.

    The width of a region is twice its pixels over its circumference in sides of pixels. ``labels``
    ``(H, W)`` are 0 to M-1 by descending size or :data:`torchrg.UNLABELED`; ``rays`` ``(H, W, 3)``
    are ``(x, y, 1)``, so that those times ``planes`` ``(M, 3)`` are inverse depths, with a standard
    deviation ``noise`` ``(H, W)``; ``normals`` ``(M, 3)`` are those of the regions in space.
    """
    num_regions = len(normals)
    edges, meetings = labels.new_zeros(num_regions + 1), []
    for image, turned_rays, deviation in (
        (labels, rays, noise),
        (labels.T, rays.transpose(0, 1), noise.T),
    ):
        row, column = (image[:-1] != image[1:]).nonzero().unbind(dim=1)
        first, second = image[row, column], image[row + 1, column]
        for some in (first, second, image[0], image[-1]):
            edges += torch.bincount(some + 1, minlength=num_regions + 1)
        meets = (first >= 0) & (second >= 0)
        row, column = row[meets], column[meets]
        pairs = torch.stack([first[meets], second[meets]], dim=1)
        apart = planes[pairs[:, 0]] - planes[pairs[:, 1]]
        gap = (apart * turned_rays[row, column]).sum(dim=1).abs()
        meetings.append((pairs, apart, gap - _MOST_NOISE * deviation[row, column]))
    pairs, apart, gap = (torch.cat(part) for part in zip(*meetings, strict=True))
    count = torch.bincount(labels.flatten() + 1, minlength=num_regions + 1)[1:]
    width = 2 * count / edges[1:]
    pitch = (rays[-1, -1] - rays[0, 0])[:2] / (rays.new_tensor(labels.T.shape) - 1).clamp(min=1)
    slope = (apart[:, :2] * pitch).norm(dim=1)
    smooth = [
        pairs[gap <= slope * (width[pairs[:, 0]] / 2).clamp(min=_LEAST_REACH)],
        pairs.flip(1)[gap <= slope * (width[pairs[:, 1]] / 2).clamp(min=_LEAST_REACH)],
    ]
    pairs, contacts = torch.unique(torch.cat(smooth), dim=0, return_counts=True)
    strip, face = pairs.unbind(dim=1)
    own, theirs = (normals[part][:, :, None].unbind(dim=1) for part in (strip, face))
    joins = (width[strip] < _MOST_WIDTH) & (width[strip] <= _MOST_SHARE * width[face])
    joins &= sq_chords(own, theirs).squeeze(1) <= deg_to_sq_chord(_MOST_TURN_DEG)
    joins &= contacts >= _LEAST_BESIDE * (count / width)[strip]
    joins &= ~torch.isin(face, strip[joins])
    most = contacts.new_zeros(num_regions).scatter_reduce(0, strip[joins], contacts[joins], "amax")
    joins &= contacts == most[strip]
    unchanged = torch.arange(num_regions, device=labels.device)
    target = torch.where(most > 0, num_regions, unchanged)
    target = target.scatter_reduce(0, strip[joins], face[joins], "amin")
    return torch.cat([target, target.new_tensor([UNLABELED])])[labels]
