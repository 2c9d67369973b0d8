"""``torchrg convert``: segment a whole data set, on one machine or a Ray cluster."""

import dataclasses
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from tqdm import tqdm

from torchrg._optional import require
from torchrg._parallel import num_cores
from torchrg.batch.local import run_local
from torchrg.batch.memory import available_memory
from torchrg.batch.run import (
    REPORT,
    BatchReport,
    Plan,
    check_free_space,
    list_jobs,
    lock_folder,
    make_plan,
    match_jobs,
    read_failed,
    run_plan,
    write_report,
)
from torchrg.batch.scans import Job, Source, claim_pages
from torchrg.batch.sources import CloudSource, RGBDSource
from torchrg.batch.stale import StaleResult, check_stale, find_stale, remove_empty, remove_stale
from torchrg.batch.task import Reports
from torchrg.cli import ending, flags
from torchrg.cli.arguments import Argument, describe, parse
from torchrg.cli.loop import Progress, print_failure
from torchrg.cli.report import format_costs, format_plan, format_report
from torchrg.config import DepthConfig, SelectionConfig, SuperpointsConfig, load_config
from torchrg.datasets import S3DIS, FolderOfClouds, RGBDFrames, ScanNet
from torchrg.datasets.folder import SceneDataset
from torchrg.datasets.provenance import read_record
from torchrg.datasets.rgbd import FusedRecordings
from torchrg.datasets.s3dis import find_areas
from torchrg.errors import ConfigError, FormatError, TorchrgError
from torchrg.io import FOLDER_SUFFIXES
from torchrg.io.dxf import check_dxf
from torchrg.io.files import (
    OUTPUT_MARK,
    check_writable,
    create_folder,
    free_space,
    remove_leftovers,
)
from torchrg.io.plane_table import TABLE_SUFFIXES
from torchrg.io.result import PLANES_FILE, RECORD, read_result
from torchrg.render.gallery import INDEX, Entry, check_gallery, write_entry, write_index
from torchrg.render.page import read_library

_Benchmark = Literal["tum", "scannet", "7-scenes"]
_MEMORY_FRACTION = 0.8
"""Fraction of the available memory for all scans by default; other programs get the remainder."""
_Capture = Literal["nerfstudio", "arkitscenes", "replica", "scannetpp", "3rscan"]
_App = Literal["stray", "polycam", "record3d", "rtabmap"]


@dataclass(frozen=True)
class Arguments:
    """Arguments of every kind of data set."""

    root: Annotated[Path, Argument("ROOT", is_positional=True)]
    """Directory of the data set, read only."""
    out: Annotated[Path, Argument("OUT", is_positional=True)]
    """Output directory of one data set in one layout; finished scans are skipped."""
    workers: int | None = None
    """Number of scans processed at a time. Default: one per core; on a cluster, by memory."""
    engine: str = "local"
    """Execution: processes on this machine (local), or Ray (pip install 'torchrg[ray]'): a cluster
    for this command (ray), that of this machine (auto), or the address of one, as HOST:PORT, where
    ROOT and OUT have the same paths on every node."""
    limit_memory: float | None = None
    """Memory limit for all concurrent scans, in GB; larger ones use the disk. Default: 80 % of the
    free memory."""
    table: str | None = None
    """Name of a plane table in the folder of each scan, besides planes.json, such as planes.csv;
    see torchrg segment --table."""
    only: str | None = None
    """Shell pattern of scans to convert, such as "Area_5/*". Results of missing scans are kept."""
    only_failed: bool = False
    """Convert only scans whose last run failed, by OUT/report.json."""
    force: bool = False
    """Convert finished scans again."""
    prune: bool = False
    """Remove unmodified results of scans missing from ROOT, and their pages. Without it, such
    results are listed and the command stops."""
    dry_run: bool = False
    """Print the plan, write nothing."""

    def source(self, root: Path) -> Source:
        """Return the source to convert; ``root`` is absolute."""
        raise NotImplementedError


