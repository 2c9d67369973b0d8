"""Regions of a depth image: growth from pixel to pixel, then absorption, merging, sharp creases."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._parallel import map_tasks, places_of
from torchrg.config import DepthConfig
from torchrg.depth.normals import PixelPlanes
from torchrg.linalg import deg_to_sq_chord, second_moments, sq_chords
from torchrg.linalg.moments import Segments
from torchrg.regions.faces import merge_coplanar
from torchrg.regions.growth import number_by_size
from torchrg.regions.planes import FittedPlanes
from torchrg.regions.refine import reach_of_planes
from torchrg.robust.scale import MAD_FACTOR
from torchrg.structures import UNLABELED

_AHEAD = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Steps in rows and columns to those around a pixel that come after it."""

_AROUND = (*_AHEAD, *((-down, -right) for down, right in _AHEAD))

_NUM_PASSES = 2
"""Absorption and merging go on twice: pixels that a region absorbed may make it touch another."""

_CURVED = 3.0
"""A region this many times thicker than its noise is no plane,"""

_BENT = 0.03
"""if it is also thicker than this share of its own extent: a slightly bent face is a face. A column
has 0.4."""

_NUM_FITS = 2
"""A plain fit and a reweighted one: pixels that grew into a region are near its plane already."""

_BISQUARE_CUT = 4.685
"""Pixels this many standard deviations from a region's plane have no weight in it."""

_ALIKE = 1.75
"""Normals of two windows that both hold both pixels may differ by this many times the angle: on a
column large windows turn by more than the angle from one cell to the next,"""

_SLOPE_NOISE = 1.0
"""or by as much as makes their slopes differ by this many standard deviations: small windows of a
narrow face turn by noise alone."""

_MOST_MOVES = 16
"""In pixels: windows hardly reach farther from their middle."""

_STRAIGHT = 0.85
"""Cosine of the largest angle between a step straight away from a crease and one that counts."""


class InverseCloud(NamedTuple):
    """A depth image as a cloud where planes stay planes and noise is the same near and far.

    Its coordinates are the slopes of the ray and the inverse depth, ``(x / z, y / z, c / z)`` with
    the median depth ``c``: a projective map of space. ``points`` ``(H * W, 3)`` are of float64, in
    columns; ``noise`` ``(H * W,)`` is the standard deviation of the last coordinate, and ``seen``
    ``(H, W)`` are the pixels with depth.
    """

    points: Tensor
    noise: Tensor
    seen: Tensor


def grow_pixels(
    cloud: InverseCloud,
    pixels: PixelPlanes,
    normals: Tensor,
    u: Tensor,
    v: Tensor,
    config: DepthConfig,
) -> tuple[Tensor, Tensor, Tensor]:
    """Grow regions over a depth image, and give border pixels and parts of one face to them.

    Two pixels side by side are on one surface if both have a flat window, their normals in space
    ``(H, W, 3)`` are within the angle, and at both pixels their two planes differ by at most
    ``max_step`` times what a flat window may deviate by: no region crosses a step. Where both
    windows hold both pixels the angle may be larger: a crease between the pixels would lie within
    two flat windows. Regions are what hangs together by such pairs.

    ``u`` ``(W,)`` and ``v`` ``(H, 1)`` count columns and rows from the optical axis.

    Returns:
        Labels ``(H * W,)``, 0 to M-1 by descending size or :data:`torchrg.UNLABELED`; unit normals
        of the regions' planes towards the camera, in space, ``(M, 3)``; and whether a region is
        thicker than noise and a slight bend can make it, ``(M,)``, bool.
    """

    def join(axis: int) -> Tensor:
        return _joins(pixels, normals, u, v, axis, config)

    down, right = map_tasks(join, (0, 1), normals.device)
    labels = number_by_size(_connected(pixels.flat, down, right), config.min_size)
    if not bool((labels >= 0).any()):
        return labels, normals.new_empty(0, 3), pixels.flat.new_empty(0)
    labels, fit = _refine(cloud, labels, config)
    distance = (fit.normal * fit.center).sum(dim=1)
    away = torch.stack([-fit.normal[:, 0], -fit.normal[:, 1], distance], dim=1)
    return labels, -away / away.norm(dim=1, keepdim=True), fit.curved


