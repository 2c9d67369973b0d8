"""All settings, their defaults and their meaning; files and flags hold only differences."""

import dataclasses
import itertools
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from torchrg._parallel import CHUNK_SIZE
from torchrg.errors import ConfigError

Settings = TypeVar("Settings")
NormalMethod = Literal[
    "pca", "jet", "irls", "fastmcd", "mve", "detmcd", "detmm", "paper", "consensus"
]
DEFAULT_PRESET = "consensus"


@dataclass(frozen=True)
class NormalsConfig:
    """How normals and curvature are estimated."""

    method: NormalMethod = "paper"
    """Estimator: one of the single fits of all points, or two stages (paper, consensus)."""
    k: int = 50
    """Number of neighbours, the point itself included. Smaller clouds use what they have."""
    sharp_rule: Literal["qn", "percentile"] = "qn"
    """Rule for sharp feature points: Qn of the angles to the neighbours' normals (eq. 9), or
    their 25th percentile (Algorithm 1)."""
    sharp_angle_deg: float = 5.0
    """A point is sharp when its rule gives more than this angle."""
    support_fraction: float = 0.5
    """Share of the neighbours that the MCD fits, in [0.5, 1]: 0.5 resists most outliers, 0.75 is
    the default of LIBRA, MATLAB's DetMCD."""
    mcd_scaling: Literal["consistency", "quantile"] = "consistency"
    """What DetMCD multiplies its raw scatter by: the factor for normal points, or one by which its
    h-th smallest squared distance is the chi-square quantile of h of k (LIBRA)."""
    mcd_inliers: Literal["raw", "reweighted"] = "raw"
    """Distances of DetMCD that are cut: those to the raw fit, or those to the reweighted one
    (LIBRA)."""
    inlier_quantile: float = 0.975
    """Neighbours within this chi-square quantile of the robust fit are inliers."""
    irls_decay: float = 1.05
    """Factor, above 1, by which the scale of irls shrinks in a step: its authors' is 1.01, which
    takes five times as long."""
    adaptive_k: int | None = None
    """Largest number of neighbours that consensus may use in noisy clouds, where k are too few to
    tell faces apart. None: always k."""

    noise_scope: Literal["local", "regional"] = "local"
    """What consensus takes for the noise about a point: what it finds there, or at most what it
    finds in the region around, within four neighbourhoods. Where a reconstruction has rounded a
    step between parallel faces into a ramp, the ramp looks like noise to the points on it."""

    def __post_init__(self) -> None:
        _require(self, "k", ">= 3", self.k >= 3)
        most = self.adaptive_k
        _require(self, "adaptive_k", ">= k or none", most is None or most >= self.k)
        _require(self, "sharp_angle_deg", "in [0, 90]", 0 <= self.sharp_angle_deg <= 90)
        _require(self, "support_fraction", "in [0.5, 1]", 0.5 <= self.support_fraction <= 1)
        _require(self, "inlier_quantile", "in (0, 1)", 0 < self.inlier_quantile < 1)
        _require(self, "irls_decay", "> 1", self.irls_decay > 1)


