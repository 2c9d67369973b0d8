"""Arguments of ``torchrg convert``, those of each kind of data set, and the source they mean."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchrg.batch.folder import FolderSource
from torchrg.batch.rgbd import RGBDSource
from torchrg.batch.s3dis import S3DISSource, find_areas
from torchrg.batch.scans import Source
from torchrg.cli.console import settings_asked_for
from torchrg.config import (
    DEFAULT_PRESET,
    GrowingConfig,
    NormalsConfig,
    PipelineConfig,
    PlanesConfig,
)
from torchrg.errors import ConfigError
from torchrg.transforms import DepthConfig


@dataclass(frozen=True)
class Arguments:
    """What every kind of data set has."""

    root: Annotated[Path, tyro.conf.Positional]
    """Directory of the data set. It is only read."""
    out: Annotated[Path, tyro.conf.Positional]
    """Directory for the results, a folder for each scan; it is made. What is done there already is
    not done again."""
    workers: int | None = None
    """Scans at a time. Default: one for each core; on a cluster, as many as it takes."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks on Ray (pip install 'torchrg[ray]')."""
    ray_address: str | None = None
    """Ray cluster to use, "auto" for the one of this machine; every node sees both directories
    under these paths. Default: one that is started for the time of the command."""
    limit_memory: float | None = None
    """Gigabytes that all scans at a time may take. Default: 80 % of what is free."""
    only: str | None = None
    """Convert the scans whose names match, as in a shell: "Area_5/*"."""
    force: bool = False
    """Convert what is done already, too."""
    dry_run: bool = False
    """Say what would be done and why, and write nothing."""


@dataclass(frozen=True)
class CloudArguments(Arguments):
    """What data sets of clouds have beside."""

    preset: str = DEFAULT_PRESET
    """Settings to start from: classic, detmm, paper, consensus, or those for a kind of data: s3dis,
    scannet, laser, rgbd."""
    config: Path | None = None
    """YAML file with settings that differ from the defaults; replaces the preset."""
    normals: NormalsConfig = dataclasses.field(default_factory=NormalsConfig)
    """How normals and curvature are estimated."""
    growing: GrowingConfig = dataclasses.field(default_factory=GrowingConfig)
    """How regions grow."""
    planes: PlanesConfig = dataclasses.field(default_factory=PlanesConfig)
    """What the table of planes says."""
    chunk_size: int = PipelineConfig.chunk_size
    """Points handled at a time; bounds memory, never changes a result."""

    @property
    def settings(self) -> PipelineConfig:
        """How to segment."""
        return PipelineConfig(self.normals, self.growing, self.chunk_size, self.planes)


@dataclass(frozen=True)
class FolderArguments(CloudArguments):
    """Convert every cloud below a folder: normals, curvature, plane labels, table of planes.

    Clouds are files (.npz .npy .ply .pcd .las .laz .e57 .xyz .txt) and folders in Pointcept's
    layout; with ROOT for OUT, the latter are completed in place.
    """

    superpoint: bool = False
    """Write the planes of folders in Pointcept's layout as superpoint.npy too."""


@dataclass(frozen=True)
class S3DISArguments(CloudArguments):
    """Convert S3DIS as it is released into Pointcept's layout, with normals and planes."""

    areas: tuple[int, ...] = ()
    """Numbers of the areas. Default: those that are there."""
    class_order: Literal["pointcept", "spt"] = "pointcept"
    """What the numbers in segment.npy mean."""
    superpoint: bool = False
    """Write the planes as superpoint.npy too."""


@dataclass(frozen=True)
class RGBDArguments(Arguments):
    """Convert depth frames: normals, curvature and plane labels as images, a table of planes."""

    layout: Literal["tum", "icl-nuim", "scannet", "7-scenes", "images"] = "images"
    """Shape of the folder; images are all .png and .npy below it, of one camera."""
    intrinsics: str | None = None
    """fx,fy,cx,cy of the camera in pixels. Default: those of the layout; images have none."""
    depth_scale: float | None = None
    """Stored value of one metre. Default: that of the layout; images have none."""
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """How planes are found in depth images."""


KINDS: dict[str, type[Arguments]] = {
    "s3dis": S3DISArguments,
    "folder": FolderArguments,
    "rgbd": RGBDArguments,
}
"""Arguments by the name of the kind of data set."""


def starting_point(kind: str, argv: list[str]) -> Arguments:
    """Return the arguments' defaults: those of the preset or the file that is asked for."""
    start = KINDS[kind](root=tyro.MISSING, out=tyro.MISSING)
    if not isinstance(start, CloudArguments):
        return start
    asked = settings_asked_for(argv)
    return dataclasses.replace(
        start,
        normals=asked.normals,
        growing=asked.growing,
        planes=asked.planes,
        chunk_size=asked.chunk_size,
    )


def build_source(arguments: Arguments) -> Source:
    """Return the data set that the arguments mean, its paths absolute."""
    root, out = arguments.root.resolve(), arguments.out.resolve()
    match arguments:
        case S3DISArguments():
            areas = arguments.areas or find_areas(root)
            order, superpoint = arguments.class_order, arguments.superpoint
            return S3DISSource(root, arguments.settings, areas, order, superpoint)
        case FolderArguments():
            return FolderSource(root, arguments.settings, out, arguments.superpoint)
        case RGBDArguments():
            intrinsics, scale = _parse_intrinsics(arguments.intrinsics), arguments.depth_scale
            return RGBDSource(root, arguments.depth, arguments.layout, intrinsics, scale)
    raise TypeError(type(arguments).__name__)


def check_arguments(arguments: Arguments) -> None:
    """Check what their types do not say.

    Raises:
        ConfigError: If a value is out of range, or two do not go together.
    """
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    if arguments.limit_memory is not None and not arguments.limit_memory > 0:
        raise ConfigError(f"expected --limit-memory > 0, in GB, got {arguments.limit_memory}.")
    if isinstance(arguments, CloudArguments) and arguments.chunk_size < 1:
        raise ConfigError(f"expected --chunk-size >= 1, got {arguments.chunk_size}.")
    if arguments.ray_address is not None and arguments.engine != "ray":
        raise ConfigError("expected --ray-address together with --engine ray.")


def _parse_intrinsics(text: str | None) -> tuple[float, float, float, float] | None:
    """Return four numbers between commas."""
    if text is None:
        return None
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"expected --intrinsics as fx,fy,cx,cy, got {text!r}.") from None
    return fx, fy, cx, cy
