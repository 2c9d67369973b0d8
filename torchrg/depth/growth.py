"""Region growing in depth images, with boundary assignment, merging and creases."""

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import map_tasks
from torchrg.config import DepthConfig
from torchrg.depth.faces import boundaries, hidden_contacts, join_strips
from torchrg.depth.passes import has_kernels
from torchrg.depth.pixels import InverseCloud
from torchrg.linalg.moments import Segments
from torchrg.regions.fit import BISQUARE_CUT, MAX_FITTED, RegionPlanes
from torchrg.regions.growth import rank_by_size
from torchrg.regions.repair import assign_unlabeled, merge_coplanar
from torchrg.robust.scale import MAD_FACTOR

_FORWARD_STEPS = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Row and column steps to the adjacent pixels that come later."""
_ALL_STEPS = (*_FORWARD_STEPS, *((-down, -right) for down, right in _FORWARD_STEPS))
_NUM_PASSES = 2
"""Passes of boundary assignment and merging: assigned pixels may make regions adjacent."""
_ASSIGN_REACH = 3.0
"""Maximum distance of a pixel to the plane of the adjacent flat region, in standard deviations of
the noise: 99.7 % of its pixels are within."""
_MERGE_TOLERANCE = 1.2
"""Maximum ratio of the RMS distances to the joint plane and to the own plane of two merged flat
regions, as for clouds; see :class:`torchrg.config.GrowingConfig`."""
_MAX_NOISE = 3.0
"""Maximum thickness of a planar region in units of the noise, regardless of its bend."""
_MAX_BEND = 0.03
"""Maximum thickness of a planar region as a fraction of its extent, regardless of the noise. A
slightly bent surface is one plane; a column is 0.4 of its extent thick."""
_NUM_FITS = 2
"""Fits of a region's plane, a plain and a reweighted one: its pixels are already near the plane."""
_MIN_SPREAD = 1e-12
"""Minimum determinant of the covariance of a region's pixels, as a fraction of its squared trace.
Below it they are on a line up to rounding, and have 1e-7 if one of a thousand is off it."""
_MAX_MOVES = 16
"""Maximum displacement of a boundary, in pixels: windows hardly reach farther from their center."""
_MIN_COSINE = 0.85
"""Minimum cosine of the angle between a step perpendicular to a crease and one that counts."""


