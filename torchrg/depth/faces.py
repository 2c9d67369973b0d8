"""Regions of a depth image that belong to one surface.

Strips along rounded edges join the adjacent surface; coplanar regions may meet behind an object.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import nonzero_rows
from torchrg.depth.passes import has_kernels
from torchrg.depth.pixels import InverseCloud
from torchrg.linalg.angles import deg_to_sq_chord, sq_chords
from torchrg.regions.fit import RegionPlanes
from torchrg.regions.repair import remap_labels

_MAX_WIDTH = 10.0
"""Maximum width of a strip in pixels; a wider one is a separate surface."""
_MAX_WIDTH_RATIO = 0.4
"""Maximum ratio of the width of a strip to the width of the adjacent surface."""
_MAX_TURN_DEG = 35.0
"""Maximum angle between strip and surface; half of a rounded right-angled edge has less."""
_MIN_CONTACT_FRACTION = 0.5
"""Minimum fraction of the length of a strip along which it meets the surface without a step."""
_MAX_NOISE = 3.0
"""Maximum gap without a step, in standard deviations of the noise of a pixel."""
_MIN_REACH = 2.0
"""Regions meet without a step if their planes intersect within this many pixels of the boundary, or
within half the width of the strip."""
_STRIDE = 4
"""Row and column stride of the search for hidden contacts."""
_MIN_LINES = 2
"""Minimum number of sampled rows and columns that connect two regions."""
_MAX_OFFSET = 0.5
"""Maximum distance of a smaller region's center from the plane of the larger, in thicknesses."""
_MIN_NEARER = 0.5
"""Minimum fraction of the pixels between two regions in front of their plane. The remaining ones
may lie on it or have no depth, as in the shadow of a nearer object."""


def boundaries(labels: Tensor, steps: Iterable[tuple[int, int]]) -> tuple[Tensor, Tensor]:
    """Return the pairs of adjacent pixels with different labels, along steps in rows and columns.

    Both are row-major indices, ``(n,)`` each.
    """
    width, flat, pairs = labels.shape[1], labels.flatten(), []
    for down, right in steps:
        step = down * width + right
        here = nonzero_rows(flat[: max(len(flat) - step, 0)] != flat[step:])
        column = here % width + right
        here = here[nonzero_rows((column >= 0) & (column < width))]
        pairs.append(torch.stack([here, here + step]))
    first, second = torch.cat(pairs, dim=1)
    return first, second


def join_strips(
    cloud: InverseCloud, labels: Tensor, planes: Tensor, normals: Tensor, count: Tensor
) -> Tensor:
    """Merge narrow regions into the surface that they bend away from, and return the labels.

    A strip is less than 10 pixels wide, at most 0.4 of the surface, and tilted by at most 35
    degrees. It meets the surface without a step along at least half of its length: their planes
    intersect near the boundary, or coincide within the noise. Among several surfaces, the one with
    most contact pixels wins, ties go to the larger. Strips of strips are unchanged. The width of a
    region is twice its pixel count over its perimeter in pixel sides.

    ``labels`` ``(H * W,)`` are 0 to M-1 by descending size or :data:`torchrg.UNLABELED`, and are
    returned unchanged if nothing is merged. The last coordinates of the cloud are ``(x, y, 1)``
    times ``planes`` ``(M, 3)``; ``normals`` ``(M, 3)`` are in space, ``count`` ``(M,)`` are pixel
    counts.
    """
    width, strip, face, contacts = _strip_contacts(cloud, labels, planes, count)
    ours, theirs = (normals[columns][:, :, None].unbind(dim=1) for columns in (strip, face))
    joins = (width[strip] < _MAX_WIDTH) & (width[strip] <= _MAX_WIDTH_RATIO * width[face])
    joins &= sq_chords(ours, theirs).squeeze(1) <= deg_to_sq_chord(_MAX_TURN_DEG)
    joins &= contacts >= _MIN_CONTACT_FRACTION * (count / width)[strip]
    joins &= ~torch.isin(face, strip[joins])
    if not bool(joins.any()):
        return labels
    highest = torch.zeros_like(count).scatter_reduce(0, strip[joins], contacts[joins], "amax")
    joins &= contacts == highest[strip]
    unchanged = torch.arange(len(count), device=labels.device)
    target = torch.where(highest > 0, len(count), unchanged)
    return remap_labels(labels, target.scatter_reduce(0, strip[joins], face[joins], "amin"))


