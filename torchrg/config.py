"""All settings, their defaults and their meaning; files and flags hold only differences."""

import dataclasses
import difflib
import itertools
import math
import numbers
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar

import torch

from torchrg._parallel import CHUNK_SIZE
from torchrg.errors import ConfigError
from torchrg.structures import FARTHEST, PLANE_KINDS, PlaneKind, Sampling

Settings = TypeVar("Settings")
NormalMethod = Literal[
    "pca", "jet", "irls", "fastmcd", "mve", "detmcd", "detmm", "paper", "consensus"
]
DEFAULT_PRESET = "consensus"
Auto = Literal["auto"]
"""A setting that is measured; see :meth:`PipelineConfig.at_sampling`."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""Axis of the coordinates that points up."""
NO_FLAG = {"is_flag": False}
"""Metadata of a setting that files and Python change, and no flag of the command line."""
SHORT_FLAG = {"has_part": False}
"""Metadata of a setting whose flag has its name alone, without that of its part."""


@dataclass(frozen=True)
class NormalsConfig:
    """How normals and curvature are estimated; the defaults are those of the preset consensus."""

    method: NormalMethod = "consensus"
    """Estimator of the normals: one fit at every point (pca, jet, irls, fastmcd, mve, detmcd,
    detmm), or PCA and a second fit at sharp points (paper, consensus)."""
    k: int = 50
    """Number of neighbours of a point, the point itself included. More resist noise, fewer keep
    narrow faces. A cloud of fewer points uses all of them."""
    sharp_rule: Literal["qn", "percentile"] = "qn"
    """How a point is tested for being sharp: by Qn of the angles between its normal and those of
    its neighbours (qn, eq. 9), or by their 25th percentile (percentile, Algorithm 1)."""
    sharp_angle_deg: float = 5.0
    """A point is sharp when the rule for sharp points gives more than this angle, theta of the
    paper. angle_deg of a configuration sets it together with max_angle_deg of growth."""
    support_fraction: float = 0.5
    """Share of the neighbours that the MCD fits, in [0.5, 1]. With 0.5 it resists most outliers;
    0.75 is the default of LIBRA, MATLAB's DetMCD."""
    mcd_scaling: Literal["consistency", "quantile"] = "consistency"
    """Factor that DetMCD multiplies its raw scatter by: the one for normally distributed points
    (consistency), or the one that makes its h-th smallest squared distance the chi-square quantile
    of h of k (quantile, as in LIBRA)."""
    mcd_inliers: Literal["raw", "reweighted"] = "raw"
    """Fit from which DetMCD takes the distances that tell outliers: the raw one (raw), or the
    reweighted one (reweighted, as in LIBRA)."""
    inlier_quantile: float = 0.975
    """A neighbour is an inlier of a robust fit when its squared distance is within this quantile of
    the chi-square distribution."""
    irls_decay: float = field(default=1.05, metadata=NO_FLAG)
    """Factor, above 1, by which the scale of irls shrinks in each step. The authors of irls use
    1.01, which takes five times as long as 1.05."""
    adaptive_k: int | None = None
    """Largest number of neighbours that consensus may use in noisy clouds, where k are too few to
    tell faces apart. None: always k."""
    noise_scope: Literal["auto", "local", "regional"] = "auto"
    """Noise about a point, as consensus sees it: what is found at the point (local), or at most
    what is found in the region around it, within four neighbourhoods (regional). Regional is for
    vertices of meshes with noise: reconstructions round a step between parallel faces into a ramp
    that looks like noise to the points on it. By default it is measured which of them these are."""

    def __post_init__(self) -> None:
        check_values(self)
        _require(self, "k", ">= 3", self.k >= 3)
        most = self.adaptive_k
        _require(self, "adaptive_k", ">= k or none", most is None or most >= self.k)
        _require(self, "sharp_angle_deg", "in [0, 90]", 0 <= self.sharp_angle_deg <= 90)
        _require(self, "support_fraction", "in [0.5, 1]", 0.5 <= self.support_fraction <= 1)
        _require(self, "inlier_quantile", "in (0, 1)", 0 < self.inlier_quantile < 1)
        _require(self, "irls_decay", "> 1", self.irls_decay > 1)

    def at_sampling(self, sampling: Sampling) -> "NormalsConfig":
        """Return the settings with a choice; see :meth:`PipelineConfig.at_sampling`."""
        if self.noise_scope != "auto":
            return self
        is_regional = _facets(sampling) < 0.5 and sampling.variation < _VARIATION
        return dataclasses.replace(self, noise_scope="regional" if is_regional else "local")