@dataclass(frozen=True)
class CloudArguments(flags.PlaneSettings, Arguments):
    """Additional arguments of data sets of point clouds."""

    pages: Path | None = None
    """Also write an image and an interactive viewer of each finished scan, and an index.html, into
    this directory (pip install 'torchrg[view]'). Default: no pages."""
    superpoints: flags.SuperpointsFlag = False
    """Also partition all points into superpoints. Optional numbers set how many per level, as in
    --superpoints 1000,300."""
    orient: flags.OrientFlag = "auto"
    within: flags.WithinFlag = None
    level: int = 0
    """Superpoint level to write, with --layout nag the first level; 0 is the finest."""
    layout: flags.Layout = "pointcept"
    """Output layout. pointcept: one folder per scan. npy: bare arrays. Other layouts write
    superpoints, points, classes and objects for mmdet3d (OneFormer3D, UniDet3D, ESAM), spformer
    (SPFormer), isbnet (ISBNet, Open3DIS, SphericalMask), mask3d (Mask3D), nag (Superpoint
    Transformer, all levels in one .h5; pip install 'torchrg[nag]') or scannet (SAI3D and
    preprocessing scripts). scannet writes segs.json and, for annotated scans, aggregation.json,
    replacing ScanNet's; its superpoints do not cross objects. S3DIS supports neither scannet nor
    spformer; ScanNet++ supports no other layout with classes."""
    partition: SuperpointsConfig = dataclasses.field(default_factory=SuperpointsConfig)

    def data(self, root: Path) -> SceneDataset:
        """Open the data set."""
        raise NotImplementedError

    def source(self, root: Path) -> Source:
        """Return the clouds of the data set with the settings of their results."""
        names = ("layout", "partition", "level", "orient", "within", "table")
        output: dict[str, Any] = {name: getattr(self, name) for name in names}
        return CloudSource(self.data(root), self.settings, superpoint=self.superpoints, **output)


@dataclass(frozen=True)
class FolderArguments(CloudArguments):
    """Convert every cloud below a folder: normals, curvature, plane labels, plane table.

    Inputs are files with --suffixes and folders in Pointcept's layout; if OUT is ROOT, the folders
    are completed in place. ROOT/a/b.ply is written to OUT/a/b. Links are followed, and each file is
    converted once.

    Examples:
        torchrg convert folder scans results --dry-run
        torchrg convert folder scans results --workers 4 --pages pages
    """

    columns: flags.ColumnsFlag = None
    exclude: tuple[str, ...] = ()
    """Shell patterns of files below ROOT that are no scans, as in readme.txt "old/*"."""
    suffixes: tuple[str, ...] = FOLDER_SUFFIXES
    """File extensions of clouds. Default: all formats of torchrg segment except .csv. Pass fewer if
    two files differ only in their extension."""

    def data(self, root: Path) -> SceneDataset:
        """Open the folder."""
        columns = flags.split_columns(self.columns)
        options: dict[str, Any] = {"suffixes": self.suffixes, "exclude": self.exclude}
        data = FolderOfClouds(root, columns=columns, **options)
        flags.check_columns(self.columns, [s.path for s in data.scenes if not s.path.is_dir()])
        return data


@dataclass(frozen=True)
class S3DISArguments(CloudArguments):
    """Convert the S3DIS release to Pointcept's layout, with normals and planes.

    To keep only large planes, pass --min-area 0.5.

    Examples:
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --dry-run
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --workers 4 --superpoints
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --areas 5 --pages pages
    """

    areas: tuple[int, ...] = ()
    """Area numbers. Default: all areas in ROOT."""

    def data(self, root: Path) -> SceneDataset:
        """Open the rooms of the areas."""
        require("pyarrow", extra="text", purpose="read S3DIS")
        return S3DIS(root, self.areas or find_areas(root))


@dataclass(frozen=True)
class ScanNetArguments(CloudArguments):
    """Convert the ScanNet or ScanNet++ release to Pointcept's layout, with normals and planes.

    Points are the mesh vertices. Results go to OUT/train, val and test, following the split lists
    in ROOT, ROOT/splits or ROOT/meta_data. segment200 needs scannetv2-labels.combined.tsv there;
    labels of ScanNet++ need its metadata.

    Examples:
        torchrg convert scannet scannet out --dry-run
        torchrg convert scannet scannet out --workers 4 --superpoints
        torchrg convert scannet scannet out --layout mmdet3d
    """

    def data(self, root: Path) -> SceneDataset:
        """Open the scans."""
        return ScanNet(root)


