"""Robust plane fits of regions, and their noise statistics."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrg._parallel import map_tasks
from torchrg.config import Auto, GrowingConfig
from torchrg.linalg.moments import Segments, eigh3_lapack
from torchrg.linalg.precision import coordinate_resolution
from torchrg.regions.edges import GrowingInput, neighborhood_radii
from torchrg.robust.scale import MAD_FACTOR

POINTS_AT_ONCE = 2**18
"""Points of regions that are fitted or measured together: about 400 bytes each."""
BISQUARE_CUT = 4.685
"""Residuals beyond this many standard deviations have weight 0: 95 % efficiency for normal data."""
_NUM_FITS = 4
"""Reweighted fits until the plane has converged."""
_FLAT_RATIO = 4.0
"""Minimum ratio of consecutive variances; below it noise determines their directions."""
_SAME_MAGNITUDE = 1e-6
"""Relative difference below which components of a normal count as equal (rounding)."""
_CURVED_SPREAD_DEG = 8.0
"""Minimum RMS angle of the normals of a curved region to their mean direction. A smooth bend by
three to four times this angle has this spread, a full column 45 degrees."""
MAX_FITTED = 4096
"""Maximum number of points for plane fits while regions change: more points move the plane by less
than a fiftieth of their noise."""
MIN_FITTED = 10
"""Minimum number of points of a plane that assigns boundary points: any three are coplanar."""
_BENT_FRACTION = 0.5
"""A region is bent if its thickness exceeds this fraction of the median reach of its points. Reach
is four residuals, so this is twice the noise."""
_FACET_THICKNESS = 2 / 3
"""Minimum thickness of mesh surfaces, in facet tolerances: points next to a surface are on facets
no closer to its plane than the points in it."""
_MAX_FACET_RMS = 1.5
"""Maximum RMS distance, in facet tolerances, of a planar faceted region with any normals."""
_MIN_HEIGHT = 0.2
"""An arc of width w whose normals spread by a is 0.45 a w thick, a spherical cap 0.41 a w. A region
thinner than 0.2 a w is a plane with noisy normals."""
_MAX_RMS, _MAX_RMS_OF_FEW = 0.2, 0.1
"""Maximum RMS distance of flat regions to their plane, as a fraction of their length: a cube has
0.29, clutter in rooms up to 0.19, a slab a third as thick as long 0.1. The second limit is for
clouds of fewer than two neighborhoods, whose normals are equal, whatever their shape."""
SQ_WIDTH = 12.0
"""Squared width of a uniformly covered strip, in units of the variance across it."""


class RegionPlanes(NamedTuple):
    """Planes of M regions with noise statistics, in float64.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``.
        center: A point of each plane, the weighted mean, shape ``(M, 3)``.
        covariance: Weighted covariance, shape ``(M, 3, 3)``.
        thickness: Robust standard deviation of the points from the plane, at least the floor, shape
            ``(M,)``, like all following attributes.
        rms: RMS distance of the points from the plane.
        num_points: Number of points, int64.
        curved: Whether the spread of the normals is too large for a plane, bool.
        floor: Minimum thickness.
        reach: Median distance within which the points accept neighbors as coplanar, infinite if
            unknown.
        bent: Whether noise does not explain the thickness, bool.
        radius: Median distance of the points to their last neighbor, 0 if unknown.
    """

    normal: Tensor
    center: Tensor
    covariance: Tensor
    thickness: Tensor
    rms: Tensor
    num_points: Tensor
    curved: Tensor
    floor: Tensor
    reach: Tensor
    bent: Tensor
    radius: Tensor

    @property
    def noise(self) -> Tensor:
        """The thickness if it is known to be noise, otherwise 0, shape ``(M,)``."""
        is_noise = self.reach.isfinite() & ~self.bent & ~self.curved
        return torch.where(is_noise, self.thickness, 0.0)

    def scale_thickness(self, factor: float) -> Tensor:
        """Return ``factor`` times the thickness ``(M,)``, NaN for curved regions."""
        return torch.where(self.curved, torch.nan, factor * self.thickness)

    def flattened(self, facet_tolerance: float | Auto | None) -> "RegionPlanes":
        """Return the planes with regions within 1.5 facet tolerances marked as not curved."""
        if facet_tolerance is None:
            return self
        limit = _MAX_FACET_RMS * float(facet_tolerance)
        return self._replace(curved=self.curved & (self.rms > limit))

    def signed_distances(self, points: Tensor, regions: Tensor) -> Tensor:
        """Return signed distances ``(*, n)`` of points ``(n, 3)`` to planes of regions ``(*, n)``.

        It is 0 for unlabeled points, whose regions are -1.
        """
        rows, total = (regions + 1).reshape(-1), torch.zeros_like(regions, dtype=self.center.dtype)
        table = pad(torch.stack([self.center.T, self.normal.T]), (1, 0))
        for column, *plane in zip(points.unbind(dim=1), *table.unbind(), strict=True):
            # By columns in a fourth of the time of vectors.
            start, slope = (values.index_select(0, rows).view(regions.shape) for values in plane)
            total += (column - start).mul_(slope)
        return total


def fit_planes(
    segments: Segments, points: Tensor, normals: Tensor, *, shared: bool = False
) -> RegionPlanes:
    """Fit planes by total least squares, iteratively reweighted with Tukey's bisquare [1].

    The weight of a point falls to 0 at 4.685 robust standard deviations of the residuals (1.4826
    times their median). Points of another surface thus do not tilt the plane. ``normals`` of any
    sign decide for degenerate regions: one or two points, or collinear points. For the sign see
    :func:`canonicalize_sign`. The floor is 0 because the noise is unknown. With ``shared``,
    ``normals`` are one per region, ``(M, 3)``, and no region is curved.

    References:
        [1] P. Huber, E. Ronchetti. Robust Statistics, 2nd edition. Wiley, 2009.
    """
    chunks = segments.chunks(POINTS_AT_ONCE)
    sizes = [len(chunk.counts) for chunk in chunks]
    chunk_normals = torch.split(normals, sizes) if shared else [None] * len(chunks)
    parts = map_tasks(
        lambda task: _fit_chunk(task[0], points, normals, task[1]),
        list(zip(chunks, chunk_normals, strict=True)),
        points.device,
    )
    if len(parts) == 1:
        return parts[0]
    return RegionPlanes(*(torch.cat(values) for values in zip(*parts, strict=True)))


def mean_normals(segments: Segments, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean normal of each region, up to sign, and its spread in degrees."""
    columns = segments.gather_columns(normals)
    _, squares = segments.moments(columns, torch.ones_like(columns[0]), centered=False)
    eigenvalues, directions = eigh3_lapack(squares)
    return directions[:, :, 2], (1 - eigenvalues[:, 2]).clamp(min=0, max=1).sqrt().asin().rad2deg()


