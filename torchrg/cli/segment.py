"""``torchrg segment``: plane labels of scans."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from torchrg.batch.records import describe_run
from torchrg.cli import depth
from torchrg.cli.console import SOME_FAILED, fail, output_paths, parse, settings_asked_for, warn
from torchrg.cli.picture import draw_segmentation, picture_paths
from torchrg.config import (
    DEFAULT_PRESET,
    GrowingConfig,
    NormalsConfig,
    PipelineConfig,
    PlanesConfig,
)
from torchrg.errors import ConfigError, FormatError, TorchrgError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.pipeline import segment_planes
from torchrg.structures import Cloud, Segmentation
from torchrg.transforms import segment_voxels

STAGES = ("neighbors", "normals", "regions", "planes")


@dataclass(frozen=True)
class Arguments:
    """Label the planes of scans, and write labels, normals, curvature and a table of planes.

    Settings come from the preset, then from --config, then from the flags given here.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Clouds to read: .npz .npy .ply .pcd .las .laz .e57 .xyz .txt. Depth images (.png) and
    organised clouds with --image have flags of their own: see segment --image --help."""
    out: Path
    """File to write, its format by suffix; for several inputs a directory."""
    picture: Path | None = None
    """Picture of the planes to write too, a .png file; for several inputs a directory."""
    voxel: float | None = None
    """Side of voxels, in the unit of the cloud: one point of each is segmented, and every point
    has the result of its voxel. Default: all points are segmented."""
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
    threads: int | None = None
    """Threads to use. Default: as torch decides, usually one a core."""


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each input and write its result."""
    if depth.asks_for_images(argv):
        return depth.run(argv)
    arguments = parse(Arguments, argv, prog="torchrg segment", default=_starting_point(argv))
    settings = PipelineConfig(
        arguments.normals, arguments.growing, arguments.chunk_size, arguments.planes
    )
    if arguments.threads is not None:
        if arguments.threads < 1:
            raise ConfigError(f"expected --threads >= 1, got {arguments.threads}.")
        torch.set_num_threads(arguments.threads)
    outputs = output_paths(arguments.inputs, arguments.out)
    pictures = picture_paths(outputs, arguments.picture)
    failed = 0
    for source, target, picture in zip(arguments.inputs, outputs, pictures, strict=True):
        try:
            _segment_file(source, target, picture, settings, arguments.voxel)
        except TorchrgError as error:
            if len(outputs) == 1:
                raise
            failed += 1
            fail(str(error))
    if failed:
        return fail(
            f"{failed} of {len(outputs)} inputs failed, the others are written.", code=SOME_FAILED
        )
    return 0


def _starting_point(argv: list[str]) -> Arguments:
    """Return the arguments' defaults: those of the preset or the file that is asked for."""
    settings = settings_asked_for(argv)
    return Arguments(
        inputs=tyro.MISSING,
        out=tyro.MISSING,
        normals=settings.normals,
        growing=settings.growing,
        planes=settings.planes,
        chunk_size=settings.chunk_size,
    )


def _segment_file(
    source: Path, target: Path, picture: Path | None, settings: PipelineConfig, voxel: float | None
) -> None:
    """Segment one file, with a progress bar on a terminal."""
    begin = time.perf_counter()
    cloud = read_cloud(source)
    _check_points(cloud)
    check_output(target, cloud)
    with tqdm(total=len(STAGES), desc=source.name, unit="stage", leave=False, disable=None) as bar:

        def advance(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update(stage != STAGES[0])

        if voxel is None:
            seg = segment_planes(cloud.points, settings, on_stage=advance)
        else:
            seg = segment_voxels(cloud.points, voxel, settings, on_stage=advance)
    provenance = describe_run(source, settings) | ({} if voxel is None else {"voxel": voxel})
    write_cloud(target, cloud, seg, provenance=provenance)
    if picture is not None:
        draw_segmentation(picture, cloud, seg)
    _report(source, target, cloud, seg, time.perf_counter() - begin)


def _check_points(cloud: Cloud) -> None:
    """Warn of points that cannot be used.

    Raises:
        FormatError: If no point can be used.
    """
    num_bad = len(cloud) - int(cloud.finite.sum())
    if num_bad == len(cloud):
        raise FormatError(
            f"{cloud.source}: expected finite points, got none in {num_bad:,} points."
        )
    if num_bad:
        warn(
            f"{cloud.source}: {num_bad:,} of {len(cloud):,} points are not finite; they stay in "
            "place, unlabelled."
        )


def _report(source: Path, target: Path, cloud: Cloud, seg: Segmentation, seconds: float) -> None:
    """Print one line about a result, and a warning if it is empty."""
    num_planes = len(seg.planes.count)
    if num_planes == 0:
        places = "all points are equal" if _is_one_place(cloud) else "no region is large enough"
        warn(f"{source}: no plane found: {places}.")
    share = float((seg.labels >= 0).double().mean()) * 100
    print(
        f"{source}: {len(cloud):,} points, {num_planes:,} planes, {share:.1f} % of the points "
        f"labelled, {seconds:.1f} s -> {target}"
    )


def _is_one_place(cloud: Cloud) -> bool:
    """Return whether all finite points are the same."""
    kept = cloud.coordinates[cloud.finite]
    return bool((kept == kept[0]).all())
