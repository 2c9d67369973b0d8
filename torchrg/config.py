"""All settings with their defaults and meaning.

Files and flags hold only differences.
"""

import dataclasses
import itertools
import math
import numbers
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar

import torch

from torchrg._parallel import CHUNK_SIZE
from torchrg.errors import ConfigError, shown, warn
from torchrg.structures import FARTHEST, PLANE_KINDS, PlaneKind, Sampling

__all__ = [
    "DEFAULT_PRESET",
    "AnyConfig",
    "Auto",
    "DepthConfig",
    "GrowingConfig",
    "NormalMethod",
    "NormalsConfig",
    "PipelineConfig",
    "PlanesConfig",
    "SelectionConfig",
    "SuperpointsConfig",
    "Up",
    "load_config",
    "preset_names",
]
__dir__ = __all__.copy

Settings = TypeVar("Settings")
NormalMethod = Literal[
    "pca", "jet", "irls", "fastmcd", "mve", "detmcd", "detmm", "paper", "consensus"
]
DEFAULT_PRESET = "consensus"
Auto = Literal["auto"]
"""Value of a setting that is determined from the data; see :meth:`PipelineConfig.with_sampling`."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""Up axis of the coordinates."""
SHORT_FLAG = {"is_short": True}
"""Metadata of a setting that is an option of commands, without the name of its section."""


@dataclass(frozen=True)
class NormalsConfig:
    """Normals and curvature. The defaults are the preset consensus."""

    method: NormalMethod = "consensus"
    """Normal estimator. pca to detmm fit every point once; paper and consensus run PCA first and
    refit sharp points."""
    k: int = 50
    """Number of nearest neighbors, including the point itself. Higher values suppress noise, lower
    values preserve narrow surfaces. Smaller clouds use all points."""
    sharp_rule: Literal["qn", "percentile"] = "qn"
    """Test for sharp points, on the angles to the normals of the neighbors: their Qn scale (qn, eq.
    9) or their 25th percentile (percentile, Algorithm 1)."""
    sharp_angle_deg: float = 5.0
    """Angle above which a point counts as sharp, in degrees; theta in the paper. angle_deg of a
    configuration sets it together with growing.max_angle_deg."""
    support_fraction: float = 0.5
    """Fraction of neighbors used by MCD, in [0.5, 1]. 0.5 tolerates most outliers; LIBRA's DetMCD
    uses 0.75."""
    mcd_scaling: Literal["consistency", "quantile"] = "consistency"
    """Factor applied to DetMCD's raw scatter: consistency at the normal distribution, or matching
    the h-th smallest squared distance to its chi-square quantile h / k (quantile, as in LIBRA)."""
    mcd_inliers: Literal["raw", "reweighted"] = "raw"
    """Fit whose distances define DetMCD outliers; LIBRA uses reweighted."""
    inlier_quantile: float = 0.975
    """Chi-square quantile of the squared distance below which a neighbor counts as an inlier of a
    robust fit."""
    irls_decay: float = 1.05
    """Factor, above 1, by which irls shrinks its scale in each step. The authors use 1.01, which
    takes five times as long as 1.05."""
    adaptive_k: int | None = None
    """Maximum number of neighbors consensus may use where noise makes k too few. None: always k."""
    noise_scope: Literal["auto", "local", "regional"] = "auto"
    """Noise level used by consensus: at the point (local), or at most that of the surrounding
    region of four neighborhoods (regional). Regional is for noisy mesh vertices, where a step
    between parallel surfaces is rounded into a ramp that looks like noise. auto: measured."""

    def __post_init__(self) -> None:
        check_values(self)
        expect(self, "k", ">= 3", self.k >= 3)
        limit = self.adaptive_k
        expect(self, "adaptive_k", ">= k or none", limit is None or limit >= self.k)
        expect(self, "sharp_angle_deg", "in [0, 90]", 0 <= self.sharp_angle_deg <= 90)
        expect(self, "support_fraction", "in [0.5, 1]", 0.5 <= self.support_fraction <= 1)
        expect(self, "inlier_quantile", "in (0, 1)", 0 < self.inlier_quantile < 1)
        expect(self, "irls_decay", "> 1", self.irls_decay > 1)

    def with_sampling(self, sampling: Sampling) -> "NormalsConfig":
        """Resolve ``auto`` values; see :meth:`PipelineConfig.with_sampling`."""
        if self.noise_scope != "auto":
            return self
        is_regional = _is_noisy_grid(sampling)
        return dataclasses.replace(self, noise_scope="regional" if is_regional else "local")