@dataclass(frozen=True)
class GrowingConfig:
    """How regions grow; the defaults are those of the preset consensus.

    ``load_config("paper").growing`` are the paper's, and ``dataclasses.replace`` changes some.
    """

    max_angle_deg: float = 6.5
    """A neighbour joins a region when the angle between the two normals is at most this, theta of
    the paper. Larger values join more. angle_deg of a configuration sets it together with
    sharp_angle_deg of normals."""
    curvature_quantile: float = 0.95
    """Quantile of the curvatures that is the curvature limit for seeds."""
    curvature_scope: Literal["cloud", "neighborhood"] = "cloud"
    """Points whose curvatures the quantile is of: all valid points of the cloud (cloud, Algorithm
    2), or the neighbours of the seed (neighborhood, "of the k-NN" in section II.B)."""
    seed_rule: Literal["curvature", "increment"] = "curvature"
    """When a point that joined becomes a seed, from which the region grows on: when its own
    curvature is at most the limit (curvature, as in PCL), or when the difference to the curvature
    of the point it joined is (increment, as in the paper)."""
    connectivity: float | None = None
    """Two points are connected when they share at least this fraction of their k neighbours. None:
    not tested."""
    connectivity_scope: Literal["region", "seed"] = "seed"
    """The step that a neighbour which is not connected may not take: join the region (region,
    Algorithm 2 as printed), or only become a seed (seed, the paper's text). In the latter case it
    becomes one as soon as a seed of its region that is connected to it reaches it."""
    coplanarity: bool = True
    """Whether a neighbour joins only if its distance to the plane of the seed is at most median + 2
    Qn of the distances in the neighbourhood (eq. 11)."""
    coplanarity_scope: Literal["all", "connected"] = "all"
    """Neighbours over which the median and Qn of the coplanarity test are taken: all of them (all),
    or those that are connected (connected, Algorithm 2)."""
    coplanarity_floor: float = field(default=0.005, metadata=NO_FLAG)
    """Least value of Qn in the coplanarity test, as a fraction of the distance to the farthest
    neighbour. On exact and quantised surfaces most residuals are equal, and Qn alone is 0."""
    plane_reach: float | None = 4.0
    """Two points join only if each is within this many times the other's residual of the other's
    plane, so that faces never join across a thin plate. The test takes the place of eq. 11 but
    where a fit is exact (a residual below coplanarity_floor), and needs normals with residuals.
    None: not tested."""
    max_distance: float | None = None
    """A neighbour farther than this does not join, in the unit of the cloud. Where points are few,
    the k nearest neighbours reach across gaps, and this keeps them apart. None: not tested."""
    min_size: int | Auto = "auto"
    """Regions of fewer points are not labelled. Copies of a point count once. With absorb, points
    at the borders of a region count as well. By default the points on a square whose side is a 27th
    of the height of the cloud, 10 cm in a room, but 20 to 50; more where points are drawn from a
    mesh."""
    cut_bridges: bool = True
    """Whether a region of several faces that only a few points join is split, as faces 12 degrees
    apart and floors with furniture on them are. It takes consensus about a twentieth more time."""
    facet_tolerance: float | Auto | None = "auto"
    """After growth, regions that touch become one when they lie within this root mean square
    distance of one plane, in the unit of the cloud. It is for points drawn from a mesh, which lie
    exactly on its facets, of which a flat face has several, and for reconstructions that bend flat
    faces. auto: 1/240 of the height of the cloud, 11 mm in a room, where deviations grow with
    scale, and less than half of that, 5 mm, where noise is white. None: they stay apart."""
    faceted: bool | Auto = field(default="auto", metadata=NO_FLAG)
    """Whether flat faces deviate from their planes by form, as facets of a mesh and the bends of a
    fused reconstruction do, and not by noise. Then points decide whether a region is flat, not
    their normals; it needs facet_tolerance. auto: measured."""
    max_plane_residual: float | None = None
    """After growth, a point loses its label when it is farther from the plane of its region than
    this many times the thickness of the region. None: it keeps the label."""
    absorb: bool = True
    """Whether points without a region, and those of regions that are too small, join a flat region
    that they touch and whose plane they are on."""
    absorb_reach: float = field(default=3.0, metadata=NO_FLAG)
    """With absorb, a point is on the plane of a region when it is within this many times the
    thickness of the region."""
    absorb_angle_deg: float = field(default=45.0, metadata=NO_FLAG)
    """With absorb, a point joins only if its normal is within this angle of the normal of the
    plane."""
    refine_borders: bool = True
    """Whether points where regions touch go to the region that explains them best. Between two
    planes within reach, the line in which they meet decides. It needs absorb, and matters most for
    faces a few centimetres wide."""
    merge_coplanar: bool = True
    """Whether regions that touch and lie on one plane become one. A region within the noise of a
    larger one, as the residuals of the normals tell it, is included."""
    merge_tolerance: float = field(default=1.2, metadata=NO_FLAG)
    """With merge_coplanar, two regions lie on one plane when neither is thicker about it than this
    many times its thickness about its own plane."""

    def __post_init__(self) -> None:
        check_values(self)
        _require(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        _require(self, "curvature_quantile", "in [0, 1]", 0 <= self.curvature_quantile <= 1)
        within = self.connectivity is None or 0 <= self.connectivity <= 1
        _require(self, "connectivity", "in [0, 1] or none", within)
        _require(self, "coplanarity_floor", ">= 0", self.coplanarity_floor >= 0)
        for name in ("max_distance", "plane_reach"):
            value = getattr(self, name)
            _require(self, name, ">= 0 or none", value is None or value >= 0)
        facets = self.facet_tolerance
        is_open = facets is None or facets == "auto"
        _require(self, "facet_tolerance", "> 0, auto or none", is_open or float(facets or 0) > 0)
        least = self.min_size
        _require(self, "min_size", ">= 1 or auto", least == "auto" or int(least) >= 1)
        residual = self.max_plane_residual
        _require(self, "max_plane_residual", "> 0 or none", residual is None or residual > 0)
        _require(self, "absorb_reach", ">= 0", self.absorb_reach >= 0)
        _require(self, "absorb_angle_deg", "in [0, 90]", 0 <= self.absorb_angle_deg <= 90)
        _require(self, "merge_tolerance", ">= 1", self.merge_tolerance >= 1)

    def at_sampling(self, sampling: Sampling) -> "GrowingConfig":
        """Return the settings with numbers; see :meth:`PipelineConfig.at_sampling`."""
        least, tolerance = self.min_size, self.facet_tolerance
        if least == "auto":
            side, (low, high) = _SIDE_OF_REGION, _MIN_SIZES
            drawn = _facets(sampling) * _ramp(sampling.exactness, *_EXACTNESS)
            side += drawn * (_SIDE_OF_FACETS - side)
            high += round(drawn * (_MIN_OF_FACETS - high))
            size = round(sampling.density * (side * sampling.height) ** 2)
            least = min(max(size, low), high)
        if tolerance == "auto":
            reach = math.sqrt(50 / (math.pi * sampling.density)) if sampling.density > 0 else 0.0
            most = min(_FACETS_BY_HEIGHT * sampling.height, _FACETS_BY_REACH * reach)
            fraction = max(_facets(sampling), _WHITE_FRACTION)
            tolerance = float(f"{fraction * most:.3g}") or None
        faceted = self.faceted
        if faceted == "auto" and tolerance is not None:
            faceted = _facets(sampling) > 0.5
        return dataclasses.replace(self, min_size=least, facet_tolerance=tolerance, faceted=faceted)


WHITENESS = 0.4, 0.6
"""Whiteness up to which faces are in facets or bent, and from which on noise is white."""
_VARIATION = 0.38
"""Variation of spacing below which points are vertices of a mesh or of a grid."""
_FACETS_BY_HEIGHT, _FACETS_BY_REACH = 1 / 240, 0.3
"""Tolerance of facets by the height of the cloud, and at most by the reach of 50 neighbours, that
scans of many storeys do not have a larger one."""
_WHITE_FRACTION = 0.45
"""Fraction of the tolerance of facets that is left where noise is white, 5 mm in a room: cushions
and other bent faces come in pieces there, too."""
_SIDE_OF_REGION = 1 / 27
"""Side of the least region by the height of the cloud: 10 cm in a room of 2.7 m."""
_MIN_SIZES = 20, 50
"""Bounds of the points of the least region: fewer have no sure plane, and 50 is the paper's."""
_EXACTNESS = 0.1, 0.2
"""Exactness up to which points are measured, and from which on they are drawn from a mesh."""
_SIDE_OF_FACETS, _MIN_OF_FACETS = 1 / 13, 200
"""Side of the least region by the height of the cloud, and its most points, where points are drawn
from a mesh: smaller ones are facets of what is curved, 20 cm in a room."""


def _facets(sampling: Sampling) -> float:
    """Return how much of the deviation from planes is form and not noise, in [0, 1]."""
    return 1 - _ramp(sampling.whiteness, *WHITENESS)


def _ramp(value: float, low: float, high: float) -> float:
    """Return 0 up to the lower number, 1 from the higher one on, and what is even between."""
    return min(max((value - low) / (high - low), 0.0), 1.0)


@dataclass(frozen=True)
class PlanesConfig:
    """What the table of planes says beyond the planes themselves."""

    up: Up | None = field(default=None, metadata=SHORT_FLAG)
    """Axis that points up. With it, the table names the class of each plane: floor, ceiling, wall
    or another. Commands on clouds use z. None: no classes, or z where kinds needs them."""
    outline: bool = False
    """Whether the outline of each plane is traced; this needs shapely."""


@dataclass(frozen=True, kw_only=True)
class SelectionConfig:
    """Which planes a result keeps, and how it numbers them; see :func:`torchrg.select_planes`."""

    min_area: float = field(default=0.0, metadata=SHORT_FLAG)
    """Minimum area of a plane, in squares of the unit of the cloud. Points of smaller planes get no
    label. 0 keeps all planes."""
    kinds: tuple[PlaneKind, ...] | None = field(default=None, metadata=SHORT_FLAG)
    """Classes of planes to keep, with commas between them. Points of other planes get no label.
    None: all classes."""
    sort: Literal["points", "area"] = field(default="points", metadata=SHORT_FLAG)
    """Order of the planes: descending number of points, or descending area. Labels follow it."""

    def __post_init__(self) -> None:
        check_values(self)
        _require(self, "min_area", ">= 0", self.min_area >= 0)
        kinds: Any = self.kinds
        is_list = isinstance(kinds, tuple) and len(kinds) > 0 and set(kinds) <= set(PLANE_KINDS)
        words = f"to be some of {', '.join(PLANE_KINDS)}, or none"
        _require(self, "kinds", words, kinds is None or is_list)


@dataclass(frozen=True)
class PipelineConfig(SelectionConfig):
    """Everything that decides the result of :func:`torchrg.segment_planes`, and its memory.

    The defaults are those of :func:`load_config`.
    """

    normals: NormalsConfig = field(default_factory=NormalsConfig)
    """How normals and curvature are estimated."""
    growing: GrowingConfig = field(default_factory=GrowingConfig)
    """How regions grow."""
    chunk_size: int = CHUNK_SIZE
    """Number of points that are handled at a time. It bounds the memory of each stage and never
    changes a result."""
    planes: PlanesConfig = field(default_factory=PlanesConfig)
    """Contents of the table of planes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self, "chunk_size", ">= 1", self.chunk_size >= 1)

    def of_all_planes(self) -> "PipelineConfig":
        """Return the settings that keep all planes, and name the classes that ``kinds`` needs.

        Example:
            >>> load_config(kinds="wall").of_all_planes().planes.up
            'z'
        """
        up = "z" if self.planes.up is None and self.kinds is not None else self.planes.up
        planes = dataclasses.replace(self.planes, up=up)
        return dataclasses.replace(self, min_area=0.0, kinds=None, sort="points", planes=planes)

    def at_angle(self, angle_deg: float) -> "PipelineConfig":
        """Return the settings with another angle: the one threshold that the paper tunes.

        Below its eq. (9) the theta that tells sharp points is that of growth, so both move:
        ``normals.sharp_angle_deg`` and ``growing.max_angle_deg``. A file says ``angle_deg: 8``,
        the command line ``--angle-deg 8``; where these also name one of the two, that one stays.

        Raises:
            ConfigError: If the angle is not in [0, 90].

        Example:
            >>> config = load_config("paper").at_angle(8)
            >>> config.normals.sharp_angle_deg, config.growing.max_angle_deg
            (8, 8)
        """
        _check_angle("PipelineConfig", angle_deg)
        parts = {
            section: dataclasses.replace(getattr(self, section), **{name: angle_deg})
            for section, name in _ANGLES.items()
        }
        return dataclasses.replace(self, **parts)

    def at_sampling(self, sampling: Sampling) -> "PipelineConfig":
        """Return the settings with numbers in place of ``auto``, by how a cloud samples surfaces.

        Where whiteness is below 0.4, faces are bent or in facets, and ``facet_tolerance`` is 1/240
        of the height of the cloud, but at most 0.3 of the reach of 50 neighbours; from 0.6 on noise
        is white, and it is 0.45 of that; between, it falls evenly. Below 0.5 faces are ``faceted``.
        The noise of a region counts where it is white and distances to the nearest point vary by
        less than 0.38, as only those of vertices and grids do. The least region is a square of a
        27th of the height, of a 13th where points are drawn from a mesh, whose facets on curved
        things are no planes.

        Example:
            >>> mesh = Sampling(0.06, variation=0.5, exactness=0.6, density=4e3, height=2.7)
            >>> config = load_config().at_sampling(mesh)
            >>> config.growing.facet_tolerance, config.growing.min_size, config.normals.noise_scope
            (0.0113, 173, 'local')
        """
        return dataclasses.replace(
            self,
            normals=self.normals.at_sampling(sampling),
            growing=self.growing.at_sampling(sampling),
        )

    def measured(self, sampling: Sampling | None) -> dict[str, Any]:
        """Return what was measured and the settings that it chose, by name, as JSON holds them.

        Example:
            >>> load_config("classic").measured(None)
            {}
        """
        if sampling is None:
            return {}
        chosen = self.at_sampling(sampling)
        settings = {
            f"{section}.{name}": getattr(getattr(chosen, section), name)
            for section in ("normals", "growing")
            for name in ("noise_scope", "facet_tolerance", "faceted", "min_size")
            if getattr(getattr(self, section), name, None) == "auto"
            and getattr(getattr(chosen, section), name) != "auto"
        }
        return {"sampling": sampling._asdict(), "settings": settings}


AnyConfig = PipelineConfig | Mapping[str, Any] | str | Path
"""Whatever stands for a whole configuration: see :func:`load_config`."""
_SECTIONS = {"normals": NormalsConfig, "growing": GrowingConfig, "planes": PlanesConfig}
"""The parts of a configuration."""
_ANGLES = {"normals": "sharp_angle_deg", "growing": "max_angle_deg"}
"""The settings that ``angle_deg`` moves, by their section."""


@dataclass(frozen=True)
class SuperpointsConfig:
    """How a cloud is partitioned; see :func:`torchrg.make_superpoints`."""

    strengths: tuple[float, ...] = (0.5, 1.5, 4.0, 12.0)
    """Strength of regularisation of each level, ascending. A region merges with one beside it when
    that costs at most this, counted in points of opposite sides of a right angle. Twice the
    strength leaves about 0.6 times the superpoints."""
    counts: tuple[int, ...] | None = None
    """Number of superpoints of each level, descending, in place of strengths. A cloud with fewer
    connected parts of the minimum size gives fewer, and one with more parts that do not touch gives
    more. None: strengths decide."""
    min_size: int = 10
    """A superpoint of fewer distinct points joins the neighbour to which that costs least."""
    planes: Literal["borders", "whole"] = "borders"
    """How planes enter: superpoints prefer to keep to their borders (borders), or each enters as it
    is, never cut (whole)."""
    max_extent: float | None = None
    """Longest side of the box around a superpoint, in the unit of the cloud. Whole planes may have
    longer ones. None: no limit."""

    def __post_init__(self) -> None:
        check_values(self)
        is_list = len(self.strengths) > 0 and _ascends(0.0, *self.strengths)
        _require(self, "strengths", "one or more numbers > 0, ascending", is_list)
        counts = self.counts
        is_list = counts is None or (len(counts) > 0 and _ascends(0, *reversed(counts)))
        _require(self, "counts", "one or more whole numbers > 0, descending, or none", is_list)
        _require(self, "min_size", ">= 1", self.min_size >= 1)
        extent = self.max_extent
        _require(self, "max_extent", "> 0 or none", extent is None or extent > 0)

    @property
    def num_levels(self) -> int:
        """Number of partitions, each of which is coarser than the one before it."""
        return len(self.strengths if self.counts is None else self.counts)


def _ascends(*numbers: float) -> bool:
    """Return whether each number is larger than the one before it."""
    return all(a < b for a, b in itertools.pairwise(numbers))


@dataclass(frozen=True)
class DepthConfig(SelectionConfig):
    """How planes are found in depth images; see :func:`torchrg.depth.segment_depth`."""

    noise: tuple[float, float] | None = None
    """Noise of the sensor, as two numbers a and b for a standard deviation of a + b z^2 at depth z,
    in the unit of the depth. None: estimated from each image."""
    max_depth: float | None = None
    """Pixels beyond this depth are left out, in the unit of the depth. None: all are used."""
    max_angle_deg: float = 8.0
    """A pixel joins the region of the pixel beside it when the angle between their normals is at
    most this."""
    max_step: float = 1.5
    """A pixel joins the region of the pixel beside it only if the planes of the two differ at
    either by at most this many standard deviations of the noise."""
    min_size: int = 100
    """Regions of fewer pixels are not labelled."""

    up: Up | None = field(default=None, metadata=SHORT_FLAG)
    """Axis that points up, -y for a camera that stands level. With it, the table names the class of
    each plane; kinds needs it. None: no classes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        parts: tuple[float, ...] = (1.0, 0.0) if self.noise is None else self.noise
        is_noise = len(parts) == 2 and min(parts) >= 0 and max(parts) > 0
        _require(self, "noise", "two numbers >= 0, not both 0, or none", is_noise)
        _require(self, "max_depth", "> 0 or none", self.max_depth is None or self.max_depth > 0)
        _require(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        _require(self, "max_step", ">= 0", self.max_step >= 0)
        needs_up = self.kinds is not None and self.up is None
        _require(self, "up", "with kinds, as -y for a level camera", not needs_up)
        _require(self, "min_size", ">= 1", self.min_size >= 1)


def preset_names() -> list[str]:
    """Return the names of the presets that come with torchrg, sorted.

    Example:
        >>> "classic" in preset_names()
        True
    """
    return sorted(path.stem for path in _preset_folder().glob("*.yaml"))


def load_config(config: AnyConfig = DEFAULT_PRESET, **changes: Any) -> PipelineConfig:  # noqa: ANN401
    """Return settings: those of a preset, a YAML file or a dictionary, with some changed.

    What a file or a dictionary leaves out is as in ``consensus``, or as in the preset that it names
    as its ``base``. Its keys are sections, or settings with a dot, as in ``normals.k``.
    ``angle_deg`` at its top sets both angles: see :meth:`PipelineConfig.at_angle`.

    Args:
        config: A name from :func:`preset_names`, the path of a ``.yaml`` file, a dictionary, or
            settings. Default: the preset ``consensus``.
        **changes: Single settings on top of these, with the same keys.

    Returns:
        The settings.

    Raises:
        ConfigError: If there is no such preset or file, it is not YAML, or a key or value is wrong.

    Example:
        >>> load_config("classic", **{"normals.k": 30}).normals.k
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
    """Return settings of one kind, from whatever stands for a configuration, with some changed.

    Args:
        caller: Name of the public function or class, the first word of messages.
        kind: :class:`PipelineConfig`, the kind of one of its sections, or another.
        config: Such settings, a dictionary of them, a whole configuration, or the name of a preset
            or a file. Default: that of :func:`load_config`.
        changes: Single settings, for a whole configuration as ``{"normals.k": 30}``.

    Raises:
        ConfigError: If there is no such preset or setting, or a value is wrong.

    Example:
        >>> settings_of("f", NormalsConfig, "classic", {"k": 30}).method
        'pca'
    """
    is_part = kind in (PipelineConfig, *_SECTIONS.values())
    if isinstance(config, str | Path) and is_part:
        config = _read_config(config, caller)
    elif isinstance(config, Mapping):
        heads = {str(key).partition(".")[0] for key in config}
        is_whole = kind is PipelineConfig or (is_part and heads & {"base", *_SECTIONS})
        config = _configured(config, caller) if is_whole else _changed(kind(), config, caller)
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
    return _changed(config, changes, caller) if changes else config


def _read_config(name_or_file: str | Path, caller: str) -> PipelineConfig:
    """Return the settings of a preset or a file."""
    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        expected = f"{caller}: expected a .yaml file, or a preset, one of"
        path = _preset_file(str(name_or_file), expected=expected)
    import yaml

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: expected YAML, got {reason}.") from error
    return _configured({} if values is None else values, str(path))


def _configured(values: object, where: str) -> PipelineConfig:
    """Return the settings that a file or a dictionary holds, on top of those of its base."""
    base = PipelineConfig()
    if isinstance(values, Mapping) and "base" in values:
        expected = f"{where}: expected base to be one of"
        base = _read_config(_preset_file(values["base"], expected=expected), where)
        values = {key: value for key, value in values.items() if key != "base"}
    return _changed(base, values, where)


_MEASURED_NOW = ("s3dis", "scannet", "laser", "rgbd")
"""Presets of earlier versions, each for a kind of data."""


def _preset_file(name: object, *, expected: str) -> Path:
    """Return the file of a preset, or say what was expected."""
    if name in _MEASURED_NOW:
        raise ConfigError(
            f"{expected} {', '.join(preset_names())}, got {name!r}; leave it out: the default "
            "measures what that preset set. up names the axis that points up."
        )
    if name not in preset_names():
        raise ConfigError(f"{expected} {', '.join(preset_names())}, got {name!r}.")
    return _preset_folder() / f"{name}.yaml"


def _changed(config: Settings, values: object, where: str) -> Settings:
    """Return settings with others in place of some, and refuse keys and types that there are not.

    ``where`` is the file and section, or the caller, for messages.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a mapping of settings, got {values!r}.")
    kind, settings = type(config), dict[str, Any]()
    hints, dotted = typing.get_type_hints(kind), dict[str, dict[str, Any]]()
    for key, value in values.items():
        section, dot, name = str(key).partition(".")
        if dot:
            dotted.setdefault(section, {})[name] = value
        else:
            settings[section] = value
    if isinstance(config, PipelineConfig) and "angle_deg" in settings:
        angle = _checked(settings.pop("angle_deg"), float, f"{where}: angle_deg")
        _check_angle(where, angle)
        # What is called by its own name stays.
        config = typing.cast(Settings, config.at_angle(angle))
    for key, value in settings.items():
        if key not in hints:
            raise ConfigError(f"{where}: unknown setting {key!r}; {_repair(key, value, kind)}.")
        current = getattr(config, key)
        at = f"{where}: {key}"
        is_section = dataclasses.is_dataclass(current) and not dataclasses.is_dataclass(value)
        settings[key] = (
            _changed(current, value, at) if is_section else _checked(value, hints[key], at)
        )
    try:
        changed = dataclasses.replace(config, **settings)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    return _changed(changed, dotted, where) if dotted else changed


_WORDS_OF_OTHERS = {
    "preset": "the name of a preset is config, the argument before the settings",
    "radius": "neighbours are counted, by k, and may be bounded by max_distance",
    "offset": "torchrg.transforms takes batches with an offset",
    "n": "numbers of superpoints are counts",
}
"""Words of other programs for settings, and what they are called here."""


def _repair(key: str, value: object, kind: type) -> str:
    """Return what to write in place of a key that is no setting of a kind."""
    names = own_names = [*typing.get_type_hints(kind), *["angle_deg"] * (kind is PipelineConfig)]
    for section, section_kind in _SECTIONS.items() if kind is PipelineConfig else ():
        names = [*names, *(f"{section}.{name}" for name in typing.get_type_hints(section_kind))]
    tails = {name.rpartition(".")[2]: name for name in reversed(names)}
    if key in tails:
        return f"it is {tails[key]}, as in **{{{tails[key]!r}: {value!r}}}"
    if key in _WORDS_OF_OTHERS:
        return _WORDS_OF_OTHERS[key]
    if near := difflib.get_close_matches(key, [*tails, *names], 1):
        return f"the nearest is {tails.get(near[0], near[0])}"
    return f"{kind.__name__} has {', '.join(own_names)}"


def _checked(value: Any, hint: Any, where: str) -> Any:  # noqa: ANN401
    """Return a value of the annotated type, or say what was expected."""
    unions = (types.UnionType, typing.Union)
    choices = typing.get_args(hint) if typing.get_origin(hint) in unions else (hint,)
    for choice in choices:
        if typing.get_origin(choice) is Literal:
            if value in typing.get_args(choice):
                return value
        elif choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value) if abs(value) <= FARTHEST else value  # It is refused by its range.
        elif typing.get_origin(choice) is tuple and isinstance(value, str) and _is_words(choice):
            return _checked(tuple(value.replace(" ", "").split(",")), choice, where)
        elif typing.get_origin(choice) is tuple and not isinstance(value, str | Mapping | None):
            kind, *others = typing.get_args(choice)
            parts = tuple(value) if isinstance(value, Iterable) else (value,)
            if others == [...] or len(parts) == len(others) + 1:
                return tuple(_checked(item, kind, where) for item in parts)
        elif type(value) is choice:
            return value
    allowed = [_spelled(choice) for choice in choices]
    raise ConfigError(f"{where}: expected {' or '.join(allowed)}, got {value!r}.")


def _is_words(choice: Any) -> bool:  # noqa: ANN401
    """Return whether a tuple is one of words, which are written with commas between them."""
    return typing.get_origin(typing.get_args(choice)[0]) is Literal


def _spelled(choice: Any) -> str:  # noqa: ANN401
    """Return a type as a user would write it."""
    if typing.get_origin(choice) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(choice)))
    names = {type(None): "null", tuple: "numbers"}
    return names.get(typing.get_origin(choice) or choice, getattr(choice, "__name__", ""))