def _fit_chunk(
    segments: Segments, points: Tensor, normals: Tensor, shared: Tensor | None
) -> RegionPlanes:
    """Fit planes to one chunk of regions; see :func:`fit_planes`."""
    if shared is None:
        mean_normal, spread = mean_normals(segments, normals)
    else:
        mean_normal, spread = shared.double(), torch.zeros_like(shared[:, 0])
    first = segments.first(points)
    origin, resolution = first.double(), coordinate_resolution(first).double()
    local = segments.gather_centered(points, origin)
    weights = torch.ones_like(local[0])
    for _ in range(_NUM_FITS):
        mean, covariance = segments.moments(local, weights)
        variances, axes = eigh3_lapack(covariance)
        normal = _plane_normals(variances, axes, mean_normal)
        factors = (MAD_FACTOR, BISQUARE_CUT)
        weights, median, squares = segments.reweigh(local, mean, normal, resolution, factors)
    thickness = MAD_FACTOR * median
    # The height of an arc is its angle times its width, which is at least the middle axis.
    height = _MIN_HEIGHT * spread.deg2rad() * variances[:, 1].clamp(min=0).sqrt()
    # An arc without width lies in its own plane, which does not show its thickness.
    crosses = (mean_normal * normal).sum(dim=1).abs() > math.sqrt(0.5)
    return RegionPlanes(
        canonicalize_sign(normal),
        origin + mean,
        covariance,
        thickness,
        rms=squares.sqrt(),
        num_points=segments.counts,
        curved=(spread > _CURVED_SPREAD_DEG) & ~(crosses & (thickness < height)),
        floor=torch.zeros_like(thickness),
        reach=torch.full_like(thickness, torch.inf),
        bent=torch.zeros_like(crosses),
        radius=torch.zeros_like(thickness),
    )