def grow_pixels(
    cloud: InverseCloud, flat: Tensor, joins: tuple[Tensor, Tensor], config: DepthConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Grow regions over a depth image, assign boundary pixels, and merge coplanar regions.

    Regions are the connected components of the flat pixels, connected by the ``joins`` to the right
    and down from :class:`torchrg.depth.pixels.Pixels`.

    Returns:
        Labels ``(H * W,)``, 0 to M-1 by descending size or :data:`torchrg.UNLABELED`; unit normals
        of the regions' planes towards the camera, in space, ``(M, 3)``; and a mask of regions
        thicker than noise and a slight bend explain, ``(M,)``, bool.
    """
    labels = rank_by_size(connect_pixels(flat, *joins), config.min_size)
    if not bool((labels >= 0).any()):
        return labels, cloud.values.new_empty(0, 3), flat.new_empty(0)
    labels, fit = _refine(cloud, labels, config)
    return labels, _normals_in_space(fit), fit.curved


def _normals_in_space(fit: RegionPlanes) -> Tensor:
    """Return unit normals towards the camera ``(M, 3)`` of the planes of an inverse cloud."""
    distance = (fit.normal * fit.center).sum(dim=1)
    away = torch.stack([-fit.normal[:, 0], -fit.normal[:, 1], distance], dim=1)
    normals: Tensor = -away / away.norm(dim=1, keepdim=True)
    return normals


def connect_pixels(flat: Tensor, right: Tensor, down: Tensor) -> Tensor:
    """Return the connected components of an image ``(H * W,)``, -1 where it is not flat."""
    if has_kernels(flat):
        return kernels.call("connect_pixels", flat, right, down)[0].flatten()
    from scipy.ndimage import label

    height, width = flat.shape
    grid = np.zeros((2 * height - 1, 2 * width - 1), dtype=bool)
    grid[::2, ::2], grid[1::2, ::2], grid[::2, 1::2] = (
        flags.cpu().numpy() for flags in (flat, down[:-1], right[:, :-1])
    )
    parts = label(grid)[0][::2, ::2].astype(np.int64)
    return torch.from_numpy(parts.ravel() - 1).to(flat.device)


class PixelGrid:
    """8-connected pixel grid."""

    def __init__(self, shape: torch.Size) -> None:
        self.height, self.width = shape

    def neighbor_rows(self, rows: Tensor) -> Tensor:
        """Return the neighbors of pixels ``(n, 8)``, clamped to the image."""
        down, right = torch.tensor(_ALL_STEPS, device=rows.device).T
        row = (rows[:, None] // self.width + down).clamp(0, self.height - 1)
        column = (rows[:, None] % self.width + right).clamp(0, self.width - 1)
        near_rows: Tensor = row * self.width + column
        return near_rows

    def contacts(self, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pairs of adjacent regions, and the number of contacts of each pair."""
        num_regions, image = int(labels.max()) + 1, labels.view(self.height, self.width)
        # A table of all pairs has at most one entry per pixel.
        if has_kernels(labels) and num_regions**2 <= len(labels):
            table = labels.new_empty(num_regions, num_regions)
            kernels.call("count_contacts", image, table)
            pairs = table.nonzero()
            return pairs, 2 * table[pairs[:, 0], pairs[:, 1]]
        ends = torch.stack([labels[pixels] for pixels in boundaries(image, _FORWARD_STEPS)])
        first, second = ends.sort(dim=0).values
        keys = (first * num_regions + second)[first >= 0]
        keys, counts = torch.unique(keys, return_counts=True)
        # Contacts are symmetric.
        return torch.stack([keys // num_regions, keys % num_regions], dim=1), 2 * counts


def _refine(
    cloud: InverseCloud, labels: Tensor, config: DepthConfig
) -> tuple[Tensor, RegionPlanes]:
    """Refine the regions of a depth image: boundary assignment, merging, strips, and creases.

    Twice, unlabeled pixels join the adjacent region whose plane they are on, and adjacent coplanar
    flat regions are merged. Then boundaries move to the intersection lines of the planes. Returns
    labels by descending size, and the planes of the regions.
    """
    grid = PixelGrid(cloud.seen.shape)
    for _ in range(_NUM_PASSES):
        planes = fit_inverse_planes(cloud, labels)
        reach = planes.scale_thickness(_ASSIGN_REACH)
        labels = assign_unlabeled_pixels(cloud, labels, planes, reach)
        hidden = hidden_contacts(cloud, labels, planes, reach)
        pairs = zip(grid.contacts(labels), hidden, strict=True)
        contacts, counts = (torch.cat(ends) for ends in pairs)
        merged = merge_coplanar(labels, (contacts, counts), planes, tolerance=_MERGE_TOLERANCE)
        labels = rank_by_size(merged, config.min_size)
    planes = fit_inverse_planes(cloud, labels)
    tables = _ray_planes(planes), _normals_in_space(planes), planes.num_points
    joined = join_strips(cloud, labels, *tables)
    if joined is not labels:
        labels = rank_by_size(joined, config.min_size)
        planes = fit_inverse_planes(cloud, labels)
    reach = planes.scale_thickness(_ASSIGN_REACH)
    moved = move_to_creases(cloud, labels, planes, reach)
    labels = rank_by_size(moved, config.min_size)
    return labels, fit_inverse_planes(cloud, labels)


def assign_unlabeled_pixels(
    cloud: InverseCloud, labels: Tensor, planes: RegionPlanes, reach: Tensor
) -> Tensor:
    """Apply :func:`torchrg.regions.repair.assign_unlabeled` to the pixels of an image."""
    seen = cloud.seen
    if not has_kernels(cloud.values):
        cloud_of_pixels = cloud.points, labels, PixelGrid(seen.shape).neighbor_rows
        return assign_unlabeled(*cloud_of_pixels, planes, reach, valid=seen.flatten())
    image = labels.view(seen.shape).clone()
    tables = planes.normal, planes.center, reach
    kernels.call("assign_unlabeled_pixels", *cloud[:3], seen, image, *tables)
    return image.flatten()


def _ray_planes(fit: RegionPlanes) -> Tensor:
    """Return planes ``(M, 3)`` whose product with a ray ``(x, y, 1)`` is the last coordinate."""
    offset = (fit.normal * fit.center).sum(dim=1, keepdim=True)
    return torch.cat([-fit.normal[:, :2], offset], dim=1) / fit.normal[:, 2:]


def fit_inverse_planes(cloud: InverseCloud, labels: Tensor) -> RegionPlanes:
    """Fit planes to regions by least squares along the last coordinate, the only noisy one.

    A second fit uses Tukey's bisquare weights, as in :func:`torchrg.regions.fit.fit_planes`. The
    thickness, along the normals, is at least the mean noise of the region. Regions thicker than
    noise and a slight bend explain are curved. Each fit uses up to 4096 evenly spaced pixels
    per region.
    """
    chunks = Segments(labels, max_points=MAX_FITTED).chunks(len(labels) + 1)
    parts = map_tasks(lambda chunk: _fit_chunk(cloud, chunk), chunks, labels.device)
    return RegionPlanes(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _fit_chunk(cloud: InverseCloud, segments: Segments) -> RegionPlanes:
    """Fit planes to one chunk of regions; see :func:`fit_inverse_planes`."""
    fits = _NUM_FITS, MAD_FACTOR, BISQUARE_CUT
    if segments.are_served(cloud.values):
        rows = segments.rows, segments.counts
        _, *measured = kernels.call("fit_pixel_regions", *cloud[:4], *rows, *fits, _MIN_SPREAD)
        center, covariance, normal, noise, median, squares = measured
    else:
        noise = segments.mean(segments.gather(cloud.noise.flatten()))
        columns = segments.gather_columns(cloud.points)
        weights = torch.ones_like(columns[0])
        for _ in range(_NUM_FITS):
            center, covariance = segments.moments(columns, weights)
            normal = _fit_slopes(covariance)
            weights, median, squares = segments.reweigh(columns, center, normal, noise, fits[1:])
    thickness = MAD_FACTOR * median
    length = normal.norm(dim=1, keepdim=True)
    # For a plane at distance d from the camera, w is the cosine along a ray over d.
    offset = (normal * center).sum(dim=1, keepdim=True)
    nearness = torch.cat([normal[:, :2], offset], dim=1).norm(dim=1)
    extent = torch.linalg.eigvalsh(covariance[:, :2, :2])[:, 0].clamp(min=0).sqrt()
    return RegionPlanes(
        normal / length,
        center,
        covariance,
        torch.maximum(thickness / length.squeeze(1), noise),
        rms=squares.sqrt() / length.squeeze(1),
        num_points=segments.sizes,
        curved=thickness > torch.maximum(_MAX_NOISE * noise, _MAX_BEND * extent * nearness),
        floor=noise,
        reach=torch.full_like(noise, torch.inf),
        bent=torch.zeros_like(noise, dtype=torch.bool),
        radius=torch.zeros_like(noise),
    )


def _fit_slopes(covariance: Tensor) -> Tensor:
    """Return normals ``(-u, -v, 1)`` of least squares ``(M, 3)``; the flattest along a line."""
    a, b, c, p, q = covariance[:, [0, 0, 1, 0, 1], [0, 1, 1, 2, 2]].unbind(dim=1)
    determinant, square = a * c - b * b, (a + c) * (a + c)
    is_full = determinant > _MIN_SPREAD * square
    # The pseudoinverse of a matrix of rank one is the matrix over its squared trace.
    a, b, c = torch.where(is_full, torch.stack([c, -b, a]), torch.stack([a, b, c]))
    divisor = torch.where(is_full, determinant, torch.where(square > 0, square, 1.0))
    slopes = [-((a * p + b * q) / divisor), -((b * p + c * q) / divisor), torch.ones_like(p)]
    return torch.stack(slopes, dim=1)


def move_to_creases(
    cloud: InverseCloud, labels: Tensor, fit: RegionPlanes, reach: Tensor
) -> Tensor:
    """Move boundaries between flat regions to the intersection lines of their planes.

    Within the noise of a crease a pixel lies on both planes, and its region is arbitrary. Two
    regions form a crease if their centers are on opposite sides of the intersection line, each off
    the other's plane. A pixel on the other side then joins the other region if it is on its plane.
    It must be next to a pixel of that region straight behind it, as seen from the crease.
    Boundaries thus move towards the crease, never along it. Their neighbors are revisited.

    ``reach`` is the maximum distance of a point on the plane along the last coordinate, ``(M,)``.
    """
    planes, middles = _ray_planes(fit), fit.center[:, :2]
    labels = labels.clone()
    if has_kernels(cloud.values):
        image = labels.view(cloud.seen.shape)
        tables, limits = (planes, middles, reach), (_MAX_MOVES, _MIN_COSINE)
        kernels.call("move_to_creases", *cloud[:3], image, *tables, *limits)
        return labels
    grid = PixelGrid(cloud.seen.shape)
    rows = torch.unique(torch.cat(boundaries(labels.view(cloud.seen.shape), _FORWARD_STEPS)))
    for _ in range(_MAX_MOVES):
        rows = rows[labels[rows] >= 0]
        near_rows = grid.neighbor_rows(rows)
        regions = _crease_regions(cloud, labels, planes, middles, reach, rows, near_rows)
        moved = regions != labels[rows]
        if not bool(moved.any()):
            break
        labels[rows[moved]] = regions[moved]
        rows = torch.unique(torch.cat([rows[moved], near_rows[moved].flatten()]))
    return labels


def _crease_regions(
    cloud: InverseCloud,
    labels: Tensor,
    planes: Tensor,
    middles: Tensor,
    reach: Tensor,
    rows: Tensor,
    near_rows: Tensor,
) -> Tensor:
    """Return the region ``(n,)`` of pixels according to the adjacent creases."""
    x, y, inverse = cloud.points.unbind(dim=1)
    label, near = labels[rows][:, None], labels[near_rows]
    other, near = (near >= 0) & (near != label), near.clamp(min=0)
    ray, near_rays = (x[rows][:, None], y[rows][:, None]), (x[near_rows], y[near_rows])
    gap = planes[label] - planes[near]
    a, b, _ = gap.unbind(dim=2)
    here, there = _evaluate(gap, *ray), _evaluate(gap, *near_rays)
    side, other_side = (_evaluate(gap, *middles[which].unbind(dim=2)) for which in (label, near))
    slope = (a.square() + b.square()).sqrt()
    step = ((near_rays[0] - ray[0]).square() + (near_rays[1] - ray[1]).square()).sqrt()
    straight = there.abs() - here.abs() >= _MIN_COSINE * slope * step
    away = (inverse[rows][:, None] - _evaluate(planes[near], *ray)).abs()
    moves = other & straight & (here * side < 0) & (side * other_side < 0) & (away <= reach[near])
    moves = moves & (side.abs() > reach[near]) & (other_side.abs() > reach[label])
    away = torch.where(moves, away, torch.inf)
    minimum = away.amin(dim=1, keepdim=True)
    nearest = torch.where(moves & (away == minimum), near, len(planes)).amin(dim=1)
    return torch.where(nearest < len(planes), nearest, label.squeeze(1))


def _evaluate(planes: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the last coordinates ``(*)`` of planes ``(*, 3)`` at rays ``(x, y, 1)``."""
    a, b, c = planes.unbind(dim=-1)
    return a * x + b * y + c