def _joins(
    pixels: PixelPlanes, normals: Tensor, u: Tensor, v: Tensor, axis: int, config: DepthConfig
) -> Tensor:
    """Return whether pixels and the next ones along an axis are on one surface, one place less.

    Pixels of one window are: only the pairs of two windows are looked at.
    """
    width, length = pixels.flat.shape[1], pixels.flat.shape[axis] - 1
    joins = pixels.flat.narrow(axis, 0, length) & pixels.flat.narrow(axis, 1, length)
    one_window = pixels.window.narrow(axis, 0, length) == pixels.window.narrow(axis, 1, length)
    rows, columns = (joins & ~one_window).nonzero().unbind(dim=1)
    here = rows * width + columns
    there = here + (width if axis == 0 else 1)
    first, second = pixels.planes.take(here), pixels.planes.take(there)
    u_slope, v_slope = first.u_slope - second.u_slope, first.v_slope - second.v_slope
    step = u_slope * u[columns] + v_slope * v.flatten()[rows] + first.origin - second.origin
    next_step = step + (v_slope if axis == 0 else u_slope)
    tolerance = pixels.tolerance.flatten()
    limit = config.max_step * torch.maximum(tolerance[here], tolerance[there])
    own, theirs = (normals.view(-1, 3)[at][:, :, None].unbind(dim=1) for at in (here, there))
    turned = sq_chords(own, theirs).squeeze(1)
    accepted = turned <= deg_to_sq_chord(config.max_angle_deg)
    wider = deg_to_sq_chord(min(_ALIKE * config.max_angle_deg, 90.0))
    sq_noise = pixels.sq_slope_noise(here) + pixels.sq_slope_noise(there)
    alike = u_slope.square() + v_slope.square() <= _SLOPE_NOISE**2 * sq_noise
    alike |= turned <= wider
    accepted |= alike & pixels.holds(here, there) & pixels.holds(there, here)
    joins[rows, columns] = accepted & (step.abs() <= limit) & (next_step.abs() <= limit)
    return joins


def _connected(flat: Tensor, down: Tensor, right: Tensor) -> Tensor:
    """Return the parts of an image that hang together ``(H * W,)``, -1 where it is not flat.

    From which pixels join the next one, ``(H - 1, W)`` and ``(H, W - 1)``. On a grid with a place
    for each pixel and each pair they are the connected components of scipy.
    """
    from scipy.ndimage import label

    height, width = flat.shape
    grid = np.zeros((2 * height - 1, 2 * width - 1), dtype=bool)
    grid[::2, ::2], grid[1::2, ::2], grid[::2, 1::2] = (
        part.cpu().numpy() for part in (flat, down, right)
    )
    parts = label(grid)[0][::2, ::2].astype(np.int64)
    return torch.from_numpy(parts.ravel() - 1).to(flat.device)