def fit_regions(cloud: GrowingInput, labels: Tensor, config: GrowingConfig) -> RegionPlanes:
    """Fit planes to the regions of a cloud in canonical order, using a sample of each.

    The floor of the thickness is a fraction of the median neighborhood radius, as in the
    coplanarity test. A region is curved if its normals are spread and noise alone does not explain
    its thickness. In surfaces a few centimeters wide, noise also spreads normals. ``labels``
    ``(N,)`` are 0 to M-1, each at least once, or negative.
    """
    segments = Segments(labels, max_points=MAX_FITTED)
    planes = fit_planes(segments, cloud.points, cloud.normals)
    radii = cloud.radii
    if radii is None:
        radii = neighborhood_radii(cloud.points, cloud.neighbors)
    radius = segments.median(segments.gather(radii)).double()
    floor = config.coplanarity_floor * radius
    facets = _FACET_THICKNESS * float(config.facet_tolerance or 0.0)
    planes = planes._replace(
        thickness=torch.maximum(planes.thickness, floor).clamp(min=facets),
        num_points=segments.sizes,
        floor=floor,
        radius=radius,
    )
    if config.faceted is True:
        planes = planes.flattened(config.facet_tolerance)
    if cloud.reach is None:
        return planes
    reach = segments.median(segments.gather(cloud.reach)).double()
    explained = torch.where(reach.isfinite(), torch.maximum(_BENT_FRACTION * reach, floor), floor)
    bent = planes.thickness > explained
    return planes._replace(curved=planes.curved & bent, reach=reach, bent=bent)


def find_solid_regions(cloud: GrowingInput, labels: Tensor) -> Tensor:
    """Return the mask of regions ``(M,)`` that fill a volume instead of a plane, bool.

    Curved regions are surfaces.
    """
    segments = Segments(labels, max_points=MAX_FITTED)
    local = segments.gather_centered(cloud.points, segments.first(cloud.points).double())
    variances = eigh3_lapack(segments.moments(local, torch.ones_like(local[0]))[1])[0]
    are_few = len(labels) < 2 * cloud.neighbors.indices.shape[1]
    limit = _MAX_RMS_OF_FEW if are_few else _MAX_RMS
    solid = variances[:, 0] > limit**2 * SQ_WIDTH * variances[:, 2]
    if bool(solid.any()):
        solid &= ~fit_planes(segments, cloud.points, cloud.normals).curved
    return solid


class RegionFits:
    """Cached region planes, refitted only when the labels change."""

    def __init__(self, cloud: GrowingInput, config: GrowingConfig) -> None:
        self._cloud, self._config = cloud, config
        self._cached: tuple[Tensor, RegionPlanes] | None = None

    def get(self, labels: Tensor) -> RegionPlanes:
        """Return the result of :func:`fit_regions`."""
        if self._cached is None or not torch.equal(self._cached[0], labels):
            self._cached = labels, fit_regions(self._cloud, labels, self._config)
        return self._cached[1]


def _plane_normals(variances: Tensor, axes: Tensor, mean_normal: Tensor) -> Tensor:
    """Return plane normals, using the mean normals where the points are degenerate."""
    low, middle, high = variances.unbind(dim=1)
    is_flat = middle > _FLAT_RATIO * low
    if bool(is_flat.all()):
        return axes[:, :, 0]
    along = axes[:, :, 2]
    is_line = high > _FLAT_RATIO * middle
    component = (mean_normal * along).sum(dim=1, keepdim=True) * along
    across = mean_normal - torch.where(is_line[:, None], component, 0.0)
    length = across.norm(dim=1, keepdim=True)
    across = torch.where(length > 0, across / length, axes[:, :, 0])
    return torch.where(is_flat[:, None], axes[:, :, 0], across)


def canonicalize_sign(normals: Tensor) -> Tensor:
    """Flip normals so that the component of largest magnitude (the last among ties) is positive."""
    magnitudes = normals.abs()
    near = magnitudes >= (1 - _SAME_MAGNITUDE) * magnitudes.amax(dim=1, keepdim=True)
    last = 2 - near.flip(1).to(torch.uint8).argmax(dim=1, keepdim=True)
    return torch.where(normals.gather(1, last) < 0, -normals, normals)
