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
"""Either half of a rounded edge between faces at right angles is turned by less against its face."""
_LEAST_BESIDE = 0.5
"""Share of the length of a strip along which it meets the face without a step."""
_STEP_NOISE = 3.0
"""Standard deviations of the noise of a pixel that are no step."""


def join_strips(labels: Tensor, values: Tensor, noise: Tensor, normals: Tensor) -> Tensor:
    """Give narrow regions to the face that they bend away from, and return the labels ``(H, W)``.

    A region is a strip of the face beside it if it is less than 10 pixels wide and at most 0.4 of
    the face, if its plane is turned by at most 35 degrees against the face's, and if along half of
    its length or more the two meet without a step. Of several faces it goes to the one that it
    meets at most pixels, of equal ones to the larger. Strips of strips stay.

    The width of a region is twice its pixels over its circumference in sides of pixels. ``labels``
    ``(H, W)`` are 0 to M-1 by descending size or :data:`torchrg.UNLABELED`, ``values`` and
    ``noise`` ``(H, W)`` the inverse depth and its standard deviation, ``normals`` ``(M, 3)`` those
    of the regions in space.
    """
    num_regions = len(normals)
    edges = labels.new_zeros(num_regions + 1)
    meetings = [labels.new_zeros(0, 2)]
    for image, value, deviation in ((labels, values, noise), (labels.T, values.T, noise.T)):
        padded = torch.nn.functional.pad(image, (0, 0, 1, 1), value=UNLABELED - 1)
        for beside in (padded[:-2], padded[2:]):
            edges += torch.bincount(image[beside != image] + 1, minlength=num_regions + 1)
        first, second = image[:-1], image[1:]
        meets = (first != second) & (first >= 0) & (second >= 0)
        meets &= _is_smooth(value, _STEP_NOISE * deviation)
        pairs = torch.stack([first[meets], second[meets]], dim=1)
        meetings += [pairs, pairs.flip(1)]
    pairs, contacts = torch.unique(torch.cat(meetings), dim=0, return_counts=True)
    strip, face = pairs.unbind(dim=1)
    count = torch.bincount(labels.flatten() + 1, minlength=num_regions + 1)[1:]
    width = 2 * count / edges[1:]
    own, theirs = (normals[part][:, :, None].unbind(dim=1) for part in (strip, face))
    joins = (width[strip] < _MOST_WIDTH) & (width[strip] <= _MOST_SHARE * width[face])
    joins &= sq_chords(own, theirs).squeeze(1) <= deg_to_sq_chord(_MOST_TURN_DEG)
    joins &= contacts >= _LEAST_BESIDE * (count / width)[strip]
    joins &= ~torch.isin(face, strip[joins])
    most = contacts.new_zeros(num_regions).scatter_reduce(0, strip[joins], contacts[joins], "amax")
    joins &= contacts == most[strip]
    own = torch.arange(num_regions, device=labels.device)
    target = torch.where(most > 0, num_regions, own)
    target = target.scatter_reduce(0, strip[joins], face[joins], "amin")
    return torch.cat([target, target.new_tensor([UNLABELED])])[labels]


def _is_smooth(values: Tensor, tolerance: Tensor) -> Tensor:
    """Return whether each row goes on to the next one without a step, shape ``(H - 1, W)``.

    On a bend or a crease a value changes by no less and no more than before and after.
    """
    change = values[1:] - values[:-1]
    around = torch.nn.functional.pad(change[None], (0, 0, 1, 1), mode="replicate")[0]
    before, after = around[:-2], around[2:]
    slack = torch.maximum(tolerance[:-1], tolerance[1:])
    least, most = torch.minimum(before, after) - slack, torch.maximum(before, after) + slack
    return (change >= least) & (change <= most)
