"""``torchrg segment``: segment point clouds into planes."""

import contextlib
import dataclasses
import os
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrg import scratch
from torchrg.batch.memory import available_memory, scan_memory
from torchrg.batch.sites import propose_voxel
from torchrg.cli import flags, loop
from torchrg.cli.arguments import parse
from torchrg.cli.ending import print_lines, warn
from torchrg.config import PipelineConfig, SuperpointsConfig
from torchrg.datasets.provenance import Record, describe_run
from torchrg.depth import find_intrinsics
from torchrg.errors import ConfigError
from torchrg.io import RESULT_FIELDS, check_output, estimate_points, read_cloud, write_cloud
from torchrg.io.files import check_space
from torchrg.io.merge import merge_clouds
from torchrg.io.plane_table import TABLE_SUFFIXES, describe_planes
from torchrg.io.result import Result, write_table
from torchrg.neighbors import sample_voxels
from torchrg.pipeline.clouds import (
    describe_multipliers,
    find_objects,
    note_on_copies,
    segment_cloud,
)
from torchrg.render import make_page, write_page
from torchrg.render.gallery import Entry, check_gallery, write_entry, write_index, write_planes
from torchrg.structures import Cloud, Segmentation


@dataclass(frozen=True)
class Arguments(flags.PlaneSettings):
    """Segment point clouds into planes: plane label, normal, curvature, plane table.

    Settings come from the preset (or the --config file), and arguments such as --normals.k 30
    override them. Points that lie on no plane get the label -1.

    Examples:
        torchrg segment scan.pcd --out planes.npz
        torchrg segment scan.ply --out planes.npz --normals.k 30 --growing.min-size 200
        torchrg segment scan.laz --out planes.laz --table planes.csv --picture planes.png
        torchrg segment *.ply --out results --picture pictures --pages
        torchrg segment part1.e57 part2.e57 --merge --out hall.npz --voxel 0.02
        torchrg segment scan.ply --out parts.npz --superpoints 1000,300
    """

    inputs: flags.CloudsFlag
    out: flags.OutFlag
    picture: Path | None = None
    """Also render the planes as an image (.png) or viewer (.html); for several, a directory."""
    table: flags.TableFlag = None
    pages: bool = False
    """Also write an interactive viewer for each image, and an index.html linking to them. Requires
    --picture DIRECTORY (pip install 'torchrg[view]')."""
    voxel: float | None = None
    """Voxel size, in units of the cloud. Segments one point per voxel and copies the result to all
    points of that voxel. Default: no downsampling."""
    superpoints: flags.SuperpointsFlag = False
    """Also partition all points into superpoints, stored as "superpoint" (finest), "superpoint_1"
    and so on. Optional numbers set how many per level, as in --superpoints 1000,300. Uses point
    colors if the cloud has them. Images then show superpoints instead of planes."""
    partition: SuperpointsConfig = dataclasses.field(default_factory=SuperpointsConfig)
    threads: flags.ThreadsFlag = None
    columns: flags.ColumnsFlag = None
    orient: flags.OrientFlag = "auto"
    viewpoint: flags.ViewpointFlag = None
    within: flags.WithinFlag = None
    merge: bool = False
    """Concatenate all inputs into one cloud, keeping the fields they share."""
    verbose: bool = False
    """Also print the measured kind of noise and the settings chosen from it."""
    limit_memory: float | None = None
    """Memory limit per cloud, in GB. Beyond it, the largest arrays go to disk (about 650 bytes per
    point, next to OUT or in TMPDIR); the result is identical. Default: half of the free memory."""


def run(argv: list[str]) -> int:
    """Parse the arguments, segment each input and write its result."""
    arguments = parse(Arguments, argv, prog="torchrg segment")
    flags.check_superpoints(arguments.partition, is_on=arguments.superpoints)
    flags.limit_threads(arguments.threads)
    flags.limit_in_bytes(arguments.limit_memory)
    if arguments.voxel is not None and not arguments.voxel > 0:
        raise ConfigError(f"expected --voxel > 0, got {arguments.voxel}.")
    clouds = [arguments.inputs] if arguments.merge else [(path,) for path in arguments.inputs]
    flags.check_columns(arguments.columns, arguments.inputs)
    flags.check_viewpoint(arguments.viewpoint, arguments.orient)
    firsts = tuple(sources[0] for sources in clouds if sources)
    outputs = loop.output_paths(firsts, arguments.out)
    pictures = loop.sidecar_paths(outputs, arguments.picture)
    tables = loop.sidecar_paths(outputs, arguments.table, suffixes=TABLE_SUFFIXES)
    loop.check_distinct([*outputs, *filter(None, tables)], arguments.inputs)
    if arguments.pages:
        _check_pages(arguments, pictures)
    code = loop.run_each(_segment, arguments, clouds, outputs, tables, pictures)
    if arguments.pages and arguments.picture is not None:
        pages = [(path, path.with_suffix(".html")) for path in filter(None, pictures)]
        done = [(path, page) for path, page in pages if page.is_file()]
        entries = [Entry(path.stem, path.name, page.name) for path, page in done]
        print_lines(f"pages -> {write_index(arguments.picture, 'Planes', entries)}")
    return code


