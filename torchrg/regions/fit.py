"""Planes of regions: robust fits, and what is known of the noise of their points."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, chunks_of, map_tasks
from torchrg.config import Auto, GrowingConfig
from torchrg.linalg import coordinate_resolution, eigh3_of_few
from torchrg.linalg.moments import Segments
from torchrg.regions.edges import GrowingCloud, neighborhood_radii
from torchrg.robust.scale import MAD_FACTOR

POINTS_AT_ONCE = 2**18
"""Points of regions that are fitted or measured together: at some 400 bytes each."""

BISQUARE_CUT = 4.685
"""Residuals of this many standard deviations have weight 0: 95 % efficiency for normal data."""

_NUM_FITS = 4
"""After so many reweighted fits the plane no longer moves."""

_FLAT_RATIO = 4.0
"""Where one variance is not this many times the next smaller one, rounding and noise decide between
their directions."""

_SAME_MAGNITUDE = 1e-6
"""Components of a normal that differ by less than this share are equal but for rounding."""

_CURVED_SPREAD_DEG = 8.0
"""Root mean square angle of a region's normals to the direction they share, from which on it is
curved: a smooth bend by three to four times this angle has this spread, a full column 45."""

MAX_FITTED = 4096
"""Points of a region that its plane is fitted to while regions change: more of them move it by less
than a fiftieth of their noise."""

MIN_FITTED = 10
"""Points whose plane says where others at its border belong: that of three passes through them."""

_BENT = 0.5
"""A region is bent if its thickness is over half the median reach of its points. Reach is four
residuals, so this is twice the noise."""

_FACET_THICKNESS = 2 / 3
"""Least thickness of the faces of a mesh, in facet tolerances: points beside a face are on facets
no closer to its plane than those in it."""

_MAX_FACET_RMS = 1.5
"""Facet tolerances, root mean square, within which the points of a faceted region are on one plane,
however much their normals are spread."""

_MIN_HEIGHT = 0.2
"""An arc of width w whose normals spread by a is 0.45 a w thick, a spherical cap 0.41 a w. What is
thinner than 0.2 a w is a plane with noisy normals."""


_SQ_WIDTH = 12.0
"""Square of the width of a strip that points cover evenly, in units of their variance across it."""


class RegionPlanes(NamedTuple):
    """Planes of M regions, and what is known of their noise, in float64.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``.
        center: A point of each plane, the weighted mean, shape ``(M, 3)``.
        covariance: Weighted covariance, shape ``(M, 3, 3)``.
        thickness: Robust standard deviation of the points from the plane, at least the floor, shape
            ``(M,)``, as all that follow.
        rms: Root mean square distance of the points from the plane. num_points: Number of points,
        int64. curved: Whether the points' normals are spread too much for a plane, bool. floor:
        Least thickness that counts. reach: Median distance within which the points take others for
        coplanar, infinite if unknown. bent: Whether noise does not explain the thickness, bool.
        radius: Median distance of the points to the last of their neighbours, 0 without any.
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
    def strips(self) -> Tensor:
        """Whether a flat region is narrower than its neighbourhoods reach, shape ``(M,)``, bool."""
        width = (_SQ_WIDTH * eigh3_of_few(self.covariance)[0][:, 1].clamp(min=0)).sqrt()
        return ~self.curved & (width <= self.radius)

    @property
    def noise(self) -> Tensor:
        """The thickness where it is known to be noise, shape ``(M,)``, else 0."""
        is_noise = self.reach.isfinite() & ~self.bent & ~self.curved
        return torch.where(is_noise, self.thickness, 0.0)

    def times_thickness(self, factor: float) -> Tensor:
        """Return a distance from each plane ``(M,)``: NaN, no distance at all, if it is curved."""
        return torch.where(self.curved, torch.nan, factor * self.thickness)

    def flattened(self, facet_tolerance: float | Auto | None) -> "RegionPlanes":
        """Return the planes with no region curved whose points lie within 1.5 facet tolerances."""
        if facet_tolerance is None:
            return self
        limit = _MAX_FACET_RMS * float(facet_tolerance)
        return self._replace(curved=self.curved & (self.rms > limit))

    def distances(self, points: Tensor, regions: Tensor) -> Tensor:
        """Return the distance of each point ``(n, 3)`` from the plane of a region ``(n,)``."""
        away = points.new_zeros(len(points), dtype=torch.float64)
        columns = [values.unbind(dim=1) for values in (points, self.center, self.normal)]
        for chunk in chunks_of(len(points), ROWS_AT_ONCE):
            owner = regions[chunk]
            for place, center, normal in zip(*columns, strict=True):
                away[chunk] += (place[chunk].double() - center[owner]) * normal[owner]
        return away.abs_()

    def signed_distances(self, points: Tensor, regions: Tensor) -> Tensor:
        """Return distances of points ``(n, 3)`` from planes of regions ``(n, C)``, with signs."""
        away = points.double()[:, None] - self.center[regions]
        return (away * self.normal[regions]).sum(dim=2)