def _check_angle(where: str, angle_deg: float) -> None:
    """Raise unless the angle of a configuration is in its range."""
    if not 0 <= angle_deg <= 90:
        raise ConfigError(f"{where}: expected angle_deg in [0, 90], got {angle_deg!r}.")


def check_values(config: Any) -> None:  # noqa: ANN401
    """Raise unless words are among their choices, and numbers of their type and at most 1e12."""
    for name, hint in typing.get_type_hints(type(config)).items():
        value, kinds = getattr(config, name), _kinds_of(hint)
        if typing.get_origin(hint) is Literal:
            names = ", ".join(typing.get_args(hint))
            _require(config, name, f"to be one of {names}", value in typing.get_args(hint))
        kind = numbers.Real if float in kinds else numbers.Integral
        words = "a number" if float in kinds else "a whole number"
        is_open = kinds.isdisjoint({int, float}) or value is None or value == "auto"
        for number in () if is_open else value if isinstance(value, tuple | list) else (value,):
            is_number = isinstance(number, kind) and not isinstance(number, bool)
            _require(config, name, f"to be {words}", is_number and number == number)
            bounds = f"in [-{FARTHEST:g}, {FARTHEST:g}]"
            _require(config, name, bounds, abs(number) <= FARTHEST)


def _kinds_of(hint: Any) -> set[Any]:  # noqa: ANN401
    """Return the types that an annotation names."""
    parts = typing.get_args(hint)
    return set().union(*map(_kinds_of, parts)) if parts else {hint}