def _pixels_around(pixels: Tensor, shape: torch.Size) -> Tensor:
    """Return the pixels around each of some ``(n,)``, by row-major place, shape ``(n, 8)``.

    For those outside of the image stand the nearest inside.
    """
    height, width = shape
    down, right = torch.tensor(_AROUND, device=pixels.device).T
    row = (pixels[:, None] // width + down).clamp(0, height - 1)
    column = (pixels[:, None] % width + right).clamp(0, width - 1)
    around: Tensor = row * width + column
    return around


def _border_pixels(labels: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Return the pairs of pixels of two regions side by side, each once, by row-major place."""
    pairs = []
    for down, right in _AHEAD:
        step = down * width + right
        here = places_of(labels[: max(len(labels) - step, 0)] != labels[step:])
        column = here % width + right
        has_next = (column >= 0) & (column < width)
        here = here[has_next & (labels[here] >= 0) & (labels[here + step] >= 0)]
        pairs.append((here, here + step))
    first, second = (torch.cat(ends) for ends in zip(*pairs, strict=True))
    return first, second


def _contacts(labels: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Do as :func:`torchrg.regions.adjacency.count_contacts` where pixels side by side touch."""
    regions = torch.stack([labels[pixels] for pixels in _border_pixels(labels, width)])
    num_regions = int(labels.max()) + 1
    keys = regions.amin(dim=0) * num_regions + regions.amax(dim=0)
    keys, counts = torch.unique(keys, return_counts=True)
    # Either pixel is a neighbour of the other.
    return torch.stack([keys // num_regions, keys % num_regions], dim=1), 2 * counts


def _refine(
    cloud: InverseCloud, labels: Tensor, config: DepthConfig
) -> tuple[Tensor, FittedPlanes]:
    """Settle borders and parts of the regions of a depth image.

    Twice, pixels without a region join the one beside them whose plane they are on, and flat
    regions that touch and lie on one plane are merged. Then borders between regions move to the
    lines where their planes meet.

    At least one pixel has a label. Returns labels by descending size, and the planes of the regions
    in the cloud; curved are those thicker than noise and a slight bend can make them.
    """
    for _ in range(_NUM_PASSES):
        fit, noise = _fit(cloud, labels)
        reach = reach_of_planes(fit, noise, config.absorb_reach)
        labels = absorb_pixels(cloud, labels, fit, reach)
        contacts = _contacts(labels, cloud.seen.shape[1])
        merged = merge_coplanar(labels, contacts, fit, noise, tolerance=config.merge_tolerance)
        labels = number_by_size(merged, config.min_size)
    fit, noise = _fit(cloud, labels)
    reach = reach_of_planes(fit, noise, config.absorb_reach)
    moved = move_to_creases(cloud, labels, fit, reach)
    labels = number_by_size(moved, config.min_size)
    return labels, _fit(cloud, labels)[0]


def _fit(cloud: InverseCloud, labels: Tensor) -> tuple[FittedPlanes, Tensor]:
    """Return the planes of the regions, and the noise of each, shape ``(M,)``."""
    segments = Segments(labels)
    noise = segments.mean(segments.take(cloud.noise))
    return fit_regions(segments, cloud.points, noise), noise


def fit_regions(segments: Segments, points: Tensor, noise: Tensor) -> FittedPlanes:
    """Fit planes to regions by least squares along the last coordinate, which alone has noise.

    A second fit has weights by Tukey's bisquare, as :func:`torchrg.regions.planes.fit_planes` has;
    the thickness, along the normals, is never taken for less than the ``noise`` ``(M,)`` there.
    Curved is what is thicker than noise and a slight bend can make it.
    """
    columns = segments.take_columns(points)
    x, y, w = columns
    weights = torch.ones_like(w)
    for last in range(_NUM_FITS):
        total = segments.sum(weights)
        center = torch.stack([segments.sum(column * weights) for column in columns], dim=1)
        center = center / total[:, None]
        about_zero = second_moments(columns, weights, segments.sum, total)
        covariance = about_zero - center[:, :, None] * center[:, None, :]
        inverse = torch.linalg.pinv(covariance[:, :2, :2], hermitian=True)
        slopes = (inverse @ covariance[:, :2, 2:]).squeeze(2)
        offset = center[:, 2] - (slopes * center[:, :2]).sum(dim=1)
        a, b, c = segments.spread_columns(torch.cat([slopes, offset[:, None]], dim=1))
        residuals = w - a * x - b * y - c
        thickness = MAD_FACTOR * segments.median(residuals.abs())
        if last == _NUM_FITS - 1:
            break
        ratio = residuals / segments.spread(_BISQUARE_CUT * torch.maximum(thickness, noise))
        weights = (1 - ratio * ratio).clamp(min=0).square()
    normal = torch.cat([-slopes, torch.ones_like(slopes[:, :1])], dim=1)
    length = normal.norm(dim=1, keepdim=True)
    # In the distance d of a plane from the camera, w is 1 / d of the cosine along a ray.
    nearness = torch.cat([slopes, offset[:, None]], dim=1).norm(dim=1)
    extent = torch.linalg.eigvalsh(covariance[:, :2, :2])[:, 0].clamp(min=0).sqrt()
    return FittedPlanes(
        normal / length,
        center,
        normal / length,
        covariance,
        thickness / length.squeeze(1),
        residuals,
        segments.counts,
        thickness > torch.maximum(_CURVED * noise, _BENT * extent * nearness),
    )


def absorb_pixels(cloud: InverseCloud, labels: Tensor, fit: FittedPlanes, reach: Tensor) -> Tensor:
    """Give pixels without a region to regions they touch, until none can be given.

    This is :func:`torchrg.regions.refine.absorb_points` without an angle, where whoever is beside a
    pixel has it beside itself: after the first time, only pixels beside those that joined are
    looked at. ``reach`` ``(M,)`` is that of the planes, NaN where a region takes none.
    """
    labels, offset = labels.clone(), (fit.normal * fit.center).sum(dim=1)
    free = (labels == UNLABELED) & cloud.seen.flatten()
    rows = free.nonzero().squeeze(1)
    while len(rows):
        near = labels[_pixels_around(rows, cloud.seen.shape)]
        touches = (near >= 0).any(dim=1)
        rows, near = rows[touches], near[touches]
        region = near.clamp(min=0)
        away = (cloud.points[rows][:, None] * fit.normal[region]).sum(dim=2) - offset[region]
        away = torch.where((near >= 0) & (away.abs() <= reach[region]), away.abs(), torch.inf)
        least = away.amin(dim=1, keepdim=True)
        joined = least.squeeze(1).isfinite()
        choice = torch.where(away == least, near, len(offset)).amin(dim=1)
        rows = rows[joined]
        labels[rows] = choice[joined]
        free[rows] = False
        beside = _pixels_around(rows, cloud.seen.shape)
        rows = torch.unique(beside[free[beside]])
    return labels


def move_to_creases(
    cloud: InverseCloud, labels: Tensor, fit: FittedPlanes, reach: Tensor
) -> Tensor:
    """Move borders between flat regions to where their planes meet.

    Within the noise of a crease a pixel lies on both planes, and which region took it is chance.
    Where the middles of two regions are on opposite sides of the line in which their planes meet,
    each off the other's plane, a pixel on the other's side goes to the other region, if it is on
    its plane and next to a pixel of it that is straight behind, as seen from the crease: borders
    move across to the crease, never along it. Pixels that went are followed by those beside them.

    ``reach`` is the distance along the last coordinate that counts as on the plane, shape ``(M,)``.
    """
    offset = (fit.normal * fit.center).sum(dim=1, keepdim=True)
    planes = torch.cat([-fit.normal[:, :2], offset], dim=1) / fit.normal[:, 2:]
    middles = torch.cat([fit.center[:, :2], torch.ones_like(offset)], dim=1)
    labels = labels.clone()
    rows = torch.unique(torch.cat(_border_pixels(labels, cloud.seen.shape[1])))
    for _ in range(_MOST_MOVES):
        around = _pixels_around(rows, cloud.seen.shape)
        near = labels[around]
        other = (near >= 0) & (near != labels[rows][:, None])
        at_border = other.any(dim=1)
        rows, around, other = rows[at_border], around[at_border], other[at_border]
        near, own = near[at_border].clamp(min=0), labels[rows][:, None]
        ray, around_rays = _rays(cloud, rows[:, None]), _rays(cloud, around)
        apart = planes[own] - planes[near]
        here, there = (apart * ray).sum(dim=2), (apart * around_rays).sum(dim=2)
        mine, theirs = (apart * middles[own]).sum(dim=2), (apart * middles[near]).sum(dim=2)
        slope, step = apart[..., :2].norm(dim=2), (around_rays - ray)[..., :2].norm(dim=2)
        straight = there.abs() - here.abs() >= _STRAIGHT * slope * step
        away = (cloud.points[rows, 2:] - (planes[near] * ray).sum(dim=2)).abs()
        goes = other & straight & (here * mine < 0) & (mine * theirs < 0) & (away <= reach[near])
        goes &= (mine.abs() > reach[near]) & (theirs.abs() > reach[own])
        away = torch.where(goes, away, torch.inf)
        least = away.amin(dim=1, keepdim=True)
        moved = goes.any(dim=1)
        if not bool(moved.any()):
            break
        choice = torch.where(away == least, near, len(planes)).amin(dim=1)
        labels[rows[moved]] = choice[moved]
        rows = torch.unique(torch.cat([rows[moved], around[moved].flatten()]))
        rows = rows[labels[rows] >= 0]
    return labels


def _rays(cloud: InverseCloud, pixels: Tensor) -> Tensor:
    """Return the rays ``(x, y, 1)`` of some pixels ``(*)``, shape ``(*, 3)``."""
    x, y, _ = cloud.points.unbind(dim=1)
    return torch.stack([x[pixels], y[pixels], torch.ones_like(x[pixels])], dim=-1)