def _strip_contacts(
    cloud: InverseCloud, labels: Tensor, planes: Tensor, count: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the widths ``(M,)`` of regions, and how often a strip meets a surface without a step.

    Strips, surfaces, and the number of their sides of pixels are ``(n,)`` each.
    """
    _, x, y, noise, _ = cloud
    num_regions, image = len(count), labels.view(noise.shape)
    pitch = [float((index[-1] - index[0]) / max(len(index) - 1, 1)) for index in (x, y)]
    here, there = boundaries(image, [(1, 0), (0, 1)])
    pairs = torch.stack([labels.index_select(0, pixels) for pixels in (here, there)])
    sides = torch.cat([pairs.flatten(), image[0], image[-1], image[:, 0], image[:, -1]])
    width = 2 * count.double() / torch.bincount(sides + 1, minlength=num_regions + 1)[1:]
    meets = nonzero_rows((pairs[0] >= 0) & (pairs[1] >= 0))
    here, (one, two) = here[meets], pairs[:, meets]
    a, b, c = (planes[one] - planes[two]).unbind(dim=1)
    gap = (a * x[here % len(x)] + b * y[here // len(x)] + c).abs()
    gap -= _MAX_NOISE * noise.flatten()[here]
    slope = ((a * pitch[0]).square() + (b * pitch[1]).square()).sqrt()
    reach = (width / 2).clamp(min=_MIN_REACH)
    keys = [
        (strip * num_regions + face)[nonzero_rows(gap <= slope * reach[strip])]
        for strip, face in ((one, two), (two, one))
    ]
    pair, contacts = torch.unique(torch.cat(keys), return_counts=True)
    return width, pair // num_regions, pair % num_regions, contacts


def hidden_contacts(
    cloud: InverseCloud, labels: Tensor, planes: RegionPlanes, reach: Tensor
) -> tuple[Tensor, Tensor]:
    """Return pairs of coplanar regions separated only by nearer objects, and contact counts.

    The center of the smaller region is on the plane of the larger one. Along some rows or columns,
    no pixel between the two is behind that plane, and at least half are in front. A pixel behind a
    plane shows that the plane ends there, such as the floor between two tables of equal height.

    ``reach`` ``(M,)`` is the maximum distance of a point on a plane, NaN for a curved region. The
    pairs are in the format of :func:`torchrg.regions.repair.merge_coplanar`.
    """
    pairs, tables = _aligned_pairs(planes), (planes.normal, planes.center, reach)
    seen = cloud.seen
    if has_kernels(cloud.values):
        image = *cloud[:3], seen, labels.view(seen.shape)
        (lines, *_) = kernels.call("count_lines", *image, *tables, pairs, _STRIDE, _MIN_NEARER)
    else:
        pixels = cloud.points.view(*seen.shape, 3), seen, labels.view(seen.shape)
        rows = [values[::_STRIDE] for values in pixels]
        columns = [values[:, ::_STRIDE].transpose(0, 1) for values in pixels]
        lines = pairs.new_tensor(
            [
                sum(_count_lines(axis, (a, b), *(t[a] for t in tables)) for axis in (rows, columns))
                for a, b in pairs.tolist()
            ]
        )
    is_hidden = lines >= _MIN_LINES
    return pairs[is_hidden].sort(dim=1).values, lines[is_hidden] * _STRIDE


def _aligned_pairs(planes: RegionPlanes) -> Tensor:
    """Return pairs ``(p, 2)`` of a larger region and a smaller one centered on its plane."""
    normal, center, count = planes.normal, planes.center, planes.num_points
    offset = normal @ center.T - (normal * center).sum(dim=1, keepdim=True)
    aligned = offset.abs() <= _MAX_OFFSET * planes.thickness[:, None]
    index = torch.arange(len(count), device=count.device)
    is_larger = (count[:, None] > count) | ((count[:, None] == count) & (index[:, None] < index))
    both_flat = ~(planes.curved[:, None] | planes.curved)
    return (aligned & is_larger & both_flat).nonzero()


def _count_lines(
    lines: list[Tensor], pair: tuple[int, int], normal: Tensor, center: Tensor, reach: Tensor
) -> int:
    """Return the number of lines that connect two regions past nearer objects.

    Nearer means in front of the plane of the larger one. The lines are points ``(n, L, 3)``, a mask
    of seen pixels, and labels ``(n, L)``.
    """
    points, seen, labels = lines
    first, second = ((labels == region) for region in pair)
    both = first.any(dim=1) & second.any(dim=1)
    if not bool(both.any()):
        return 0
    points, seen, first, second = points[both], seen[both], first[both], second[both]
    height = ((points - center) * normal).sum(dim=2)
    in_front = seen & (height > reach)
    ends = first | second | (seen & (height < -reach))
    index = torch.arange(ends.shape[1], device=ends.device).expand_as(height)
    previous = torch.where(ends, index, -1).cummax(dim=1).values[:, :-1]
    num_in_front = in_front.cumsum(dim=1)
    here, before = ends[:, 1:], previous.clamp(min=0)
    gap = index[:, 1:] - previous - 1
    num_nearer = num_in_front[:, :-1] - num_in_front.gather(1, before)
    other = (first[:, 1:] & second.gather(1, before)) | (second[:, 1:] & first.gather(1, before))
    connects = here & other & (previous >= 0) & (gap > 0) & (num_nearer >= _MIN_NEARER * gap)
    return int(connects.any(dim=1).sum())