def _require(config: Any, name: str, requirement: str, holds: bool) -> None:  # noqa: ANN401
    """Raise unless a setting is in its range."""
    if not holds:
        value = getattr(config, name)
        raise ConfigError(f"{type(config).__name__}: expected {name} {requirement}, got {value!r}.")


def _preset_folder() -> Path:
    """Return the folder of the presets: inside an installed package, or beside it."""
    inside = Path(__file__).parent / "presets"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "configs"


def _refuse(config: object, name: str, value: object) -> NoReturn:
    """Say how settings are changed: not in place."""
    kind = type(config)
    section = next((key for key, type_ in _SECTIONS.items() if type_ is kind), "")
    whole = f"load_config(config, **{{'{section}.{name}': {value!r}}})"
    raise dataclasses.FrozenInstanceError(
        f"{kind.__name__}: settings are not changed in place; "
        f"{whole if section else f'dataclasses.replace(config, {name}={value!r})'} makes others."
    )


def _flat_values(config: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
    """Yield the settings of a configuration by their dotted names."""
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            yield from ((f"{name}.{inner}", own) for inner, own in _flat_values(value))
        else:
            yield name, value


@cache
def _values_of_presets() -> dict[str, dict[str, Any]]:
    """Return the settings of each preset by their dotted names, the default first."""
    names = sorted(preset_names(), key=lambda name: name != DEFAULT_PRESET)
    return {name: dict(_flat_values(load_config(name))) for name in names}


def _show(config: Any) -> str:  # noqa: ANN401
    """Return a call that makes the settings, with those that differ from the defaults."""
    kind, values = type(config), dict(_flat_values(config))
    if kind is not PipelineConfig:
        usual = dict(_flat_values(kind()))
        changed = [f"{name}={value!r}" for name, value in values.items() if value != usual[name]]
        return f"{kind.__name__}({', '.join(changed)})"
    others = {
        name: {key: value for key, value in values.items() if value != preset[key]}
        for name, preset in _values_of_presets().items()
    }
    preset, differing = min(others.items(), key=lambda item: len(item[1]))
    return f"load_config({preset!r}{f', **{differing}' if differing else ''})"


_KINDS: list[Any] = [
    *_SECTIONS.values(),
    PipelineConfig,
    SelectionConfig,
    SuperpointsConfig,
    DepthConfig,
]
for _kind in _KINDS:
    _kind.__setattr__ = _refuse
    _kind.__repr__ = _show
# So that torch.load(weights_only=True) reads checkpoints that hold settings.
torch.serialization.add_safe_globals(_KINDS)
