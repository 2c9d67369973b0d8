"""``torchrg convert``: a whole data set, scan by scan, on one machine or on a Ray cluster."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tqdm import tqdm

from torchrg._optional import require
from torchrg._parallel import num_cores
from torchrg.batch.local import run_local
from torchrg.batch.memory import spare_memory
from torchrg.batch.run import (
    REPORT,
    BatchReport,
    Plan,
    check_room,
    list_jobs,
    lock_folder,
    make_plan,
    match_jobs,
    run_plan,
    write_report,
)
from torchrg.batch.scans import Job, Source
from torchrg.batch.sources import CloudSource, RGBDSource
from torchrg.batch.stale import (
    StaleResult,
    check_stale,
    find_stale,
    note_data_set,
    remove_stale,
)
from torchrg.batch.task import Reports
from torchrg.cli import flags
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import (
    INTERRUPTED,
    SOME_FAILED,
    USAGE_ERROR,
    fail,
    say,
    warn,
    warnings_as_lines,
)
from torchrg.cli.loop import Progress, tell_failure
from torchrg.cli.report import format_costs, format_plan, format_report
from torchrg.config import DepthConfig, SuperpointsConfig
from torchrg.datasets import S3DIS, FolderOfClouds, ScanNet
from torchrg.datasets.folder import SceneDataset
from torchrg.datasets.rgbd_layouts import find_layout
from torchrg.datasets.s3dis import find_areas
from torchrg.errors import ConfigError, FormatError, TorchrgError
from torchrg.io import FOLDER_SUFFIXES
from torchrg.io.files import check_place, free_space, make_folder, mark_of, remove_leftovers
from torchrg.plane_table import TABLE_SUFFIXES
from torchrg.render.gallery import check_gallery, draw_entry, write_index
from torchrg.render.page import check_library
from torchrg.result import PLANES_FILE, RECORD, read_result

_Benchmark = Literal["tum", "icl-nuim", "scannet", "7-scenes"]
_Capture = Literal["nerfstudio", "arkitscenes", "replica", "scannetpp", "3rscan"]


@dataclass(frozen=True)
class Arguments:
    """What every kind of data set has."""

    root: Annotated[Path, Argument("ROOT", is_positional=True)]
    """Directory of the data set. It is only read."""
    out: Annotated[Path, Argument("OUT", is_positional=True)]
    """Directory for the results, with a folder for each scan. It is made where there is none, and
    what is done there already is not done again."""
    workers: int | None = None
    """Number of scans at a time. Default: one for each core; on a cluster, as many as fit."""
    engine: Literal["local", "ray"] = "local"
    """Where scans are worked on: in processes of this machine (local), or as tasks of a Ray cluster
    (ray; pip install 'torchrg[ray]')."""
    ray_address: str | None = None
    """Address of the Ray cluster, "auto" for the one of this machine. Every node has to see ROOT
    and OUT under the same paths. Default: a cluster that is started for the command."""
    limit_memory: float | None = None
    """Gigabytes of memory that all scans at a time may take. Default: 80 % of what is free."""
    table: str | None = None
    """Name of a file with the table of planes in the folder of each scan, as planes.csv: as that of
    torchrg segment --table. planes.json is written there in any case."""
    only: str | None = None
    """Pattern for the names of the scans to convert, as in a shell: "Area_5/*". Results of scans
    that are not in ROOT any more stay."""
    force: bool = False
    """Convert what is done already, too."""
    prune: bool = False
    """Remove results of scans that are not in ROOT any more, unless they were changed. Without it
    the command names them and stops."""
    dry_run: bool = False
    """Say what would be done and why, and write nothing."""
    unit: ClassVar[str] = "scan"
    """Name for one of them in messages."""
    seconds_per_million: ClassVar[tuple[float, str]] = (10.0, "points, as consensus takes")
    """Time of one core of an AMD EPYC for a million points, and what it is the time of: ``torchrg
    segment`` of a made room of four million. ``classic`` takes six tenths of it, ``paper`` half as
    much again, and all take some three times as long without kernels."""

    def source(self, root: Path) -> Source:
        """Return the source to convert; the path is absolute."""
        raise NotImplementedError


@dataclass(frozen=True)
class CloudArguments(Arguments):
    """What data sets of clouds have beside."""

    pages: Path | None = None
    """Directory for a picture and a page of each scan that is done, and for index.html, in which
    the pictures are links to the pages (pip install 'torchrg[view]'). Default: none are made."""
    superpoints: bool = False
    """Write superpoints too: a partition of all points, for networks on them. Numbers say how many
    in each level: --superpoints 1000,300."""
    orient: flags.OrientFlag = "auto"
    within: flags.WithinFlag = None
    level: int = 0
    """Level of the superpoints that is written, of layout nag the first one; 0 is the finest."""
    layout: flags.Layout = "pointcept"
    """Files that are written: a folder for each scan (pointcept), bare arrays (npy), or superpoints
    with points, classes and objects where other programs look for them. These are OneFormer3D,
    UniDet3D and ESAM (mmdet3d), SPFormer (spformer), ISBNet, Open3DIS and SphericalMask (isbnet),
    Mask3D (mask3d), Superpoint Transformer (nag, all levels in one .h5; pip install
    'torchrg[nag]'), and SAI3D and the preprocessing of others (scannet). The last writes segs.json
    and, of annotated scans, aggregation.json, to replace those of ScanNet; superpoints end at
    objects there. S3DIS has neither scannet nor spformer, ScanNet++ no other with classes."""
    partition: SuperpointsConfig = dataclasses.field(default_factory=SuperpointsConfig)
    settings: flags.SettingsFlags = dataclasses.field(default_factory=flags.PlaneSettings)

    def data(self, root: Path) -> SceneDataset:
        """Return the data set."""
        raise NotImplementedError

    def source(self, root: Path) -> Source:
        """Return the clouds of the data set, and the settings of their results."""
        names = ("layout", "partition", "level", "orient", "within", "table")
        output: dict[str, Any] = {name: getattr(self, name) for name in names}
        settings = self.settings.resolved
        return CloudSource(self.data(root), settings, superpoint=self.superpoints, **output)


@dataclass(frozen=True)
class FolderArguments(CloudArguments):
    """Convert every cloud below a folder: normals, curvature, plane labels, table of planes.

    Clouds are files of --suffixes and folders in Pointcept's layout; with ROOT for OUT, the latter
    are completed in place. The results of ROOT/a/b.ply are in OUT/a/b. Links are followed, and each
    file is converted once.

    Examples:
        torchrg convert folder scans results --dry-run
        torchrg convert folder scans results --workers 4 --pages pages
    """

    columns: flags.ColumnsFlag = None
    suffixes: tuple[str, ...] = FOLDER_SUFFIXES
    """Suffixes of the files that are clouds, by default all that torchrg segment reads but .csv.
    Name fewer where two files differ in the suffix alone."""

    def data(self, root: Path) -> SceneDataset:
        """Return the folder."""
        columns = flags.split_columns(self.columns)
        data = FolderOfClouds(root, suffixes=self.suffixes, columns=columns)
        flags.check_columns(self.columns, [s.path for s in data.scenes if not s.path.is_dir()])
        return data


@dataclass(frozen=True)
class S3DISArguments(CloudArguments):
    """Convert S3DIS as it is released into Pointcept's layout, with normals and planes.

    To keep only large planes, pass --min-area 0.5.

    Examples:
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --dry-run
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --workers 4 --superpoints
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --areas 5 --pages pages
    """

    areas: tuple[int, ...] = ()
    """Numbers of the areas. Default: those that are there."""
    class_order: Literal["pointcept", "spt"] = "pointcept"
    """Meaning of the numbers in segment.npy. Other layouts have the order pointcept."""

    def data(self, root: Path) -> SceneDataset:
        """Return the rooms of the areas."""
        require("pyarrow", extra="text", purpose="read S3DIS")
        return S3DIS(root, self.areas or find_areas(root), class_order=self.class_order)


@dataclass(frozen=True)
class ScanNetArguments(CloudArguments):
    """Convert ScanNet or ScanNet++ as released into Pointcept's layout, with normals and planes.

    Points are the vertices of the meshes. Results are in OUT/train, val and test, by the lists of
    the data set in ROOT, ROOT/splits or ROOT/meta_data. segment200 needs the table
    scannetv2-labels.combined.tsv there; labels of ScanNet++ need its metadata.

    Examples:
        torchrg convert scannet scannet out --dry-run
        torchrg convert scannet scannet out --workers 4 --superpoints
        torchrg convert scannet scannet out --layout mmdet3d
    """

    def data(self, root: Path) -> SceneDataset:
        """Return the scans."""
        return ScanNet(root)


@dataclass(frozen=True)
class RGBDArguments(Arguments):
    """Convert depth frames: normals, curvature and plane labels as images, a table of planes.

    Examples:
        torchrg convert rgbd frames results --intrinsics 525,525,319.5,239.5 --depth-scale 1000
        torchrg convert rgbd capture results
    """

    layout: Literal["auto", _Benchmark, _Capture, "images"] = "auto"
    """Data set whose folders ROOT has, auto for what its files show; nerfstudio is transforms.json,
    as of Polycam and COLMAP; images are all depth images below ROOT, of one camera."""
    intrinsics: flags.IntrinsicsFlag = None
    depth_scale: flags.DepthScaleFlag = None
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """How planes are found in depth images."""
    orient: flags.ImageOrientFlag = "auto"
    unit: ClassVar[str] = "frame"
    seconds_per_million: ClassVar[tuple[float, str]] = (0.4, "pixels")
    """As that of clouds, by the 0.12 s of a frame of 640 x 480 pixels (``scripts/bench.py
    steady``)."""

    def source(self, root: Path) -> Source:
        """Return the frames."""
        camera = flags.parse_intrinsics(self.intrinsics)
        layout = find_layout(root) if self.layout == "auto" else self.layout
        options = (layout, camera, self.depth_scale, self.orient)
        return RGBDSource(root, self.depth, *options, table=self.table)


KINDS: dict[str, type[Arguments]] = {
    "s3dis": S3DISArguments,
    "folder": FolderArguments,
    "scannet": ScanNetArguments,
    "rgbd": RGBDArguments,
}
"""Arguments by the name of the kind of data set."""

OVERVIEW = f"""usage: torchrg convert {{{",".join(KINDS)}}} ROOT OUT ...