@dataclass(frozen=True)
class RGBDArguments(Arguments):
    """Convert depth frames to images of normals, curvature and plane labels, with a plane table.

    Examples:
        torchrg convert rgbd frames results --intrinsics 525,525,319.5,239.5 --depth-scale 1000
        torchrg convert rgbd capture map --fuse 0.02
    """

    layout: Literal["auto", _Benchmark, _Capture, _App, "images"] = "auto"
    """Directory structure of ROOT. auto: detected from its files. nerfstudio: transforms.json, also
    from COLMAP. stray, polycam, record3d, rtabmap: exports of Stray Scanner, Polycam (raw data),
    Record3D (EXR) and RTAB-Map. images: all depth images below ROOT, from one camera."""
    fuse: float | None = None
    """Voxel size in meters: write the planes of the fused cloud of each recording, and their IDs
    for the pixels of each frame. Default: no fusion."""
    intrinsics: flags.IntrinsicsFlag = None
    depth_scale: flags.DepthScaleFlag = None
    depth_kind: flags.DepthKindFlag = "z"
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """Planes of depth images."""
    orient: flags.ImageOrientFlag = "auto"

    def source(self, root: Path) -> Source:
        """Open the frames."""
        camera = flags.parse_intrinsics(self.intrinsics)
        names = ("layout", "depth_scale", "depth_kind")
        options: dict[str, Any] = {name: getattr(self, name) for name in names}
        data = RGBDFrames.from_folder(root, intrinsics=camera, **options)
        if self.fuse is None:
            return RGBDSource(data, self.depth, orient=self.orient, table=self.table)
        selection = {f.name: getattr(self.depth, f.name) for f in fields(SelectionConfig)}
        used = DepthConfig(**selection, up=self.depth.up, max_depth=self.depth.max_depth)
        if not 0 < self.fuse < math.inf or self.depth != used:
            raise ConfigError(
                f"expected --fuse > 0 without --depth.noise, max-angle-deg, max-step or min-size, "
                f"which are of single images, got {self.fuse:g} and {self.depth}; omit these."
            )
        fused = FusedRecordings(data, self.fuse, self.depth.max_depth)
        settings = load_config({**selection, "planes.up": self.depth.up})
        orient = "auto" if self.orient in ("viewpoint", "none") else self.orient
        return CloudSource(fused, settings, orient=orient, table=self.table)


KINDS: dict[str, type[Arguments]] = {
    "s3dis": S3DISArguments,
    "folder": FolderArguments,
    "scannet": ScanNetArguments,
    "rgbd": RGBDArguments,
}
"""Arguments by kind of data set."""


def run(argv: list[str]) -> int:
    """Parse the arguments, check the plan, convert, and print a report."""
    if not argv or argv[0] in ("-h", "--help"):
        kinds = [f"  {name:<9}{describe(kind).partition('.')[0]}." for name, kind in KINDS.items()]
        usage = f"usage: torchrg convert {{{','.join(KINDS)}}} ROOT OUT ..."
        more = "torchrg convert s3dis --help lists the options."
        print("\n".join([usage, "", *kinds, "", more]))
        raise SystemExit(0 if argv else ending.USAGE_ERROR)
    kind, *remaining = argv
    if kind not in KINDS:
        raise ConfigError(
            f"expected a kind of data set ({', '.join(KINDS)}), got {kind!r}; "
            "folder takes any clouds."
        )
    arguments = parse(KINDS[kind], remaining, prog=f"torchrg convert {kind}")
    _check(arguments)
    root, out = arguments.root.resolve(), arguments.out.resolve()
    listing = tqdm(
        desc=f"listing the scans in {root}", bar_format="{desc}", leave=False, disable=None
    )
    with listing, ending.print_warnings():
        scans = list_jobs(arguments.source(root), out)
    jobs = match_jobs(scans, arguments.only)
    if arguments.only_failed:
        failed = read_failed(out)
        jobs = [job for job in jobs if job.name in failed]
        if not jobs:
            ending.print_lines(f"nothing to do: {out / REPORT} lists no failed scan of {root}")
            return 0
    if arguments.dry_run:
        plan, stale = _plan_with_bar(jobs, arguments), _find_stale(scans, arguments)
        resources = (arguments.workers or num_cores(), _memory_limit(arguments), free_space(out))
        print(format_plan(plan))
        for result in stale:
            if result.paths and (result.scan is not None or arguments.prune):
                ending.print_lines(f"remove {result.name}: {result.reason}")
        print(format_costs(plan, *resources, scans[0].source.seconds_per_million))
        check_stale(stale, root, prune=arguments.prune)
        check_free_space(plan)
        return 0
    create_folder(out)
    check_writable(out / REPORT)
    pages = _page_folder(arguments)
    if pages is not None:
        create_folder(pages)
        check_gallery(pages, [job.name for job in jobs])
    with lock_folder(out):
        remove_leftovers(out, OUTPUT_MARK)
        stale = _find_stale(scans, arguments)
        check_stale(stale, root, prune=arguments.prune)
        plan = _plan_with_bar(jobs, arguments)
        check_free_space(plan)
        _remove_stale(stale, scans)
        return _convert(plan, scans, arguments)