@dataclass(frozen=True)
class GrowingConfig:
    """How regions grow; the defaults are the paper's."""

    max_angle_deg: float = 5.0
    """A neighbour joins when the angle between the normals is at most this."""
    curvature_quantile: float = 0.95
    """The curvature limit is this quantile of the curvatures of all valid points."""
    seed_rule: Literal["curvature", "increment"] = "increment"
    """A point that joined grows further when its curvature (PCL), or the difference of its
    curvature to that of the point it joined (the paper), is at most the curvature limit."""
    connectivity: float | None = 0.75
    """Two points are connected when they share at least this fraction of their k neighbours.
    None: not tested."""
    connectivity_scope: Literal["region", "seed"] = "seed"
    """What an unconnected neighbour may not do: join the region (Algorithm 2 as printed), or only
    become a seed (the paper's text), which it is once a seed of its region that is connected to it
    reaches it, at the claim or later."""
    coplanarity: bool = True
    """Whether a neighbour joins only if its distance to the seed's plane is at most
    median + 2 Qn of those of the neighbourhood (eq. 11)."""
    coplanarity_scope: Literal["all", "connected"] = "all"
    """Which neighbours that median and Qn are taken over: all, or those left by the
    connectivity test (Algorithm 2)."""
    coplanarity_floor: float = 0.005
    """Least value of that Qn, as a fraction of the distance to the farthest neighbour: exact and
    quantised surfaces, where most residuals are equal, have Qn = 0."""
    plane_reach: float | None = None
    """Two points join only if each is within this many times the other's residual of the other's
    plane: faces never join across a thin plate. Takes the place of eq. 11 but where a fit is exact
    (residual below ``coplanarity_floor``). Needs the residuals of the normals. None: not tested."""
    max_distance: float | None = None
    """A neighbour farther than this does not join, in the unit of the cloud: the k nearest
    neighbours reach across gaps where points are few. None: not tested."""
    min_size: int = 50
    """Smaller regions are not labelled. With ``absorb`` the points at their borders count."""
    cut_bridges: bool = False
    """Whether regions of several faces that a few points join are split: faces 12 degrees apart,
    floors with furniture on them. Takes ``consensus`` about a twentieth more time."""
    facet_tolerance: float | None = None
    """After growth, regions that touch and lie within this distance of one plane, root mean square,
    become one, in the unit of the cloud: points drawn from a mesh lie exactly on its facets, of
    which a flat face has several. None: they do not."""
    max_plane_residual: float | None = None
    """After growth, points farther from the plane of their region than this many times its
    thickness lose their label. None: they keep it."""
    absorb: bool = False
    """Whether points without a region, those of regions that are too small included, then join a
    flat region that they touch and whose plane they are on."""
    absorb_reach: float = 3.0
    """They are on it when they are within this many times its thickness."""
    absorb_angle_deg: float = 45.0
    """And when their normal is within this angle of the plane's."""
    refine_borders: bool = False
    """Whether points where regions touch then go to the one that explains them best: of two planes
    within reach by the line in which these meet. Only with ``absorb``. Most of all in faces a few
    centimetres wide."""
    merge_coplanar: bool = False
    """Whether regions that touch and lie on one plane then become one, those included that lie
    within the noise of a larger one, as the residuals of the normals tell it."""
    merge_tolerance: float = 1.2
    """They lie on one plane when neither is thicker about it than this many times what it is about
    its own."""

    def __post_init__(self) -> None:
        _require(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        _require(self, "curvature_quantile", "in [0, 1]", 0 <= self.curvature_quantile <= 1)
        within = self.connectivity is None or 0 <= self.connectivity <= 1
        _require(self, "connectivity", "in [0, 1] or none", within)
        _require(self, "coplanarity_floor", ">= 0", self.coplanarity_floor >= 0)
        for name in ("max_distance", "plane_reach"):
            value = getattr(self, name)
            _require(self, name, ">= 0 or none", value is None or value >= 0)
        facets = self.facet_tolerance
        _require(self, "facet_tolerance", "> 0 or none", facets is None or facets > 0)
        _require(self, "min_size", ">= 1", self.min_size >= 1)
        residual = self.max_plane_residual
        _require(self, "max_plane_residual", "> 0 or none", residual is None or residual > 0)
        _require(self, "absorb_reach", ">= 0", self.absorb_reach >= 0)
        _require(self, "absorb_angle_deg", "in [0, 90]", 0 <= self.absorb_angle_deg <= 90)
        _require(self, "merge_tolerance", ">= 1", self.merge_tolerance >= 1)


@dataclass(frozen=True)
class PlanesConfig:
    """What the table of planes says beyond the planes themselves."""

    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis that points up: planes then have roles: floor, ceiling, wall and others. None: no."""
    outline: bool = False
    """Whether to trace the outline of each plane; needs shapely."""


@dataclass(frozen=True)
class PipelineConfig:
    """Everything that decides the result of :func:`torchrg.segment_planes`, and its memory."""

    normals: NormalsConfig = field(default_factory=NormalsConfig)
    """How normals and curvature are estimated."""
    growing: GrowingConfig = field(default_factory=GrowingConfig)
    """How regions grow."""
    chunk_size: int = CHUNK_SIZE
    """Points handled at a time; bounds the memory of each stage, never changes a result."""
    planes: PlanesConfig = field(default_factory=PlanesConfig)
    """What the table of planes says."""

    def __post_init__(self) -> None:
        _require(self, "chunk_size", ">= 1", self.chunk_size >= 1)


@dataclass(frozen=True)
class SuperpointsConfig:
    """How a cloud is partitioned; see :func:`torchrg.make_superpoints`."""

    strengths: tuple[float, ...] = (0.5, 1.5, 4.0, 12.0)
    """Strength of regularisation of each level, ascending: a region merges with one beside it when
    that costs at most this, in points of opposite sides of a right angle. Twice the strength leaves
    about 0.6 times the superpoints."""
    counts: tuple[int, ...] | None = None
    """Number of superpoints of each level, descending, in place of strengths. Fewer are found where
    the cloud has not so many connected parts of the minimum size, and more where more of its parts
    do not touch. None: strengths decide."""
    min_size: int = 10
    """Smaller superpoints join the neighbour that it costs least, in distinct points."""
    planes: Literal["pieces", "whole"] = "pieces"
    """Planes enter as compact pieces, which merge again unless objects meet in the plane, or whole,
    and are never cut."""
    max_extent: float | None = None
    """Longest side of the box around a superpoint, in the unit of the cloud; whole planes may have
    longer ones. None: no limit."""
    color_weight: float = 3.0
    """What a squared difference of colours in [0, 1] counts, against one of unit normals."""

    def __post_init__(self) -> None:
        is_list = len(self.strengths) > 0 and _ascends(0.0, *self.strengths, math.inf)
        _require(self, "strengths", "one or more numbers > 0, ascending", is_list)
        counts = self.counts
        is_list = counts is None or (len(counts) > 0 and _ascends(0, *reversed(counts)))
        _require(self, "counts", "one or more whole numbers > 0, descending, or none", is_list)
        _require(self, "min_size", ">= 1", self.min_size >= 1)
        extent = self.max_extent
        _require(self, "max_extent", "> 0 or none", extent is None or 0 < extent < math.inf)
        _require(self, "color_weight", ">= 0", 0 <= self.color_weight < math.inf)

    @property
    def num_levels(self) -> int:
        """Number of partitions, each of which is coarser than the one before it."""
        return len(self.strengths if self.counts is None else self.counts)


def _ascends(*numbers: float) -> bool:
    """Return whether each number is larger than the one before it."""
    return all(a < b for a, b in itertools.pairwise(numbers))


@dataclass(frozen=True)
class DepthConfig:
    """How planes are found in depth images; see :func:`torchrg.depth.segment_depth`."""

    noise: tuple[float, float] | None = None
    """Noise of the sensor: two numbers a and b, for a standard deviation of a + b z^2 at depth z,
    in the unit of the depth. None: estimated from each image."""
    max_depth: float | None = None
    """Depth beyond this is left out, in the unit of the depth. None: all is used."""
    max_angle_deg: float = 8.0
    """A pixel joins the region of the next one when the angle between their normals is at most
    this."""
    max_step: float = 1.5
    """And when the planes of the two differ at either by at most this many standard deviations of
    the noise."""
    min_size: int = 100
    """Smaller regions are not labelled, in pixels."""
    absorb_reach: float = 3.0
    """Pixels at borders join the flat region beside them when they are within this many standard
    deviations of its plane."""
    merge_tolerance: float = 1.2
    """Flat regions that touch become one when one plane explains both: neither is farther from it
    than this many times what it is from its own."""

    def __post_init__(self) -> None:
        parts = (1.0,) if self.noise is None else self.noise
        is_noise = all(0 <= part < math.inf for part in parts) and sum(parts) > 0
        _require(self, "noise", "two numbers >= 0, not both 0, or none", is_noise)
        _require(self, "max_depth", "> 0 or none", self.max_depth is None or self.max_depth > 0)
        _require(self, "max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90)
        _require(self, "max_step", ">= 0", self.max_step >= 0)
        _require(self, "min_size", ">= 1", self.min_size >= 1)
        _require(self, "absorb_reach", ">= 0", self.absorb_reach >= 0)
        _require(self, "merge_tolerance", ">= 1", self.merge_tolerance >= 1)


def preset_names() -> list[str]:
    """Return the names of the presets that come with torchrg, sorted.

    Example:
        >>> "classic" in preset_names()
        True
    """
    return sorted(path.stem for path in _preset_folder().glob("*.yaml"))


def load_config(name_or_file: str | Path = DEFAULT_PRESET) -> PipelineConfig:
    """Read settings from a preset or a YAML file; what it leaves out has its default.

    A file that begins with ``base: NAME`` leaves out what that preset says instead.

    Args:
        name_or_file: A name from :func:`preset_names`, or the path of a ``.yaml`` file.

    Returns:
        The settings.

    Raises:
        ConfigError: If there is no such preset or file, it is not YAML, or a key or value is wrong.

    Example:
        >>> load_config("classic").growing.seed_rule
        'curvature'
    """
    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        expected = "load_config: expected a .yaml file, or a preset, one of"
        path = _preset_file(str(name_or_file), expected=expected)
    return _build_config(PipelineConfig, _read_values(path), where=str(path))


def _read_values(path: Path) -> object:
    """Return the values of a settings file, on top of those of its base if it names one."""
    import yaml

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: expected YAML, got {reason}.") from error
    if not isinstance(values, dict) or "base" not in values:
        return {} if values is None else values
    base = _preset_file(values.pop("base"), expected=f"{path}: expected base to be one of")
    return _merged(_read_values(base), values)


def _merged(base: Any, values: Any) -> Any:  # noqa: ANN401
    """Return nested mappings as one; what both have is taken from the second."""
    if not isinstance(base, dict) or not isinstance(values, dict):
        return values
    return base | {key: _merged(base.get(key), value) for key, value in values.items()}


def _preset_file(name: object, *, expected: str) -> Path:
    """Return the file of a preset, or say what was expected."""
    if name not in preset_names():
        raise ConfigError(f"{expected} {', '.join(preset_names())}, got {name!r}.")
    return _preset_folder() / f"{name}.yaml"


def _build_config(kind: type[Settings], values: object, *, where: str) -> Settings:
    """Make a settings object from nested mappings, and refuse keys and types it does not have.

    ``where`` is the file (and section) for messages.
    """
    hints = typing.get_type_hints(kind)
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}: expected a mapping of settings, got {values!r}.")
    filled: dict[str, Any] = {}
    for key, value in values.items():
        if key not in hints:
            names = ", ".join(hints)
            raise ConfigError(f"{where}: unknown key {key!r}; {kind.__name__} has {names}.")
        if dataclasses.is_dataclass(hints[key]):
            section = typing.cast(type, hints[key])
            filled[key] = _build_config(section, value, where=f"{where}: {key}")
        else:
            filled[key] = _checked(value, hints[key], f"{where}: {key}")
    try:
        return kind(**filled)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _checked(value: Any, hint: Any, where: str) -> Any:  # noqa: ANN401
    """Return a value of the annotated type, or say what was expected."""
    unions = (types.UnionType, typing.Union)
    choices = typing.get_args(hint) if typing.get_origin(hint) in unions else (hint,)
    for choice in choices:
        if typing.get_origin(choice) is Literal:
            if value in typing.get_args(choice):
                return value
        elif choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif type(value) is choice:
            return value
    allowed = [_spelled(choice) for choice in choices]
    raise ConfigError(f"{where}: expected {' or '.join(allowed)}, got {value!r}.")


def _spelled(choice: Any) -> str:  # noqa: ANN401
    """Return a type as a user would write it."""
    if typing.get_origin(choice) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(choice)))
    return "null" if choice is type(None) else str(choice.__name__)


def _require(config: Any, name: str, requirement: str, holds: bool) -> None:  # noqa: ANN401
    """Raise unless a setting is in its range."""
    if not holds:
        value = getattr(config, name)
        raise ConfigError(f"{type(config).__name__}: expected {name} {requirement}, got {value!r}.")


def _preset_folder() -> Path:
    """Return the folder of the presets: inside an installed package, or beside it."""
    inside = Path(__file__).parent / "presets"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "configs"