Normals, curvature and plane labels of every scan of a data set.

  s3dis    the rooms of S3DIS as released, into Pointcept's layout
  folder   every cloud below a folder
  scannet  the scans of ScanNet or ScanNet++ as released, into Pointcept's layout
  rgbd     depth frames: captures of phones, folders of public data sets, or any images

Superpoints where other programs look for them: --layout.

torchrg convert s3dis --help says more."""


def run(argv: list[str]) -> int:
    """Parse the arguments, check the plan, convert, and report."""
    if not argv or argv[0] in ("-h", "--help"):
        print(OVERVIEW)
        raise SystemExit(0 if argv else USAGE_ERROR)
    kind, *rest = flags.spell_counts(argv)
    if kind not in KINDS:
        raise ConfigError(f"expected a kind of data set ({', '.join(KINDS)}), got {kind!r}.")
    chosen, start = KINDS[kind], {}
    if issubclass(chosen, CloudArguments):
        start["settings"] = flags.PlaneSettings.asked_for(rest)
    arguments = parse(chosen, rest, prog=f"torchrg convert {kind}", default=start)
    _check(arguments)
    root, out = arguments.root.resolve(), arguments.out.resolve()
    with warnings_as_lines():
        scans = list_jobs(arguments.source(root), out)
    jobs = match_jobs(scans, arguments.only)
    if arguments.dry_run:
        plan, stale = _look_at(jobs, arguments), _find_stale(scans, arguments)
        resources = (arguments.workers or num_cores(), _memory_limit(arguments), free_space(out))
        print(format_plan(plan))
        for result in stale:
            if result.files and (result.scan is not None or arguments.prune):
                say(f"remove {result.name}: {result.reason}")
        print(format_costs(plan, *resources, arguments.seconds_per_million))
        check_stale(stale, root, prune=arguments.prune)
        check_room(plan)
        return 0
    make_folder(out)
    check_place(out / REPORT)
    pages = _pages_of(arguments)
    if pages is not None:
        make_folder(pages)
        check_gallery(pages, [job.name for job in jobs])
    with lock_folder(out):
        remove_leftovers(out, mark_of(REPORT))
        stale = _find_stale(scans, arguments)
        check_stale(stale, root, prune=arguments.prune)
        plan = _look_at(jobs, arguments)
        check_room(plan)
        _remove_stale(stale, scans)
        return _convert(plan, out, arguments)


def _check(arguments: Arguments) -> None:
    """Refuse values that are out of range, or do not go together."""
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    flags.bytes_of_limit(arguments.limit_memory)
    table = arguments.table or PLANES_FILE
    if Path(table).name != table or Path(table).suffix not in TABLE_SUFFIXES or table == RECORD:
        raise ConfigError(
            "expected --table to be the name of a .csv or .json file in the folder of each scan, "
            f"got {table}; use planes.csv."
        )
    if arguments.ray_address is not None and arguments.engine != "ray":
        raise ConfigError("expected --ray-address together with --engine ray, got none; add it.")
    if _pages_of(arguments) is not None:
        check_library()
    if isinstance(arguments, CloudArguments):
        flags.check_level(arguments.level, arguments.partition)
        if arguments.orient == "viewpoint" and not isinstance(arguments, FolderArguments):
            raise ConfigError(
                "expected --orient auto, interior, up or none, as this data set names no places of "
                "scanners, got viewpoint; use auto."
            )
        has_superpoints = arguments.superpoints or arguments.layout != "pointcept"
        usual = (SuperpointsConfig(), 0)
        if not has_superpoints and (arguments.partition, arguments.level) != usual:
            raise ConfigError(
                "expected --superpoints with --partition or --level, got none; add it."
            )
        if arguments.pages is not None and arguments.layout != "pointcept":
            raise ConfigError(
                "expected --pages with --layout pointcept, which pages are made of, got "
                f"{arguments.layout}; leave one of them out."
            )


def _pages_of(arguments: Arguments) -> Path | None:
    """Return the directory for pages, None where none are wanted."""
    return arguments.pages if isinstance(arguments, CloudArguments) else None


def _look_at(jobs: list[Job], arguments: Arguments) -> Plan:
    """Find out what is to be done, with a progress bar where files are many."""
    with tqdm(total=len(jobs), desc="looking", unit="scan", leave=False, disable=None) as bar:
        return make_plan(jobs, force=arguments.force, threads=num_cores(), on_scan=bar.update)


def _find_stale(scans: list[Job], arguments: Arguments) -> list[StaleResult]:
    """Return the stale results; with --only, those of scans that are gone stay as they are."""
    is_whole = arguments.only is None or arguments.prune
    return [result for result in find_stale(scans) if is_whole or result.scan is not None]


def _remove_stale(stale: list[StaleResult], scans: list[Job]) -> None:
    """Take stale results off the lists and remove them, and note the scans of the data set."""
    source, out = scans[0].source, scans[0].out
    paths = {path for result in stale for path in result.paths}
    if paths:
        source.write_lists(out, mark_of(REPORT), without=paths)
    for result in stale:
        remove_stale(result)
        if result.files:
            say(f"{result.folder}: removed, as {result.reason}")
    note_data_set(scans, stale)


def _convert(plan: Plan, out: Path, arguments: Arguments) -> int:
    """Convert the scans of a plan, print what became of them, and return the exit code."""
    jobs, workers, limit = plan.to_convert, arguments.workers, _memory_limit(arguments)
    for job in jobs:
        if job.memory > limit:
            warn(
                f"{job.name}: about {job.scan.num_points:,} points may need more memory than "
                f"{limit / 1e9:.1f} GB; it runs alone."
            )
    if arguments.engine == "local":
        workers = min(workers or num_cores(), max(len(jobs), 1))
        reports: Reports = run_local(jobs, workers=workers, memory_limit=limit)
    else:
        from torchrg.batch.ray_tasks import run_ray

        reports = run_ray(jobs, workers=workers, memory_limit=limit, address=arguments.ray_address)
    unit = "frame" if arguments.unit == "frame" else "pt"
    sizes = {job.name: 1 if unit == "frame" else job.scan.num_points for job in jobs}
    total = sum(sizes.values())
    # The mean of the whole run: scans end rarely, and a recent rate would jump with each.
    with tqdm(total=total, unit=unit, unit_scale=True, smoothing=0, disable=None) as bar:
        shown = Progress(bar, sizes, unit=arguments.unit)
        report = run_plan(plan, reports, engine=arguments.engine, workers=workers, on_report=shown)
    code = _finish(report, out, unit=arguments.unit)
    if not report.disk_full:
        plan.jobs[0].source.write_lists(out, mark_of(REPORT))
    pages = _pages_of(arguments)
    if pages is not None and not report.interrupted:
        _draw_pages(plan, report, pages)
    return code


def _memory_limit(arguments: Arguments) -> int:
    """Return the bytes that all scans at a time may take."""
    return flags.bytes_of_limit(arguments.limit_memory, spare_memory())


def _draw_pages(plan: Plan, report: BatchReport, folder: Path) -> None:
    """Write picture and page of each scan that is done, and the index of all of them."""
    done = {scan.name: scan for scan in report.complete}
    jobs = [job for job in plan.jobs if job.name in done]
    entries = []
    for job in tqdm(jobs, desc="pages", unit="scan", leave=False, disable=None):
        scan = done[job.name]
        words = f"{scan.num_points:,} points, {scan.num_regions:,} planes"
        try:
            entries.append(draw_entry(folder, scan.name, read_result(job.folder), words=words))
        except (TorchrgError, OSError) as error:
            warn(f"{scan.name}: no page: {error}")
    say(f"pages -> {write_index(folder, plan.jobs[0].source.root.name, entries)}")


def _finish(report: BatchReport, out: Path, *, unit: str) -> int:
    """Write and print the report, and return the exit code."""
    if report.with_status("kept") == list(report.scans):
        print("nothing to do")
    else:
        print(format_report(report, unit=unit))
    for scan in report.scans:
        tell_failure(scan)
    try:
        write_report(out, report)
    except FormatError as error:
        if not report.disk_full:
            raise
        warn(str(error))
    state = f"{len(report.complete):,} of {len(report.scans):,} scans are complete"
    again = "The same command goes on from here."
    if report.disk_full:
        return fail(f"{out}: the disk is full; {state}. Make room. {again}", code=SOME_FAILED)
    if report.interrupted:
        return fail(f"interrupted; {state}. {again}", code=INTERRUPTED)
    if len(report.complete) < len(report.scans):
        return fail(f"{state}, {out / REPORT} says more.", code=SOME_FAILED)
    say(f"{state} -> {out}")
    return 0