def _check(arguments: Arguments) -> None:
    """Raise if values are out of range or incompatible."""
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    flags.limit_in_bytes(arguments.limit_memory)
    table = arguments.table or PLANES_FILE
    if Path(table).name != table or Path(table).suffix not in TABLE_SUFFIXES or table == RECORD:
        raise ConfigError(
            f"expected --table to be a name ending in {' or '.join(TABLE_SUFFIXES)}, got {table}; "
            "use planes.csv."
        )
    if Path(table).suffix == ".dxf":
        check_dxf()
    if arguments.engine not in ("local", "ray", "auto") and ":" not in arguments.engine:
        raise ConfigError(
            f"expected --engine local, ray, auto or HOST:PORT of a cluster, got {arguments.engine}."
        )
    if _page_folder(arguments) is not None:
        read_library()
    if isinstance(arguments, CloudArguments):
        is_on = arguments.superpoints or arguments.layout != "pointcept"
        flags.check_superpoints(arguments.partition, arguments.level, is_on=is_on)
        if arguments.orient == "viewpoint" and not isinstance(arguments, FolderArguments):
            raise ConfigError(
                "expected --orient auto, interior, up or none, got viewpoint; this data set "
                "stores no scanner positions."
            )
        if arguments.pages is not None and arguments.layout != "pointcept":
            raise ConfigError(
                f"expected --pages with --layout pointcept, got {arguments.layout}; omit one."
            )


def _page_folder(arguments: Arguments) -> Path | None:
    """Return the directory for viewers, or None."""
    return arguments.pages if isinstance(arguments, CloudArguments) else None


def _plan_with_bar(jobs: list[Job], arguments: Arguments) -> Plan:
    """Make the plan within the memory limit, with a progress bar."""
    limit = _memory_limit(arguments)
    jobs = [job.within(limit) for job in jobs]
    with tqdm(total=len(jobs), desc="looking", unit="scan", leave=False, disable=None) as bar:
        return make_plan(jobs, force=arguments.force, threads=num_cores(), on_scan=bar.update)


def _find_stale(scans: list[Job], arguments: Arguments) -> list[StaleResult]:
    """Return the stale results; --only and --only-failed keep results of missing scans."""
    is_whole = (arguments.only is None and not arguments.only_failed) or arguments.prune
    return [result for result in find_stale(scans) if is_whole or result.scan is not None]


def _remove_stale(stale: list[StaleResult], scans: list[Job]) -> None:
    """Remove stale results from the lists, the disk, and the index of viewers."""
    if paths := {path for result in stale for path in result.paths}:
        scans[0].source.write_lists(scans[0].out, without=paths)
    for result in stale:
        remove_stale(result)
        if result.paths:
            ending.print_lines(f"{result.folder}: removed: {result.reason}")
    for folder in {folder for result in stale for folder in result.page_folders}:
        try:
            if (folder / INDEX).is_file():
                _index_pages(folder, scans)
        except (TorchrgError, OSError) as error:
            ending.warn(f"{folder / INDEX}: may list removed scans: {error}")