def _check_pages(arguments: Arguments, pictures: Sequence[Path | None]) -> None:
    """Raise if viewers have no directory, or cannot be written."""
    if arguments.picture is None or not arguments.picture.is_dir():
        raise ConfigError("expected --pages together with --picture DIRECTORY.")
    check_gallery(arguments.picture, [path.stem for path in pictures if path is not None])


def _segment(arguments: Arguments, *paths: Any) -> None:  # noqa: ANN401
    """Apply :func:`_segment_cloud` to one input."""
    with contextlib.ExitStack() as storage:
        _segment_cloud(storage, arguments, *paths)


def _segment_cloud(
    storage: contextlib.ExitStack,
    arguments: Arguments,
    sources: tuple[Path, ...],
    target: Path,
    table: Path | None,
    picture: Path | None,
) -> None:
    """Segment a cloud with a progress bar, and print one line about the result.

    Its large arrays are in the ``storage``, a context that ends with the cloud.
    """
    begin, source = time.perf_counter(), loop.display_name(sources)
    cloud = _read(arguments, sources, target, storage)
    find_objects(cloud, arguments.within)  # An unknown field fails before any warning.
    _check_points(arguments, source, cloud, target)
    stages = (*loop.STAGES, *["superpoints"] * arguments.superpoints)
    with loop.stage_bar(sources[0].name, stages) as advance:
        seg, superpoints = segment_cloud(
            cloud,
            arguments.settings,
            orient=arguments.orient,
            viewpoint=arguments.viewpoint,
            partition=_memory_settings(arguments)[1],
            voxel=arguments.voxel,
            within=arguments.within,
            begin=advance,
            warn=lambda note: warn(f"{source}: {note}."),
        )
    for note in note_on_copies(seg.num_copies, len(cloud)):
        print_lines(f"{source}: {note}")
    provenance = _describe(arguments, sources, seg)
    write_cloud(target, cloud, seg, superpoints=superpoints, provenance=provenance)
    if table is not None:
        write_table(table, describe_planes(seg.planes, origin=cloud.origin.tolist()))
    if picture is not None:
        _draw(arguments, picture, Result.from_segmentation(cloud, seg, superpoints))
    if superpoints is not None:
        levels = superpoints.by_level().values()
        counts = " ".join(f"{int(level.max()) + 1:,}" for level in levels)
        print_lines(f"{source}: superpoints of each level: {counts}")
    if arguments.verbose and seg.sampling is not None:
        settings = arguments.settings.measured(seg.sampling)["settings"]
        print_lines(f"{source}: {flags.describe_sampling(seg.sampling, settings)}")
    dropped = loop.dropped_fields_note(target, cloud.fields)
    reason = flags.reason_for_no_plane(arguments.settings)
    if seg.num_copies + 1 == int(cloud.finite.sum()):
        reason = "all points are identical"
    seconds = f"{len(cloud):,} points in {time.perf_counter() - begin:.1f} s"
    loop.report_planes(source, seg, len(cloud), reason, f"{seconds} -> {target}{dropped}")


