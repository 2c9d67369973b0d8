"""``torchrg segment``: plane labels of scans."""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from torchrg.batch.records import describe_run
from torchrg.batch.scans import check_finite
from torchrg.cli import console
from torchrg.config import SuperpointsConfig
from torchrg.errors import ConfigError
from torchrg.io import check_output, read_cloud, write_cloud
from torchrg.neighbors import sample_voxels
from torchrg.pipeline import segment_planes
from torchrg.render import make_page, write_page
from torchrg.render.gallery import Entry, draw_entry, draw_planes, with_results, write_index
from torchrg.render.page import check_library
from torchrg.transforms import partition_voxels, segment_voxels

STAGES = ("neighbors", "normals", "regions", "planes")
IMAGE_FLAGS = ("--intrinsics", "--depth-scale", "--image")
"""Flags of depth images, which have a command of their own."""


@dataclass(frozen=True)
class Arguments:
    """Label the planes of scans, and write labels, normals, curvature and a table of planes.

    Settings come from the preset, then from --config, then from the flags given here.
    """

    inputs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Clouds to read: .npz .npy .ply .pcd .las .laz .e57 .xyz .txt. Depth images and organised
    clouds taken as such: see torchrg depth --help."""
    out: Path
    """File to write, its format by suffix; for several inputs a directory."""
    picture: Path | None = None
    """Picture of the planes to write too, a .png file, or page, a .html file; for several inputs a
    directory of pictures."""
    pages: bool = False
    """Beside each picture in the directory write a page for the browser to turn the cloud in, and
    index.html, in which the pictures lead to their pages (pip install 'torchrg[view]')."""
    voxel: float | None = None
    """Side of voxels, in the unit of the cloud: one point of each is segmented, and every point
    has the result of its voxel. Default: all points are segmented."""
    superpoints: bool = False
    """Add superpoints, a partition of all points: of the first strength as "superpoints", the
    coarser ones as "superpoints_1" and so on. The picture shows them instead of the planes. Colours
    of the cloud play a part."""
    partition: SuperpointsConfig = dataclasses.field(default_factory=SuperpointsConfig)
    threads: int | None = None
    """Threads to use. Default: as torch decides, usually one a core."""
    settings: console.SettingsFlags = dataclasses.field(default_factory=console.PlaneSettings)


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each input and write its result."""
    _refuse_images(argv)
    start = Arguments(
        inputs=tyro.MISSING, out=tyro.MISSING, settings=console.PlaneSettings.asked_for(argv)
    )
    arguments = console.parse(Arguments, argv, prog="torchrg segment", default=start)
    if not arguments.superpoints and arguments.partition != SuperpointsConfig():
        raise ConfigError(
            "segment: expected --superpoints with --partition flags, got none; add it."
        )
    console.use_threads(arguments.threads)
    outputs = console.output_paths(arguments.inputs, arguments.out)
    pictures = console.picture_paths(outputs, arguments.picture)
    if arguments.pages:
        _check_pages(arguments)
    code = console.run_each(_segment_file, arguments, outputs, pictures)
    if arguments.pages and arguments.picture is not None:
        done = [path for path in pictures if path is not None and _page_of(path).is_file()]
        entries = [Entry(path.stem, path.name, _page_of(path).name) for path in done]
        print(f"pages -> {write_index(arguments.picture, 'Planes', entries)}")
    return code


def _check_pages(arguments: Arguments) -> None:
    """Refuse pages without a directory for them, or without what they need."""
    if arguments.picture is None or not arguments.picture.is_dir():
        raise ConfigError("expected --pages together with --picture DIRECTORY.")
    check_library()


def _page_of(picture: Path) -> Path:
    """Return where the page of a picture is."""
    return picture.with_suffix(".html")


def _refuse_images(argv: list[str]) -> None:
    """Say where depth images went, if the arguments are about them."""
    for last, argument in zip(["", *argv], argv, strict=False):
        is_flag = argument.partition("=")[0] in IMAGE_FLAGS
        is_value = last.startswith("--") and "=" not in last
        is_input = not argument.startswith("-") and not is_value
        if is_flag or (is_input and argument.lower().endswith(".png")):
            what, name = ("", "IMAGES...") if is_flag else ("the image ", argument)
            raise ConfigError(
                f"segment: expected point clouds, got {what}{argument}; use: torchrg depth {name} "
                "--intrinsics FX,FY,CX,CY --depth-scale S --out PATH."
            )


def _segment_file(arguments: Arguments, source: Path, target: Path, picture: Path | None) -> None:
    """Segment one file, with a progress bar on a terminal and one line about the result."""
    begin = time.perf_counter()
    cloud = read_cloud(source)
    for note in check_finite(cloud):
        console.warn(f"{source}: {note}.")
    check_output(target, cloud)
    settings, voxel = arguments.settings.resolved, arguments.voxel
    stages = (*STAGES, "superpoints") if arguments.superpoints else STAGES
    with tqdm(total=len(stages), desc=source.name, unit="stage", leave=False, disable=None) as bar:

        def advance(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update(stage != STAGES[0])

        voxels = None if voxel is None else sample_voxels(cloud.points, voxel)
        if voxels is None:
            seg = segment_planes(cloud.points, settings, on_stage=advance)
        else:
            seg = segment_voxels(cloud.points, voxels, settings, on_stage=advance)
        parts, provenance = None, describe_run(source, settings)
        if arguments.superpoints:
            advance("superpoints")
            parts = partition_voxels(
                cloud.points, voxels, seg, arguments.partition, colors=cloud.fields.get("color")
            )
            provenance["superpoints"] = dataclasses.asdict(arguments.partition)
    if voxel is not None:
        provenance["voxel"] = voxel
    write_cloud(target, cloud, seg, superpoints=parts, provenance=provenance)
    if picture is not None:
        result = with_results(cloud, seg, parts)
        if arguments.pages:
            draw_entry(picture.parent, picture.stem, result)
        elif console.is_page(picture):
            write_page(picture, make_page(result))
        else:
            draw_planes(picture, result)
    seconds = time.perf_counter() - begin
    num_planes = len(seg.planes.count)
    if num_planes == 0:
        kept = cloud.coordinates[cloud.finite]
        reason = "all points are equal" if (kept == kept[0]).all() else "no region is large enough"
        console.warn(f"{source}: no plane found: {reason}.")
    if parts is not None:
        found = " ".join(f"{int(level.max()) + 1:,}" for level in (parts.labels, *parts.levels))
        print(f"{source}: superpoints of each level: {found}")
    share = float((seg.labels >= 0).double().mean()) * 100
    print(
        f"{source}: {len(cloud):,} points, {num_planes:,} planes, {share:.1f} % of the points "
        f"labelled, {seconds:.1f} s -> {target}"
    )