def _convert(plan: Plan, scans: list[Job], arguments: Arguments) -> int:
    """Convert the scans of a plan, print a report, and return the exit code."""
    out = scans[0].out
    jobs, workers, limit = plan.to_convert, arguments.workers, _memory_limit(arguments)
    if num_large := sum(job.on_disk for job in jobs):
        large = f"{num_large:,} of {len(jobs):,} scans, which exceed the memory limit,"
        ending.print_lines(f"moving the largest arrays of {large} to disk")
    for job in jobs:
        if job.memory > limit:
            ending.warn(
                f"{job.name}: about {job.scan.num_points:,} points may exceed the memory limit of "
                f"{limit / 1e9:.1f} GB; it runs alone."
            )
    if arguments.engine == "local":
        workers = min(workers or num_cores(), max(len(jobs), 1))
        reports: Reports = run_local(jobs, workers=workers, memory_limit=limit)
    else:
        from torchrg.batch.ray_tasks import run_ray

        address = None if arguments.engine == "ray" else arguments.engine
        reports = run_ray(jobs, workers=workers, memory_limit=limit, address=address)
    kind = scans[0].source.unit
    unit = "frame" if kind == "frame" else "pt"
    sizes = {job.name: 1 if unit == "frame" else job.scan.num_points for job in jobs}
    total = sum(sizes.values())
    # No smoothing: scans finish rarely, and a recent rate would jump with each.
    with tqdm(total=total, unit=unit, unit_scale=True, smoothing=0, disable=None) as bar:
        shown = Progress(bar, sizes, unit=kind)
        report = run_plan(plan, reports, engine=arguments.engine, workers=workers, on_report=shown)
    for job in jobs:
        remove_empty(job.folder, {out})  # Scans that failed leave empty folders.
    # Files come before lines, whose reader may have gone.
    unreported = ""
    try:
        write_report(out, report, {job.name for job in scans} - {job.name for job in plan.jobs})
    except FormatError as error:
        unreported = str(error)
    if not report.disk_full:
        plan.jobs[0].source.write_lists(out)
    code = _finish(report, out, arguments, unit=kind)
    if unreported:
        code = ending.fail(unreported, code=code or ending.USAGE_ERROR)
    pages = _page_folder(arguments)
    if pages is not None and not report.interrupted:
        _draw_pages(plan, report, pages)
        ending.print_lines(f"pages -> {_index_pages(pages, scans)}")
    return code


def _memory_limit(arguments: Arguments) -> int:
    """Return the memory limit for all concurrent scans, in bytes."""
    spare = int(_MEMORY_FRACTION * available_memory())
    return flags.limit_in_bytes(arguments.limit_memory, spare)


def _draw_pages(plan: Plan, report: BatchReport, folder: Path) -> None:
    """Write the image and viewer of each finished scan."""
    done = {scan.name for scan in report.complete}
    jobs = [job for job in plan.jobs if job.name in done]
    for job in tqdm(jobs, desc="pages", unit="scan", leave=False, disable=None):
        try:
            claim_pages(job, folder)
            write_entry(folder, job.name, read_result(job.folder))
        except (TorchrgError, OSError) as error:
            ending.warn(f"{job.name}: no page: {error}")


def _index_pages(folder: Path, scans: list[Job]) -> Path:
    """Write the index of the viewers of complete scans in a folder, and return its path."""
    entries = []
    for name, record in ((job.name, read_record(job.folder) or {}) for job in scans):
        points, regions = record.get("points"), record.get("regions")
        is_complete = isinstance(points, int) and isinstance(regions, int)
        if is_complete and (folder / f"{name}.html").is_file():
            words = f"{points:,} points, {regions:,} planes"
            entries.append(Entry(name, f"{name}.png", f"{name}.html", words))
    return write_index(folder, scans[0].source.root.name, entries)


def _finish(report: BatchReport, out: Path, arguments: Arguments, *, unit: str) -> int:
    """Print the report, and return the exit code; results removed meanwhile are not complete."""
    for scan in report.scans:
        print_failure(scan)
    if report.with_status("kept") == list(report.scans):
        print("nothing to do")
    else:
        print(format_report(report, unit=unit))
    num_complete = sum((out / scan.name / RECORD).is_file() for scan in report.complete)
    state = f"{num_complete:,} of {len(report.scans):,} scans are complete"
    hint = "Rerun the same command to resume."
    if report.disk_full:
        return ending.fail(
            f"{out}: the disk is full; {state}. Free space. {hint}", code=ending.SOME_FAILED
        )
    if report.interrupted:
        return ending.fail(f"interrupted; {state}. {hint}", code=ending.INTERRUPTED)
    if num_complete < len(report.scans):
        hint = f"see {out / REPORT}. Rerun with --only-failed for the others alone"
        hint += ", with --exclude if they are no scans" * isinstance(arguments, FolderArguments)
        return ending.fail(f"{state}; {hint}.", code=ending.SOME_FAILED)
    ending.print_lines(f"{state} -> {out}")
    return 0