@dataclass(frozen=True)
class GrowingConfig:
    """Region growing. The defaults are the preset consensus.

    ``load_config("paper").growing`` has the paper's settings; change values with
    ``dataclasses.replace``.
    """

    max_angle_deg: float = 6.5
    """Maximum angle between the normals of a point and a neighbor that joins its region, in
    degrees; theta in the paper. Higher values merge more."""
    curvature_quantile: float = 0.95
    """Curvature quantile below which points can be seeds."""
    curvature_scope: Literal["cloud", "neighborhood"] = "cloud"
    """Points that quantile is computed over: all valid points (cloud, Algorithm 2) or the neighbors
    of the seed (neighborhood, "of the k-NN" in section II.B)."""
    seed_rule: Literal["curvature", "increment"] = "curvature"
    """Condition for a new point to become a seed: its curvature (curvature, as in PCL), or its
    curvature increment from the point it joined (increment, as in the paper), is within the
    limit."""
    connectivity: float | None = None
    """Minimum fraction of shared k-nearest neighbors for two points to count as connected. None
    disables the test."""
    connectivity_scope: Literal["region", "seed"] = "seed"
    """Effect if the connectivity test fails: the point does not join the region (region, Algorithm
    2 as printed), or joins but is no seed until a connected seed of its region reaches it (seed,
    the paper's text)."""
    coplanarity: bool = True
    """Require the distance to the seed's plane to be at most median + 2 Qn of the distances in the
    neighborhood (eq. 11)."""
    coplanarity_scope: Literal["all", "connected"] = "all"
    """Neighbors used for that median and Qn: all, or connected ones (Algorithm 2)."""
    coplanarity_floor: float = 0.005
    """Lower bound of Qn in the coplanarity test, as a fraction of the distance to the farthest
    neighbor. On exact and quantized surfaces most residuals are equal, so Qn is 0."""
    plane_reach: float | None = 4.0
    """Join two points only if each lies within this many residuals of the other's plane, so the two
    sides of a thin panel stay separate. Replaces eq. 11 except for exact fits (residual below
    coplanarity_floor). Needs normals with residuals. None disables the test."""
    max_distance: float | None = None
    """Maximum distance to a neighbor that joins, in units of the cloud. Prevents jumps across gaps
    in sparse areas. None disables the test."""
    min_size: int | Auto = "auto"
    """Minimum number of points per plane; smaller regions stay unlabeled. Duplicate points count
    once; with absorb, boundary points count. auto: the number of points in a square with sides 1/27
    of the cloud height (10 cm in a room), clamped to 20-50; more for points sampled from a mesh."""
    cut_bridges: bool = True
    """Split regions whose parts are joined by only a few points, such as surfaces 12 degrees apart,
    or a floor and the furniture on it. Adds about 5 % to the runtime of consensus."""
    facet_tolerance: float | Auto | None = "auto"
    """Merge adjacent regions within this RMS distance of a common plane, in units of the cloud; for
    mesh facets and warped reconstructions. auto: 1/240 of the cloud height (11 mm in a room) if
    deviations grow with scale, 2.5 times that in warped scans without a mesh, less than half of it
    (5 mm) if the noise is white, at least the rounding step of quantized coordinates. None disables
    merging."""
    faceted: bool | Auto = "auto"
    """Whether flat surfaces deviate from planes by shape (mesh facets, warped reconstructions)
    rather than by noise. If true, points instead of normals decide whether a region is flat;
    requires facet_tolerance. auto: measured; also true for the vertices of noisy meshes."""
    max_plane_residual: float | None = None
    """After growth, unlabel points farther from their plane than this many times the thickness of
    the region. None disables the test."""
    absorb: bool = True
    """Assign unlabeled points (and regions below min_size) to an adjacent flat region on whose
    plane they lie."""
    absorb_reach: float = 3.0
    """Maximum distance between an absorbed point and the plane of its region, in thicknesses of the
    region."""
    absorb_angle_deg: float = 45.0
    """Maximum angle between the normals of an absorbed point and the plane, in degrees."""
    refine_borders: bool = True
    """Reassign boundary points to the region that explains them best, using the line of
    intersection of two planes. Needs absorb; matters most for surfaces a few centimeters wide."""
    merge_coplanar: bool = True
    """Merge adjacent coplanar regions, and regions within the noise of a larger one (from the
    residuals of the normals)."""
    merge_tolerance: float = 1.2
    """Maximum thickness of a region about the merged plane, in multiples of its thickness about its
    own plane. Used by merge_coplanar."""

    def __post_init__(self) -> None:
        check_values(self)
        expect(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        expect(self, "curvature_quantile", "in [0, 1]", 0 <= self.curvature_quantile <= 1)
        within = self.connectivity is None or 0 <= self.connectivity <= 1
        expect(self, "connectivity", "in [0, 1] or none", within)
        expect(self, "coplanarity_floor", ">= 0", self.coplanarity_floor >= 0)
        for name in ("max_distance", "plane_reach"):
            value = getattr(self, name)
            expect(self, name, ">= 0 or none", value is None or value >= 0)
        facets = self.facet_tolerance
        is_open = facets is None or facets == "auto"
        expect(self, "facet_tolerance", "> 0, auto or none", is_open or float(facets or 0) > 0)
        size = self.min_size
        expect(self, "min_size", ">= 1 or auto", size == "auto" or int(size) >= 1)
        residual = self.max_plane_residual
        expect(self, "max_plane_residual", "> 0 or none", residual is None or residual > 0)
        expect(self, "absorb_reach", ">= 0", self.absorb_reach >= 0)
        expect(self, "absorb_angle_deg", "in [0, 90]", 0 <= self.absorb_angle_deg <= 90)
        expect(self, "merge_tolerance", ">= 1", self.merge_tolerance >= 1)

    def with_sampling(self, sampling: Sampling) -> "GrowingConfig":
        """Resolve ``auto`` values; see :meth:`PipelineConfig.with_sampling`."""
        count, tolerance, is_stepped = self.min_size, self.facet_tolerance, False
        if count == "auto":
            side, (low, high) = _MIN_SIDE_FRACTION, _MIN_SIZES
            drawn = _shape_fraction(sampling) * _ramp(sampling.exactness, *_EXACTNESS)
            side += drawn * (_MIN_FACET_SIDE_FRACTION - side)
            high += round(drawn * (_MAX_FACET_MIN_SIZE - high))
            size = round(sampling.density * (side * sampling.height) ** 2)
            count = min(max(size, low), high)
        if tolerance == "auto":
            reach = _reach(sampling)
            limit = min(_FACET_HEIGHT_FRACTION * sampling.height, _FACET_RADIUS_FRACTION * reach)
            fraction = max(_shape_fraction(sampling), _WHITE_FRACTION)
            fraction += _WARP_FRACTION * _warp_fraction(sampling)
            step = min(_rounding_step(sampling), _STEP_RADIUS_FRACTION * reach)
            is_stepped = step > fraction * limit
            tolerance = float(f"{max(fraction * limit, step):.3g}") or None
            if tolerance is not None and tolerance > FARTHEST:
                raise ConfigError(
                    f"expected coordinates within {FARTHEST:g}, got a cloud of height "
                    f"{sampling.height:.3g}; use a larger unit, as points / 2**40."
                )
        faceted = self.faceted
        if faceted == "auto" and tolerance is not None:
            are_vertices = _is_noisy_grid(sampling) and sampling.exactness < _QUANTIZED[0]
            faceted = is_stepped or are_vertices or _shape_fraction(sampling) > 0.5
        return dataclasses.replace(self, min_size=count, facet_tolerance=tolerance, faceted=faceted)


WHITENESS = 0.4, 0.6
"""Whiteness up to which surfaces are faceted or bent, and from which noise is white."""
_VARIATION = 0.38
"""Variation of the spacing below which points are mesh vertices or a grid."""
_FACET_HEIGHT_FRACTION, _FACET_RADIUS_FRACTION = 1 / 240, 0.3
"""Facet tolerance as a fraction of the cloud height, and its upper bound as a fraction of the
radius of 50 neighbors. The bound matters for scans of many stories."""
_WHITE_FRACTION = 0.45
"""Fraction of the facet tolerance used if noise is white (5 mm in a room), since cushions and other
bent surfaces are split there too."""
_WARP_FRACTION = 1.5
"""Increase of the facet tolerance in warped scans, where frames disagree over areas of any size.
Faces a few centimeters apart stay apart, since merging also limits the step between regions."""
_QUANTIZED = 0.04, 0.08
"""Exactness up to which white noise is that of points, and from which coordinates are rounded."""
_SCAN_LINES = 0.8
"""Variation of the spacing from which points are on scan lines, where nearest points are coplanar
without rounding. It is 0.15 to 0.65 for frames of a depth camera."""
_STEP_PER_DEVIATION = math.sqrt(12)
"""Rounding step per standard deviation: that of a uniform distribution."""
_STEP_RADIUS_FRACTION = 0.4
"""Upper bound of that step as a fraction of the radius of 50 neighbors. Steps of a depth camera are
0.35 of it on a desk; steps of distant walls would merge near boards two centimeters apart."""
_MIN_TERRACE_DEVIATION = 0.01
"""Deviation of 100 points of terraces, as a fraction of the radius of 50 neighbors. It is 0.03 to
0.3 for frames of a depth camera, 0.002 for points sampled from a mesh."""
_MIN_SIDE_FRACTION = 1 / 27
"""Side of the smallest region as a fraction of the cloud height: 10 cm in a room of 2.7 m."""
_MIN_SIZES = 20, 50
"""Bounds of the automatic min_size. Regions with fewer points have no reliable plane; 50 is the
paper's value."""
_EXACTNESS = 0.1, 0.2
"""Exactness up to which points are measured, and from which they are sampled from a mesh."""
_MIN_FACET_SIDE_FRACTION, _MAX_FACET_MIN_SIZE = 1 / 13, 200
"""Side of the smallest region as a fraction of the cloud height, and upper bound of min_size, for
points sampled from a mesh: smaller regions (20 cm in a room) are facets of curved surfaces."""


def _shape_fraction(sampling: Sampling) -> float:
    """Return how much of the deviation from planes is shape rather than noise, in [0, 1]."""
    return 1 - _ramp(sampling.whiteness, *WHITENESS)


def _is_noisy_grid(sampling: Sampling) -> bool:
    """Return whether points with white noise are evenly spaced: vertices of a mesh, or a grid."""
    return _shape_fraction(sampling) < 0.5 and sampling.variation < _VARIATION


def _warp_fraction(sampling: Sampling) -> float:
    """Return how much of the deviation from planes is warp of a fused scan, in [0, 1].

    The facets of a mesh are no warp: points sampled from them are exact, vertices evenly spaced.
    """
    if sampling.variation < _VARIATION:
        return 0.0
    return _shape_fraction(sampling) * (1 - _ramp(sampling.exactness, *_EXACTNESS))


def _rounding_step(sampling: Sampling) -> float:
    """Return the rounding step of quantized coordinates, in units of the cloud, else 0.

    Rounding makes terraces of a surface: nearest points are coplanar although the noise is white.
    """
    if sampling.variation > _SCAN_LINES:
        return 0.0
    quantized = (1 - _shape_fraction(sampling)) * _ramp(sampling.exactness, *_QUANTIZED)
    return quantized * _STEP_PER_DEVIATION * sampling.deviation


def is_terraced(sampling: Sampling) -> bool:
    """Return whether rounding of quantized coordinates makes terraces of surfaces, of any width.

    Nearest points are coplanar, but not a hundred. If terraces are wider than a neighborhood, the
    deviation is no white noise, and only even spacing distinguishes them from the facets of a mesh.
    """
    max_variation = _SCAN_LINES if _shape_fraction(sampling) < 0.5 else _VARIATION
    is_rounded = _ramp(sampling.exactness, *_QUANTIZED) > 0.5
    deviates = sampling.deviation > _MIN_TERRACE_DEVIATION * _reach(sampling)
    return is_rounded and deviates and sampling.variation < max_variation


def _reach(sampling: Sampling) -> float:
    """Return the radius of 50 neighbors, in units of the cloud; 0 if the density is unknown."""
    return math.sqrt(50 / (math.pi * sampling.density)) if sampling.density > 0 else 0.0


def _ramp(value: float, low: float, high: float) -> float:
    """Return 0 up to ``low``, 1 from ``high``, and interpolate linearly in between."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


@dataclass(frozen=True)
class PlanesConfig:
    """Plane table."""

    up: Up | None = field(default=None, metadata=SHORT_FLAG)
    """Up axis, by which planes are classified as floor, ceiling, wall and so on. Commands on clouds
    use z. None: z, when the classes are read."""
    outline: bool = False
    """Trace the polygon of each plane (needs shapely)."""

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, kw_only=True)
class SelectionConfig:
    """Planes that a result keeps, and their order; see :func:`torchrg.select_planes`."""

    min_area: float = field(default=0.0, metadata=SHORT_FLAG)
    """Minimum area of a plane, in squared units of the cloud. Points of smaller planes are
    unlabeled. 0 keeps all planes."""
    kinds: tuple[PlaneKind, ...] | None = field(default=None, metadata=SHORT_FLAG)
    """Classes of planes to keep, separated by commas. Points of other planes are unlabeled. None:
    all classes."""
    sort: Literal["points", "area"] = field(default="points", metadata=SHORT_FLAG)
    """Order of the planes and labels: descending number of points, or descending area."""

    def __post_init__(self) -> None:
        check_values(self)
        expect(self, "min_area", ">= 0", self.min_area >= 0)
        expect(self, "kinds", f"to be some of {', '.join(PLANE_KINDS)} or none", self.kinds != ())

    @property
    def max_neighbors(self) -> int:
        """Maximum number of listed neighbors per point; 0 for images, which need no lists."""
        return 0


@dataclass(frozen=True)
class PipelineConfig(SelectionConfig):
    """Settings of :func:`torchrg.segment_planes`.

    The defaults equal :func:`load_config`.
    """

    normals: NormalsConfig = field(default_factory=NormalsConfig)
    """Normals and curvature."""
    growing: GrowingConfig = field(default_factory=GrowingConfig)
    """Region growing."""
    chunk_size: int = CHUNK_SIZE
    """Points processed at a time; bounds memory use. Does not change the result."""
    planes: PlanesConfig = field(default_factory=PlanesConfig)
    """Plane table."""

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self, "chunk_size", ">= 1", self.chunk_size >= 1)

    @property
    def max_neighbors(self) -> int:
        """Maximum number of listed neighbors per point."""
        return max(self.normals.k, self.normals.adaptive_k or 0)

    def without_selection(self) -> "PipelineConfig":
        """Return settings that keep all planes, with an up axis if ``kinds`` requires classes."""
        up = "z" if self.planes.up is None and self.kinds is not None else self.planes.up
        planes = dataclasses.replace(self.planes, up=up)
        return dataclasses.replace(self, min_area=0.0, kinds=None, sort="points", planes=planes)

    def with_angle(self, angle_deg: float) -> "PipelineConfig":
        """Set the paper's single threshold.

        Eq. (9) uses one theta for sharp points and for growth, so this sets both
        ``normals.sharp_angle_deg`` and ``growing.max_angle_deg``, like ``angle_deg: 8`` in a file.

        Raises:
            ConfigError: If the angle is not in [0, 90].

        Example:
            >>> config = load_config("paper").with_angle(8)
            >>> config.normals.sharp_angle_deg, config.growing.max_angle_deg
            (8.0, 8.0)
        """
        angle_deg = convert(angle_deg, float, "angle_deg", "PipelineConfig")
        if not 0 <= angle_deg <= 90:
            raise SettingError("PipelineConfig", "angle_deg", f"in [0, 90], got {shown(angle_deg)}")
        parts = {
            section: dataclasses.replace(getattr(self, section), **{name: angle_deg})
            for section, name in _ANGLES.items()
        }
        return dataclasses.replace(self, **parts)

    def with_sampling(self, sampling: Sampling) -> "PipelineConfig":
        """Replace ``auto`` by values that match how a cloud samples its surfaces.

        If whiteness is below 0.4, surfaces are bent or faceted; from 0.6 noise is white; values in
        between are interpolated. The fields of :class:`GrowingConfig` state the tolerances and
        sizes. Below 0.5, surfaces are ``faceted``, and so are evenly spaced points with white noise
        that are not exact: their normals are noisy. Points that are neither exact (0.1 to 0.2) nor
        evenly spaced are of no mesh, but fused from frames that disagree (warped). Coordinates are
        quantized if noise is white, yet points are exact (0.04 to 0.08) and not on scan lines
        (variation 0.8), as in one frame of a depth camera. If their rounding step decides, surfaces
        are ``faceted``. Regional noise is used if noise is white and the distances to the nearest
        point vary by less than 0.38, as in mesh vertices and grids.

        Example:
            >>> mesh = Sampling(0.06, variation=0.5, exactness=0.6, density=4e3, height=2.7)
            >>> config = load_config().with_sampling(mesh)
            >>> config.growing.facet_tolerance, config.growing.min_size, config.normals.noise_scope
            (0.0113, 173, 'local')
            >>> load_config().with_sampling(mesh._replace(exactness=0.0)).growing.facet_tolerance
            0.0281
        """
        return dataclasses.replace(
            self,
            normals=self.normals.with_sampling(sampling),
            growing=self.growing.with_sampling(sampling),
        )

    def measured(self, sampling: Sampling | None) -> dict[str, Any]:
        """Return the measured sampling and the settings chosen from it, as JSON values."""
        if sampling is None:
            return {}
        chosen = self.with_sampling(sampling)
        settings = {
            f"{section}.{name}": getattr(getattr(chosen, section), name)
            for section in ("normals", "growing")
            for name in ("noise_scope", "facet_tolerance", "faceted", "min_size")
            if getattr(getattr(self, section), name, None) == "auto"
            and getattr(getattr(chosen, section), name) != "auto"
        }
        return {"sampling": sampling._asdict(), "settings": settings}


AnyConfig = PipelineConfig | Mapping[str, Any] | str | Path
"""Type of a complete configuration; see :func:`load_config`."""
_SECTIONS = {"normals": NormalsConfig, "growing": GrowingConfig, "planes": PlanesConfig}
"""Sections of a configuration."""
_ANGLES = {"normals": "sharp_angle_deg", "growing": "max_angle_deg"}
"""Settings changed by ``angle_deg``, by section."""


@dataclass(frozen=True)
class SuperpointsConfig:
    """Superpoints; see :func:`torchrg.make_superpoints`."""

    strengths: tuple[float, ...] = (0.5, 1.5, 4.0, 12.0)
    """Regularization strength per level, ascending. Two adjacent regions merge if the cost is at
    most this, measured in points on opposite sides of a right angle. Doubling it leaves about 60 %
    of the superpoints."""
    counts: tuple[int, ...] | None = None
    """Number of superpoints per level, descending; overrides strengths. Actual counts can be lower
    or higher, depending on connectivity and the minimum size. None: set by strengths."""
    min_size: int = 10
    """Superpoints with fewer distinct points merge into the cheapest neighbor."""
    planes: Literal["borders", "whole"] = "borders"
    """Role of the planes. borders: superpoints prefer plane boundaries. whole: each plane is used
    whole and never split."""
    max_extent: float | None = None
    """Maximum side of a superpoint's bounding box, in units of the cloud; planes kept whole may
    exceed it. None disables the limit."""

    def __post_init__(self) -> None:
        check_values(self)
        is_list = len(self.strengths) > 0 and _ascends(0.0, *self.strengths)
        expect(self, "strengths", "one or more numbers > 0, ascending", is_list)
        counts = self.counts
        is_list = counts is None or (len(counts) > 0 and _ascends(0, *reversed(counts)))
        expect(self, "counts", "one or more integers > 0, descending, or none", is_list)
        expect(self, "min_size", ">= 1", self.min_size >= 1)
        extent = self.max_extent
        expect(self, "max_extent", "> 0 or none", extent is None or extent > 0)

    @property
    def num_levels(self) -> int:
        """Number of levels, from the finest to the coarsest."""
        return len(self.strengths if self.counts is None else self.counts)


def _ascends(*numbers: float) -> bool:
    """Return whether numbers increase strictly."""
    return all(a < b for a, b in itertools.pairwise(numbers))


@dataclass(frozen=True)
class DepthConfig(SelectionConfig):
    """Planes of depth images; see :func:`torchrg.depth.segment_depth`."""

    noise: tuple[float, float] | None = None
    """Sensor noise as two numbers a and b: the standard deviation is a + b z^2 at depth z, in units
    of the depth. None: estimated from each image."""
    max_depth: float | None = None
    """Maximum depth, in units of the depth; pixels beyond it are ignored. None disables the
    limit."""
    max_angle_deg: float = 8.0
    """Maximum angle between the normals of a pixel and an adjacent pixel that joins its region, in
    degrees."""
    max_step: float = 1.5
    """Maximum distance between the planes of adjacent pixels of a region, measured at either pixel,
    in standard deviations of the noise."""
    min_size: int = 100
    """Minimum number of pixels per plane; smaller regions stay unlabeled."""

    up: Up | None = field(default=None, metadata=SHORT_FLAG)
    """Up axis, -y for a level camera. If set, planes are classified as floor, ceiling, wall and so
    on; required by kinds. None: no classes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        parts: tuple[float, ...] = (1.0, 0.0) if self.noise is None else self.noise
        is_noise = min(parts) >= 0 and max(parts) > 0
        expect(self, "noise", "two numbers >= 0, not both 0, or none", is_noise)
        expect(self, "max_depth", "> 0 or none", self.max_depth is None or self.max_depth > 0)
        expect(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        expect(self, "max_step", ">= 0", self.max_step >= 0)
        needs_up = self.kinds is not None and self.up is None
        expect(self, "up", "with kinds, as -y for a level camera", not needs_up)
        expect(self, "min_size", ">= 1", self.min_size >= 1)


def preset_names() -> list[str]:
    """Return the sorted names of the presets of torchrg.

    Example:
        >>> "classic" in preset_names()
        True
    """
    return sorted(path.stem for path in _preset_folder().glob("*.yaml"))


def load_config(config: AnyConfig = DEFAULT_PRESET, **changes: Any) -> PipelineConfig:  # noqa: ANN401
    """Load settings from a preset, YAML file or dictionary, and override individual values.

    Values omitted by a file or dictionary come from ``consensus``, or from ``base``: a preset, or
    in Python also settings.
    Keys are sections, or dotted settings such as ``normals.k``. A top-level ``angle_deg`` sets both
    angles: see :meth:`PipelineConfig.with_angle`. Values can be words, as on the command line:
    ``"50"``, ``"no"``, ``"none"``, ``"wall,floor"``.

    Args:
        config: A name from :func:`preset_names`, the path of a ``.yaml`` file, a dictionary, or
            settings. Default: the preset ``consensus``.
        **changes: Overrides of individual settings, with the same keys.

    Returns:
        The settings.

    Raises:
        ConfigError: If the preset or file is not found, the file is not YAML, or a key or value is
            invalid.

    Example:
        >>> load_config({"base": "classic", "normals.k": 30}).normals.k
        30
        >>> load_config({"base": "classic", "growing": {"min_size": 20}}).growing.min_size
        20
    """
    return settings_of("load_config", PipelineConfig, config, changes)


def settings_of(
    caller: str,
    kind: type[Settings],
    config: object = None,
    changes: Mapping[str, Any] | None = None,
) -> Settings:
    """Load settings of one kind and override individual values.

    Args:
        caller: Name of the public function or class, the first word of messages.
        kind: :class:`PipelineConfig`, the class of one of its sections, or another settings class.
        config: An instance, a dictionary, a complete configuration, or the name of a preset or
            file. Default: as in :func:`load_config`.
        changes: Overrides, for a complete configuration as ``{"normals.k": 30}``.

    Raises:
        ConfigError: If a preset or setting does not exist, or a value is invalid.
    """
    is_part = kind in (PipelineConfig, *_SECTIONS.values())
    if isinstance(config, str | Path) and is_part:
        config = _read_config(config, caller)
    elif isinstance(config, Mapping):
        heads = {str(key).partition(".")[0] for key in config}
        is_whole = kind is PipelineConfig or (is_part and heads & {"base", *_SECTIONS})
        config = _apply_to_base(config, caller) if is_whole else _override(kind(), config, caller)
    elif config is None:
        config = kind()
    if isinstance(config, PipelineConfig) and is_part:
        parts = (config, config.normals, config.growing, config.planes)
        config = next(item for item in parts if isinstance(item, kind))
    if not isinstance(config, kind):
        presets = f", or a preset, one of {', '.join(preset_names())}" if is_part else ""
        raise ConfigError(
            f"{caller}: expected config to be a {kind.__name__} or a dictionary{presets}, got "
            f"{type(config).__name__}."
        )
    return _override(config, changes, caller) if changes else config


def _read_config(name_or_file: str | Path, caller: str) -> PipelineConfig:
    """Read the settings of a preset or a file."""
    path = Path(name_or_file)
    if path.suffix in (".yaml", ".yml"):
        return _read_file(path)
    expected = f"{caller}{': ' * bool(caller)}expected a .yaml file, or a preset, one of"
    return _find_preset(str(name_or_file), expected=expected)


def _read_file(path: Path) -> PipelineConfig:
    """Read the settings of a file."""
    import yaml

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: expected YAML, got {reason}.") from error
    return _apply_to_base({} if values is None else values, str(path))


_read_preset = cache(_read_file)
"""The settings of the file of a preset, which is read once."""


def _apply_to_base(values: object, where: str) -> PipelineConfig:
    """Apply the values of a file or dictionary to its base."""
    base: object = PipelineConfig()
    if isinstance(values, Mapping) and "base" in values:
        base = values["base"]
        values = {key: value for key, value in values.items() if key != "base"}
    if not isinstance(base, PipelineConfig):
        base = _find_preset(base, expected=f"{where}: expected base to be one of")
    return _override(base, values, where)


def _find_preset(name: object, *, expected: str) -> PipelineConfig:
    """Return the settings of a preset; raise if it does not exist."""
    if name not in preset_names():
        from torchrg._synonyms import advice_on

        advice = advice_on(str(name)) and f"; {advice_on(str(name))}"
        raise ConfigError(f"{expected} {', '.join(preset_names())}, got {shown(name)}{advice}.")
    return _read_preset(_preset_folder() / f"{name}.yaml")


def _override(config: Settings, values: object, where: str, prefix: str = "") -> Settings:
    """Override settings; raise for unknown keys and wrong values.

    ``where`` is the file or the caller, and ``prefix`` the section with a dot, for messages.
    """
    if not isinstance(values, Mapping):
        name = prefix.removesuffix(".") or "settings"
        raise SettingError(where, name, f"to be a mapping, got {values!r}")
    kind, direct, dotted = type(config), dict[str, Any](), dict[str, dict[str, Any]]()
    for key, value in values.items():
        section, dot, name = str(key).partition(".")
        if section not in vars(config) and (key, kind) != ("angle_deg", PipelineConfig):
            fix = _fix_for(str(key), value, config, prefix)
            raise ConfigError(f"{where}: unknown setting {f'{prefix}{key}'!r}; {fix}.")
        if dot:
            dotted.setdefault(section, {})[name] = value
        else:
            direct[section] = value
    try:
        if "angle_deg" in direct:  # Explicit values of the two angles take precedence.
            config = typing.cast(Any, config).with_angle(direct.pop("angle_deg"))
        for key, value in direct.items():
            current = getattr(config, key)
            if dataclasses.is_dataclass(current) and isinstance(value, Mapping):
                direct[key] = _override(current, value, where, f"{prefix}{key}.")
        changed = dataclasses.replace(config, **direct)  # type: ignore[type-var]
    except SettingError as error:
        if error.where == where:  # Of a section.
            raise
        raise SettingError(where, f"{prefix}{error.name}", error.problem) from None
    return _override(changed, dotted, where, prefix) if dotted else changed


def _fix_for(key: str, value: object, config: object, prefix: str) -> str:
    """Return the fix for an unknown key."""
    from torchrg._synonyms import advice_on, nearest_name

    names = [*vars(config), *["angle_deg"] * isinstance(config, PipelineConfig)]
    if name := nearest_name(key, [*names, *(name for name, _ in _flat_values(config))]):
        return f"the nearest is {prefix}{name}, as in {{{f'{prefix}{name}'!r}: {shown(value)}}}"
    return advice_on(key) or f"{type(config).__name__} has {', '.join(names)}"


def check_values(config: Any) -> None:  # noqa: ANN401
    """Convert settings to their types, numbers of at most 1e12, or raise; warn about radians."""
    kind = type(config)
    for name, hint in _hints_of(kind).items():
        value = getattr(config, name)
        if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
            value = _override(typing.cast(Any, hint)(), value, kind.__name__, f"{name}.")
        vars(config)[name] = value = convert(value, hint, name, kind.__name__)
        for number in value if isinstance(value, tuple) else (value,):
            is_far = isinstance(number, int | float) and abs(number) > FARTHEST
            expect(config, name, f"in [-{FARTHEST:g}, {FARTHEST:g}]", not is_far)
        if name.endswith("_deg") and 0 < value < _MIN_ANGLE_DEG:
            warn(f"expected degrees, not radians, got {value:g}; pass {math.degrees(value):.3g}.")


_hints_of: Callable[[Any], dict[str, Any]] = cache(typing.get_type_hints)
_MIN_ANGLE_DEG = 0.5
"""Minimum angle without a warning, in degrees. Presets use 5 and more, 0.09 in radians."""
_BOOLS = dict.fromkeys(("true", "on", "yes"), True) | dict.fromkeys(("false", "off", "no"), False)
"""Words for booleans, as in YAML."""
_TYPE_NAMES = {
    NoneType: "none",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "text",
    Path: "a path",
}


class SettingError(ConfigError):
    """A wrong value: caller or file ("" for a command), name, and a problem as ``>= 3, got 2``."""

    def __init__(self, where: str, name: str = "", problem: str = "") -> None:
        # Unpickling passes the message.
        message = f"{where}{': ' if where else ''}expected {name} {problem}." if name else where
        super().__init__(message)
        self.where, self.name, self.problem = where, name, problem


def expect(config: object, name: str, requirement: str, holds: bool) -> None:
    """Raise if a setting does not meet a requirement."""
    if not holds:
        problem = f"{requirement}, got {shown(getattr(config, name))}"
        raise SettingError(type(config).__name__, name, problem)


def convert(value: Any, hint: Any, name: str, where: str = "") -> Any:  # noqa: ANN401
    """Convert a value, or the words for it, to its annotated type.

    This is the only check of types: constructors, keywords, dictionaries, files and commands accept
    the same values. Words are numbers, choices, true, false and none; commas separate them.

    Raises:
        SettingError: If the value is none of the type; ``where`` and ``name`` begin the message.
    """
    plain = value.item() if getattr(value, "ndim", None) == 0 else value
    kinds = kinds_of(hint)
    for kind in sorted(kinds, key=lambda kind: kind is not NoneType):
        with suppress(ValueError, OverflowError):
            return _convert_to(kind, plain)
    from torchrg._synonyms import advice_on

    expected = " or ".join(map(_type_name, kinds))
    advice = advice_on(name) and f"; {advice_on(name)}" if dataclasses.is_dataclass(hint) else ""
    raise SettingError(where, name, f"to be {expected}, got {shown(value)}{advice}")


def _convert_to(kind: Any, value: Any) -> Any:  # noqa: ANN401
    """Convert a value to a type without alternatives, or raise ValueError."""
    word = value.strip().lower() if isinstance(value, str) else value
    is_word, items = isinstance(value, str), typing.get_args(kind)
    if kind is NoneType and (value is None or (is_word and word in ("none", "null"))):
        return None
    if kind is bool and (isinstance(value, bool) or (is_word and word in _BOOLS)):
        return _BOOLS.get(word, value)
    if kind in (int, float) and not isinstance(value, bool):
        allowed = numbers.Integral if kind is int else numbers.Real
        if (is_word or isinstance(value, allowed)) and (number := kind(value)) == number:
            return number
    if typing.get_origin(kind) is Literal and is_word:
        return items[items.index(value)]
    if typing.get_origin(kind) is tuple and not isinstance(value, Mapping | bytes | None):
        parts = value.replace(" ", "").split(",") if is_word else value
        parts = tuple(parts) if isinstance(parts, Iterable) else (parts,)
        if ... in items or len(parts) == len(items):
            return tuple(convert(part, items[0], "") for part in parts)
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    if (kind is str and is_word) or (dataclasses.is_dataclass(kind) and type(value) is kind):
        return value
    raise ValueError


@cache
def kinds_of(hint: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """Return the alternatives of an annotated type."""
    is_union = typing.get_origin(hint) in (types.UnionType, typing.Union)
    return typing.get_args(hint) if is_union else (hint,)


def _type_name(kind: Any) -> str:  # noqa: ANN401
    """Return the name of a type for messages."""
    items = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return f"one of {', '.join(items)}" if len(items) > 1 else f"{items[0]}"
    if typing.get_origin(kind) is tuple:
        if typing.get_origin(items[0]) is Literal:
            return _type_name(items[0]).replace("one of", "some of")
        noun = {int: "integers", float: "numbers"}.get(items[0], "values")
        return noun if ... in items else f"{len(items)} {noun}"
    return _TYPE_NAMES.get(kind) or f"a {kind.__name__} or a mapping"


def _preset_folder() -> Path:
    """Return the folder of the presets: inside an installed package, else next to it."""
    inside = Path(__file__).parent / "presets"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "configs"


def _raise_immutable(config: object, name: str, value: object) -> NoReturn:
    """Raise an error that shows how to copy settings with a change."""
    kind = type(config)
    section = next((key for key, type_ in _SECTIONS.items() if type_ is kind), "")
    whole = f"load_config({{'base': config, '{section}.{name}': {value!r}}})"
    raise dataclasses.FrozenInstanceError(
        f"{kind.__name__} is immutable; use "
        f"{whole if section else f'dataclasses.replace(config, {name}={value!r})'}."
    )


def _flat_values(config: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
    """Yield the settings by their dotted names."""
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield from ((f"{name}.{inner}", item) for inner, item in _flat_values(value))
        else:
            yield name, value


@cache
def _values_of_presets() -> dict[str, dict[str, Any]]:
    """Return the settings of each preset by their dotted names, the default preset first."""
    names = sorted(preset_names(), key=lambda name: name != DEFAULT_PRESET)
    return {name: dict(_flat_values(load_config(name))) for name in names}


def _format_call(config: Any) -> str:  # noqa: ANN401
    """Return a call that creates the settings, with the differences from the defaults."""
    kind, values = type(config), dict(_flat_values(config))
    if kind is not PipelineConfig:
        defaults = dict(_flat_values(kind()))
        changed = [f"{name}={value!r}" for name, value in values.items() if value != defaults[name]]
        return f"{kind.__name__}({', '.join(changed)})"
    others = {
        name: {key: value for key, value in values.items() if value != preset[key]}
        for name, preset in _values_of_presets().items()
    }
    preset, differing = min(others.items(), key=lambda item: len(item[1]))
    return f"load_config({ {'base': preset, **differing} if differing else preset!r})"


_KINDS: list[Any] = [
    *_SECTIONS.values(),
    PipelineConfig,
    SelectionConfig,
    SuperpointsConfig,
    DepthConfig,
]
for _kind in _KINDS:
    _kind.__setattr__ = _raise_immutable
    _kind.__repr__ = _format_call
# Lets torch.load(weights_only=True) read checkpoints that contain settings.
torch.serialization.add_safe_globals(_KINDS)