def fit_planes(
    segments: Segments, points: Tensor, normals: Tensor, *, shared: bool = False
) -> RegionPlanes:
    """Fit planes by total least squares, iteratively reweighted with Tukey's bisquare [1].

    The weight of a point falls to 0 at 4.685 times the robust standard deviation of the residuals
    (1.4826 times their median), so that points of another surface do not tilt the plane.
    ``normals`` of any sign decide where points do not, in regions of one or two points or along a
    line; the sign is that of :func:`with_table_sign`. Nothing is known of the noise: the floor is
    0. Where points of a region have ``shared`` normals these are ``(M, 3)``, and no region is
    curved.

    References:
        [1] P. Huber, E. Ronchetti. Robust Statistics, 2nd edition. Wiley, 2009.
    """
    chunks = segments.chunks(POINTS_AT_ONCE)
    sizes = [len(chunk.counts) for chunk in chunks]
    own = torch.split(normals, sizes) if shared else [None] * len(chunks)
    parts = map_tasks(
        lambda task: _fit_together(task[0], points, normals, task[1]),
        list(zip(chunks, own, strict=True)),
        points.device,
    )
    return RegionPlanes(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _shared_normals(segments: Segments, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normal that points share, signs aside, and the spread of theirs, in degrees."""
    columns = segments.take_about(normals, normals.new_zeros(len(segments.counts), 3).double())
    _, squares = segments.moments(columns, torch.ones_like(columns[0]), centered=False)
    eigenvalues, directions = eigh3_of_few(squares)
    return directions[:, :, 2], (1 - eigenvalues[:, 2]).clamp(min=0, max=1).sqrt().asin().rad2deg()


def _fit_together(
    segments: Segments, points: Tensor, normals: Tensor, shared: Tensor | None
) -> RegionPlanes:
    """Fit planes to regions that are held in memory together; see :func:`fit_planes`."""
    if shared is None:
        usual, spread = _shared_normals(segments, normals)
    else:
        usual, spread = shared.double(), torch.zeros_like(shared[:, 0])
    origin = segments.first(points).double()
    local = segments.take_about(points, origin)
    weights = torch.ones_like(local[0])
    resolution = coordinate_resolution(segments.first(points)).double()
    for _ in range(_NUM_FITS):
        mean, covariance = segments.moments(local, weights)
        variances, axes = eigh3_of_few(covariance)
        normal = with_table_sign(_plane_normals(variances, axes, usual))
        factors = (MAD_FACTOR, BISQUARE_CUT)
        weights, median, squares = segments.reweigh(local, mean, normal, resolution, factors)
    thickness = MAD_FACTOR * median
    # The angle times the width across the bend, which is at least the middle one, is its height.
    height = _MIN_HEIGHT * spread.deg2rad() * variances[:, 1].clamp(min=0).sqrt()
    # Of an arc without width the plane is its own, and says nothing of its thickness.
    crosses = (usual * normal).sum(dim=1).abs() > math.sqrt(0.5)
    return RegionPlanes(
        normal,
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


def fit_regions(cloud: GrowingCloud, labels: Tensor, config: GrowingConfig) -> RegionPlanes:
    """Return the planes of the regions of a cloud in canonical order, of some points of each.

    The floor of the thickness is a fraction of the median neighbourhood's radius, as in the test of
    coplanarity. Curved are regions whose normals are spread and that noise alone does not make so
    thick: in faces a few centimetres wide, noise spreads normals, too. ``labels`` ``(N,)`` are 0 to
    M-1, each at least once, or negative.
    """
    segments = Segments(labels, most=MAX_FITTED)
    planes = fit_planes(segments, cloud.points, cloud.normals)
    radii = map_tasks(
        lambda rows: neighborhood_radii(cloud.points, cloud.neighbors.at(rows)),
        torch.split(segments.rows, ROWS_IN_CACHE),
        labels.device,
    )
    radius = segments.median(torch.cat(radii)).double()
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
    reach = segments.median(segments.take(cloud.reach)).double()
    explained = torch.where(reach.isfinite(), torch.maximum(_BENT * reach, floor), floor)
    bent = planes.thickness > explained
    return planes._replace(curved=planes.curved & bent, reach=reach, bent=bent)


class RegionFits:
    """The planes of the regions of a cloud, fitted again only when the labels have changed."""

    def __init__(self, cloud: GrowingCloud, config: GrowingConfig) -> None:
        self._cloud, self._config = cloud, config
        self._known: tuple[Tensor, RegionPlanes] | None = None

    def of(self, labels: Tensor) -> RegionPlanes:
        """Return what :func:`fit_regions` does."""
        if self._known is None or not torch.equal(self._known[0], labels):
            self._known = labels, fit_regions(self._cloud, labels, self._config)
        return self._known[1]


def _plane_normals(variances: Tensor, axes: Tensor, usual: Tensor) -> Tensor:
    """Return the normals of planes, from the points' own normals where the points give none."""
    low, middle, high = variances.unbind(dim=1)
    along = axes[:, :, 2]
    is_line = high > _FLAT_RATIO * middle
    component = (usual * along).sum(dim=1, keepdim=True) * along
    across = usual - torch.where(is_line[:, None], component, 0.0)
    length = across.norm(dim=1, keepdim=True)
    across = torch.where(length > 0, across / length, axes[:, :, 0])
    is_flat = middle > _FLAT_RATIO * low
    return torch.where(is_flat[:, None], axes[:, :, 0], across)


def with_table_sign(normals: Tensor) -> Tensor:
    """Return normals whose component of largest magnitude, of equal ones the last, is positive."""
    magnitudes = normals.abs()
    near = magnitudes >= (1 - _SAME_MAGNITUDE) * magnitudes.amax(dim=1, keepdim=True)
    last = 2 - near.flip(1).to(torch.uint8).argmax(dim=1, keepdim=True)
    return torch.where(normals.gather(1, last) < 0, -normals, normals)
