"""Flags shared by several commands, and their values."""

import dataclasses
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from torchrg.cli.arguments import Argument
from torchrg.cli.ending import print_warnings, warn
from torchrg.config import (
    DEFAULT_PRESET,
    WHITENESS,
    PipelineConfig,
    SelectionConfig,
    SuperpointsConfig,
    settings_of,
)
from torchrg.depth.camera import Pinhole
from torchrg.depth.values import DepthKind
from torchrg.errors import ConfigError
from torchrg.io import FORMATS, takes_columns
from torchrg.io.result import Result, read_result
from torchrg.io.tables import COLUMNS_RULE
from torchrg.normals import Orientation
from torchrg.structures import Sampling

_MAX_THREADS = 1024
"""Upper bound of --threads: more than any machine has cores, and few enough to start."""
_MAX_GIGABYTES = 1_000_000
"""Upper bound of --limit-memory: a petabyte, in GB."""

CloudsFlag = Annotated[
    tuple[Path, ...],
    Argument(
        metavar="CLOUD",
        is_positional=True,
        text=f"Input point clouds ({' '.join(FORMATS)}). For depth images and organized clouds, "
        "use torchrg depth.",
    ),
]
OutFlag = Annotated[
    Path,
    Argument(
        text="Output file; the extension selects the format. With several inputs, an output "
        "directory.",
    ),
]
ColumnsFlag = Annotated[
    str | None,
    Argument(
        metavar="X,Y,Z,...",
        text="Column names of text and plain .npy input, in order, as in x,y,z,intensity,r,g,b; "
        f"use _ to skip a column. {COLUMNS_RULE} The guess is printed.",
    ),
]
ThreadsFlag = Annotated[
    int | None,
    Argument(text="Number of CPU threads. Default: chosen by PyTorch, usually one per core."),
]
OrientFlag = Annotated[
    Orientation,
    Argument(
        text="Orientation of the normals. auto: front side of the faces of a mesh, else toward the "
        "scanner if the file stores its position (E57), else interior. interior: into the free "
        "space of rooms. viewpoint: toward the scanner. consistent: the same side as adjacent "
        "normals. up, +x ... -z: along an axis. none: not oriented, fastest.",
    ),
]
ViewpointFlag = Annotated[
    tuple[float, float, float] | None,
    Argument(
        text="Scanner position in input coordinates, for --orient viewpoint. Default: the "
        "positions stored in the file.",
    ),
]
IntrinsicsFlag = Annotated[
    str | None,
    Argument(
        metavar="CAMERA",
        text="Camera as fx,fy,cx,cy in pixels, with 0,0 at the center of the first pixel, or a "
        "camera file: a 3 x 3 or 4 x 4 matrix, JSON, YAML, info.txt or COLMAP's cameras.txt. "
        "Intrinsics for a larger image are scaled. convert rgbd finds the camera file of a folder.",
    ),
]
DepthScaleFlag = Annotated[
    float | None,
    Argument(
        text="Depth units per meter, as 1000 for millimeters. convert rgbd knows them for layouts."
    ),
]
DepthKindFlag = Annotated[
    DepthKind,
    Argument(
        text="Meaning of the stored values. z: depth along the optical axis, as depth cameras "
        "store. ray: distance from the camera center, as ray casters store (Hypersim, SceneNet)."
    ),
]
ImageOrientFlag = Annotated[
    Orientation,
    Argument(
        text="Orientation of the normals. auto, viewpoint, none: toward the camera. interior: into "
        "the free space of rooms. consistent: the same side as adjacent normals. up, +x ... -z: "
        "along an axis, in camera coordinates if the pose is unknown.",
    ),
]
TableFlag = Annotated[
    Path | None,
    Argument(
        metavar="PLANES.csv",
        text="Also write the plane table, as .csv, .json or .dxf; with several inputs, a "
        "directory. CSV has one row per plane in input coordinates: class, normal, offset, "
        "centroid, area, dip, RMS distance and the polygon as WKT POLYGON Z. DXF has closed 3D "
        "polylines on layers by class (pip install 'torchrg[dxf]'). The up axis is z. For point "
        "clouds, also traces polygons if shapely is installed (pip install 'torchrg[outline]').",
    ),
]
WithinFlag = Annotated[
    str | None,
    Argument(
        metavar="FIELD",
        text="Per-point field with object IDs, such as instance or segment. No plane crosses two "
        "objects, and the plane table lists the object of each plane. Points with ID -1 count as "
        "one more object. Default: no constraint.",
    ),
]
SuperpointsFlag = Annotated[bool, Argument(numbers="partition.counts")]
Layout = Literal["pointcept", "scannet", "mmdet3d", "spformer", "isbnet", "mask3d", "nag", "npy"]


def _base_settings(options: Mapping[str, Any]) -> PipelineConfig:
    """Return the settings of the preset or file, with the options that concern several settings.

    The up axis is z unless the file sets another. --table traces polygons if shapely is installed.
    """
    source = options.get("config") or options.get("preset", DEFAULT_PRESET)
    changes = {name: options[name] for name in ("angle_deg",) if options.get(name) is not None}
    config = settings_of("", PipelineConfig, source, changes)
    outline = bool(options.get("table") and find_spec("shapely")) or config.planes.outline
    planes = dataclasses.replace(config.planes, up=config.planes.up or "z", outline=outline)
    return dataclasses.replace(config, planes=planes)