def _read(
    arguments: Arguments, sources: tuple[Path, ...], target: Path, storage: contextlib.ExitStack
) -> Cloud:
    """Read the inputs as one cloud, whose large arrays go to the storage that the limit allows.

    Raises ConfigError if the limit does not suffice, before reading if its points do not fit.
    """
    source = loop.display_name(sources)
    limit = flags.limit_in_bytes(arguments.limit_memory, available_memory() // 2)
    num_points = sum(map(estimate_points, sources))
    storage.enter_context(_array_storage(arguments, source, target, num_points, limit))
    columns = {path: flags.file_columns(path, arguments.columns) for path in sources}
    cloud = merge_clouds([read_cloud(path, columns=columns[path]) for path in sources])
    # The number was an estimate for text.
    storage.enter_context(_array_storage(arguments, source, target, len(cloud), limit))
    if arguments.voxel is not None:
        num_sites = len(sample_voxels(cloud.points, arguments.voxel).rows)
        print_lines(f"{source}: {num_sites:,} sites, one of the {len(cloud):,} points per voxel")
    elif scratch.is_active():
        voxel = propose_voxel(cloud.points)
        print_lines(f"{source}: --voxel {voxel:g} would segment about half of the points")
    return cloud


def _memory_settings(arguments: Arguments) -> tuple[PipelineConfig, SuperpointsConfig | None]:
    """Return the settings that decide on the memory, without a partition if there is none."""
    return arguments.settings, arguments.partition if arguments.superpoints else None


def _needed_memory(arguments: Arguments, num_points: int, *, on_disk: bool) -> int:
    """Return the memory for a cloud, in bytes."""
    settings, partition = _memory_settings(arguments)
    num_levels = 0 if partition is None else partition.num_levels
    return scan_memory(num_points, k=settings.max_neighbors, num_levels=num_levels, on_disk=on_disk)


def _array_storage(
    arguments: Arguments, source: str, target: Path, num_points: int, limit: int
) -> contextlib.AbstractContextManager[None]:
    """Return the context for large arrays: memory, or disk if they exceed the limit.

    Raises ConfigError if a cloud exceeds the limit even with these arrays on disk.
    """
    minimum = _needed_memory(arguments, num_points, on_disk=True)
    if minimum > limit:
        raise ConfigError(
            f"{source}: expected --limit-memory of at least {minimum / 1e9:.3g} GB for about "
            f"{num_points:,} points{describe_multipliers(*_memory_settings(arguments))}, got "
            f"{limit / 1e9:.3g} GB; raise it, or split the cloud."
        )
    needed = _needed_memory(arguments, num_points, on_disk=False)
    if needed <= limit or scratch.is_active():
        return contextlib.nullcontext()
    folder = Path(os.environ.get("TMPDIR") or target.parent)
    k = min(arguments.settings.max_neighbors, num_points)
    size = k * scratch.BYTES_PER_NEIGHBOR + scratch.BYTES_PER_POINT
    check_space(folder, num_points * size, "the work")
    print_lines(
        f"{source}: about {num_points:,} points need {needed / 1e9:.2f} GB of memory, the limit "
        f"is {limit / 1e9:.2f} GB: moving the largest arrays to disk in {folder}"
    )
    return scratch.on_disk(folder)


def _check_points(arguments: Arguments, source: str, cloud: Cloud, target: Path) -> None:
    """Warn about the input before the computation; raise if the output cannot be written."""
    levels = range(arguments.partition.num_levels if arguments.superpoints else 0)
    parts = [f"superpoint_{i}" if i else "superpoint" for i in levels]
    loop.note_input(source, cloud, target, (*RESULT_FIELDS, *parts))
    check_output(target, cloud)
    grid = cloud.grid_shape
    pixels = None if grid is None else torch.from_numpy(cloud.coordinates).view(*grid, 3)
    if pixels is not None and find_intrinsics(pixels) is not None:
        better = shlex.join(["torchrg", "depth", str(source), "--out", str(target)])
        warn(
            f"{source}: an organized cloud of a depth camera; torchrg depth is the better choice, "
            f"as it knows depth steps. Run {better}"
        )


def _describe(arguments: Arguments, sources: tuple[Path, ...], seg: Segmentation) -> Record:
    """Return the provenance of a cloud from one or several files."""
    settings = arguments.settings
    provenance = describe_run(sources[0], settings) | {"orient": arguments.orient}
    names = ("columns", "viewpoint", "voxel", "within")
    options = {name: getattr(arguments, name) for name in names}
    provenance |= {name: value for name, value in options.items() if value is not None}
    if measured := settings.measured(seg.sampling):
        provenance["measured"] = measured
    if arguments.superpoints:
        provenance["superpoints"] = dataclasses.asdict(arguments.partition)
    if len(sources) > 1:
        provenance["input"] = [describe_run(source, settings)["input"] for source in sources]
    return provenance


def _draw(arguments: Arguments, picture: Path, result: Result) -> None:
    """Write the image or viewer of a result, or both."""
    if arguments.pages:
        write_entry(picture.parent, picture.stem, result)
    elif loop.has_suffix(picture, ".html"):
        write_page(picture, make_page(result))
    else:
        write_planes(picture, result)