@dataclass(frozen=True, kw_only=True)
class PlaneSettings:
    """Settings of the plane segmentation: preset or file, overridden by words."""

    preset: str = DEFAULT_PRESET
    """Preset to start from: consensus (adapts to the data), or classic, classic_increment, detmm,
    paper, algorithm2 for comparison. Settings override it."""
    config: Path | None = None
    """YAML settings file, instead of a preset. Settings it omits keep their defaults."""
    angle_deg: float | None = None
    """The paper's single threshold, in degrees: sets both --normals.sharp-angle-deg and
    --growing.max-angle-deg, which take precedence."""
    settings: Annotated[PipelineConfig, Argument(base=_base_settings)] = dataclasses.field(
        default_factory=lambda: _base_settings({})
    )


def describe_sampling(sampling: Sampling, settings: Mapping[str, Any]) -> str:
    """Describe the measured sampling of a cloud and the settings selected by it."""
    low, high = WHITENESS
    kind = "faces partly bent, noise partly white"
    if sampling.whiteness <= low:
        kind = "faces in facets or bent"
    elif sampling.whiteness >= high:
        kind = "white noise"
    chosen = ", ".join(
        f"{name.partition('.')[2]} {'none' if value is None else value}"
        for name, value in settings.items()
    )
    return f"{kind} (whiteness {sampling.whiteness:g}): {chosen}"


def reason_for_no_plane(settings: SelectionConfig) -> str:
    """Return the reason why a result has no plane."""
    is_chosen = settings.min_area > 0 or settings.kinds is not None
    return "no plane passes --min-area and --kinds" if is_chosen else "no region is large enough"


def split_columns(columns: str | None) -> tuple[str, ...] | None:
    """Split the value of ``--columns`` into names."""
    return None if columns is None else tuple(name.strip() for name in columns.split(","))


def file_columns(path: str | os.PathLike[str], columns: str | None) -> tuple[str, ...] | None:
    """Return the column names for a file; None if the file stores its own."""
    return split_columns(columns) if takes_columns(path) else None


def read_noted(path: Path, columns: str | None) -> Result:
    """Read a cloud or result, and print its notes."""
    result = read_result(path, columns=file_columns(path, columns))
    for note in result.cloud.notes:
        warn(f"{path}: {note}.")
    return result


def check_viewpoint(viewpoint: tuple[float, float, float] | None, orient: str) -> None:
    """Raise if a viewpoint is passed without --orient viewpoint."""
    if viewpoint is not None and orient != "viewpoint":
        raise ConfigError(f"expected --viewpoint with --orient viewpoint, got {orient}; add it.")


def check_columns(columns: str | None, paths: Iterable[str | os.PathLike[str]]) -> None:
    """Raise if column names are passed but every file stores its own."""
    if columns is not None and not any(map(takes_columns, paths)):
        raise ConfigError("expected text or .npy input for --columns, got files that name columns.")


def check_superpoints(config: SuperpointsConfig, level: int = 0, *, is_on: bool) -> None:
    """Raise if there are no superpoints for the settings, or they have no such level."""
    if not is_on and (config, level) != (SuperpointsConfig(), 0):
        raise ConfigError("expected --superpoints with --partition or --level, got none; add it.")
    if not 0 <= level < config.num_levels:
        max_level = config.num_levels - 1
        raise ConfigError(f"expected --level from 0 to {max_level}, got {level}.")


def parse_intrinsics(text: str | None) -> Pinhole | None:
    """Parse a camera from ``fx,fy,cx,cy`` or a file; None stays None."""
    from torchrg.datasets.camera_files import SUFFIXES, parse_camera, read_camera

    if text is None:
        return None
    numbers: list[float] = []
    with suppress(ValueError):
        numbers = [*map(float, text.split(","))]
    is_file = False
    with suppress(OSError):
        is_file = Path(text).is_file()
    with print_warnings():
        if len(numbers) == 4:
            record = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
            return parse_camera(Path(f"--intrinsics {text}"), record)
        if is_file or text.lower().endswith(SUFFIXES[1:]):
            return read_camera(Path(text))
    raise ConfigError(
        f"expected --intrinsics fx,fy,cx,cy (no spaces) or a camera file, got {text!r}."
    )


def limit_threads(threads: int | None) -> None:
    """Set the number of threads of torch; None keeps its default."""
    if threads is None:
        return
    if not 1 <= threads <= _MAX_THREADS:
        raise ConfigError(f"expected --threads from 1 to {_MAX_THREADS:,}, got {threads}.")
    torch.set_num_threads(threads)


def limit_in_bytes(limit_memory: float | None, default: int = 0) -> int:
    """Convert a memory limit to bytes; return ``default`` if unset, raise if out of range."""
    if limit_memory is None:
        return default
    if not 0 < limit_memory <= _MAX_GIGABYTES:
        raise ConfigError(
            f"expected --limit-memory above 0, at most {_MAX_GIGABYTES:,} GB, got {limit_memory}."
        )
    return int(limit_memory * 1e9)
