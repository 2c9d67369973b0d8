"""``torchrg convert``: a whole data set, scan by scan, on one machine or on a Ray cluster."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tqdm import tqdm

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
    run_plan,
    write_report,
)
from torchrg.batch.scans import Job, Source, mark_of
from torchrg.batch.sources import (
    CloudSource,
    FolderSource,
    RGBDSource,
    S3DISSource,
    ScanNetSource,
    find_areas,
)
from torchrg.batch.task import Reports, TaskReport
from torchrg.cli import console
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import INTERRUPTED, SOME_FAILED, fail
from torchrg.cli.loop import Progress, tell_failure
from torchrg.config import DEFAULT_PRESET, DepthConfig, SuperpointsConfig
from torchrg.errors import ConfigError, FormatError, TorchrgError
from torchrg.io import FORMATS
from torchrg.io.files import check_place, free_space, make_folder
from torchrg.render.gallery import check_gallery, draw_entry, write_index
from torchrg.render.page import check_library
from torchrg.result import read_result

MOST_ROWS = 300
"""Most scans of a batch that is printed scan by scan."""


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
    only: str | None = None
    """Pattern for the names of the scans to convert, as in a shell: "Area_5/*"."""
    force: bool = False
    """Convert what is done already, too."""
    dry_run: bool = False
    """Say what would be done and why, and write nothing."""
    unit: ClassVar[str] = "scan"
    """What one of them is called."""
    seconds_per_million: ClassVar[tuple[float, str]] = (33.0, "points, as consensus takes")
    """Time of one core of an Intel Xeon for a million points, and what it is the time of: the table
    of README.md that ``scripts/bench.py steady`` measures. There ``classic`` takes a third of it,
    and ``paper`` half as much again."""

    def source(self, root: Path, out: Path) -> Source:
        """Return the data set, both paths absolute."""
        raise NotImplementedError


@dataclass(frozen=True)
class CloudArguments(Arguments):
    """What data sets of clouds have beside."""

    pages: Path | None = None
    """Directory for a picture and a page of each scan that is done, and for index.html, in which
    the pictures are links to the pages (pip install 'torchrg[view]'). Default: none are made."""
    superpoint: bool = False
    """Write superpoints too: a partition of all points, for networks on them. Numbers say how many
    in each level: --superpoint 1000,300."""
    orient: console.OrientFlag = "auto"
    level: int = 0
    """Level of the superpoints that is written; 0 is the finest."""
    layout: console.Layout = "pointcept"
    """Files that are written: a folder for each scan (pointcept), bare arrays (npy), or superpoints
    with points, classes and objects where other programs look for them. These are OneFormer3D,
    UniDet3D and ESAM (mmdet3d), SPFormer (spformer), ISBNet, Open3DIS and SphericalMask (isbnet),
    Mask3D (mask3d), and SAI3D and the preprocessing of others (scannet). The last writes segs.json
    and, of annotated scans, aggregation.json, to replace those of ScanNet; superpoints end at
    objects there. S3DIS has neither scannet nor spformer, ScanNet++ no other with classes."""
    partition: SuperpointsConfig = dataclasses.field(default_factory=SuperpointsConfig)
    settings: console.SettingsFlags = dataclasses.field(default_factory=console.PlaneSettings)
    usual_preset: ClassVar[str] = DEFAULT_PRESET
    """Settings to start from where no flag names any."""

    @property
    def output(self) -> dict[str, Any]:
        """What is written of each cloud, as sources take it."""
        names = ("superpoint", "layout", "partition", "level", "orient")
        return {name: getattr(self, name) for name in names}


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

    columns: console.ColumnsFlag = None
    suffixes: tuple[str, ...] = tuple(FORMATS)
    """Suffixes of the files that are clouds, by default all that torchrg segment reads. Name fewer
    where two files differ in the suffix alone."""

    def source(self, root: Path, out: Path) -> Source:
        """Return the folder."""
        names = console.ColumnNames.parse(self.columns, None).names
        return FolderSource(
            root,
            self.settings.resolved,
            out,
            columns=names,
            suffixes=self.suffixes,
            **self.output,
        )


@dataclass(frozen=True)
class S3DISArguments(CloudArguments):
    """Convert S3DIS as it is released into Pointcept's layout, with normals and planes.

    Settings are those of the preset s3dis unless told otherwise.

    Examples:
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --dry-run
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --workers 4 --superpoint
        torchrg convert s3dis Stanford3dDataset_v1.2 s3dis --areas 5 --pages pages
    """

    areas: tuple[int, ...] = ()
    """Numbers of the areas. Default: those that are there."""
    class_order: Literal["pointcept", "spt"] = "pointcept"
    """What the numbers in segment.npy mean. Other layouts have the order pointcept."""
    usual_preset: ClassVar[str] = "s3dis"

    def source(self, root: Path, out: Path) -> Source:
        """Return the rooms of the areas."""
        areas = self.areas or find_areas(root)
        return S3DISSource(root, self.settings.resolved, areas, self.class_order, **self.output)


@dataclass(frozen=True)
class ScanNetArguments(CloudArguments):
    """Convert ScanNet or ScanNet++ as released into Pointcept's layout, with normals and planes.

    Points are the vertices of the meshes. Results are in OUT/train, val and test, by the lists of
    the data set in ROOT, ROOT/splits or ROOT/meta_data. segment200 needs the table
    scannetv2-labels.combined.tsv there; labels of ScanNet++ need its metadata. Settings are those
    of the preset scannet unless told otherwise.

    Examples:
        torchrg convert scannet scannet out --dry-run
        torchrg convert scannet scannet out --workers 4 --superpoint
        torchrg convert scannet scannet out --layout mmdet3d
    """

    usual_preset: ClassVar[str] = "scannet"

    def source(self, root: Path, out: Path) -> Source:
        """Return the scans."""
        return ScanNetSource(root, self.settings.resolved, **self.output)


@dataclass(frozen=True)
class RGBDArguments(Arguments):
    """Convert depth frames: normals, curvature and plane labels as images, a table of planes.

    Examples:
        torchrg convert rgbd frames results --intrinsics 525,525,319.5,239.5 --depth-scale 1000
        torchrg convert rgbd rgbd_dataset_freiburg1_xyz results --layout tum
    """

    layout: Literal["tum", "icl-nuim", "scannet", "7-scenes", "images"] = "images"
    """Data set whose folders ROOT has; images are all .png and .npy below it, of one camera."""
    intrinsics: str | None = None
    """Camera, as fx,fy,cx,cy in pixels. Default: that of the layout; images have none."""
    depth_scale: float | None = None
    """Stored value of one metre. Default: that of the layout; images have none."""
    depth: DepthConfig = dataclasses.field(default_factory=DepthConfig)
    """How planes are found in depth images."""
    orient: console.ImageOrientFlag = "auto"
    unit: ClassVar[str] = "frame"
    seconds_per_million: ClassVar[tuple[float, str]] = (3.0, "pixels")
    """As that of clouds, by the 0.9 s of a frame of 640 x 480 pixels in README.md."""

    def source(self, root: Path, out: Path) -> Source:
        """Return the frames."""
        intrinsics = None if self.intrinsics is None else console.parse_intrinsics(self.intrinsics)
        return RGBDSource(
            *(root, self.depth, self.layout, intrinsics, self.depth_scale),
            orient=self.orient,
        )


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
  rgbd     depth frames, in the folders of TUM, ICL-NUIM, ScanNet, 7-Scenes, or any

Superpoints where other programs look for them: --layout.

torchrg convert s3dis --help says more."""


def run(argv: list[str]) -> int:
    """Parse the arguments, check the plan, convert, and report."""
    if not argv or argv[0] in ("-h", "--help"):
        print(OVERVIEW)
        raise SystemExit(0 if argv else console.USAGE_ERROR)
    kind, *rest = console.spell_counts(argv, "--superpoint")
    if kind not in KINDS:
        raise ConfigError(f"expected a kind of data set ({', '.join(KINDS)}), got {kind!r}.")
    chosen, start = KINDS[kind], {}
    if issubclass(chosen, CloudArguments):
        start["settings"] = console.PlaneSettings.asked_for(rest, chosen.usual_preset)
    arguments = parse(chosen, rest, prog=f"torchrg convert {kind}", default=start)
    _check(arguments)
    root, out = arguments.root.resolve(), arguments.out.resolve()
    with console.warnings_as_lines():
        source = arguments.source(root, out)
        jobs = list_jobs(source, out, only=arguments.only)
    if isinstance(source, CloudSource):
        source.check_lists(out)
    if arguments.dry_run:
        plan = _look_at(jobs, arguments)
        print(format_plan(plan), _say_costs(plan, out, arguments), sep="\n")
        check_room(plan)
        return 0
    make_folder(out)
    check_place(out / REPORT)
    pages = _pages_of(arguments)
    if pages is not None:
        make_folder(pages)
        check_gallery(pages, [job.name for job in jobs])
    with lock_folder(out):
        return _convert(_look_at(jobs, arguments), out, arguments)


def _check(arguments: Arguments) -> None:
    """Refuse values that are out of range, or do not go together."""
    if arguments.workers is not None and arguments.workers < 1:
        raise ConfigError(f"expected --workers >= 1, got {arguments.workers}.")
    console.check_memory(arguments.limit_memory)
    if arguments.ray_address is not None and arguments.engine != "ray":
        raise ConfigError("expected --ray-address together with --engine ray.")
    if _pages_of(arguments) is not None:
        check_library()
    if isinstance(arguments, CloudArguments):
        console.check_level(arguments.level, arguments.partition)
        if arguments.orient == "viewpoint" and not isinstance(arguments, FolderArguments):
            raise ConfigError(
                "expected --orient auto, interior, up or none, as this data set names no places of "
                "scanners, got viewpoint; use auto."
            )
        has_superpoints = arguments.superpoint or arguments.layout != "pointcept"
        usual = (SuperpointsConfig(), 0)
        if not has_superpoints and (arguments.partition, arguments.level) != usual:
            raise ConfigError("expected --superpoint with --partition or --level; add it.")
        if arguments.pages is not None and arguments.layout != "pointcept":
            raise ConfigError("expected --pages with --layout pointcept, which pages are made of.")


def _pages_of(arguments: Arguments) -> Path | None:
    """Return the directory for pages, None where none are wanted."""
    return arguments.pages if isinstance(arguments, CloudArguments) else None


def _look_at(jobs: list[Job], arguments: Arguments) -> Plan:
    """Find out what is to be done, with a progress bar where files are many."""
    with tqdm(total=len(jobs), desc="looking", unit="scan", leave=False, disable=None) as bar:
        return make_plan(jobs, force=arguments.force, threads=num_cores(), on_scan=bar.update)


def _convert(plan: Plan, out: Path, arguments: Arguments) -> int:
    """Convert the scans of a plan, print what became of them, and return the exit code."""
    check_room(plan)
    jobs, (workers, limit) = plan.to_convert, _workers_and_memory(arguments)
    for job in jobs:
        if job.memory > limit:
            console.warn(
                f"{job.name}: about {job.scan.num_points:,} points may need more memory than "
                f"{limit / 1e9:.1f} GB; it runs alone."
            )
    if arguments.engine == "local":
        workers = min(workers or num_cores(), max(len(jobs), 1))
        reports: Reports = run_local(jobs, workers=workers, memory_limit=limit)
    else:
        from torchrg.batch.ray_tasks import run_ray

        reports = run_ray(jobs, workers=workers, memory_limit=limit, address=arguments.ray_address)
    by_frames = arguments.unit == "frame"
    sizes = {job.name: 1 if by_frames else job.scan.num_points for job in jobs}
    bar_unit, total = "frame" if by_frames else "pt", sum(sizes.values())
    # The mean of the whole run: scans end rarely, and a recent rate would jump with each.
    with tqdm(total=total, unit=bar_unit, unit_scale=True, smoothing=0, disable=None) as bar:
        shown = Progress(bar, sizes, unit=arguments.unit)
        report = run_plan(plan, reports, engine=arguments.engine, workers=workers, on_report=shown)
    code = _finish(report, out, unit=arguments.unit)
    if isinstance(source := plan.jobs[0].source, CloudSource) and not report.disk_full:
        source.write_lists(out, mark_of(REPORT))
    pages = _pages_of(arguments)
    if pages is not None and not report.interrupted:
        _draw_pages(plan, report, pages)
    return code


def _draw_pages(plan: Plan, report: BatchReport, folder: Path) -> None:
    """Write picture and page of each scan that is done, and the index of all of them."""
    done = {scan.name: scan for scan in report.scans if scan.status in ("converted", "kept")}
    jobs = [job for job in plan.jobs if job.name in done]
    entries = []
    for job in tqdm(jobs, desc="pages", unit="scan", leave=False, disable=None):
        name = job.name
        words = f"{done[name].num_points:,} points, {done[name].num_regions:,} planes"
        try:
            entries.append(draw_entry(folder, name, read_result(job.folder), words=words))
        except (TorchrgError, OSError) as error:
            console.warn(f"{name}: no page: {error}")
    console.say(f"pages -> {write_index(folder, plan.jobs[0].source.root.name, entries)}")


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
        console.warn(str(error))
    state = f"{len(report.complete):,} of {len(report.scans):,} scans are complete"
    again = "The same command goes on from here."
    if report.disk_full:
        told = f"{out}: the disk is full; {state}. Make room. {again}"
        return fail(told, code=SOME_FAILED)
    if report.interrupted:
        return fail(f"interrupted; {state}. {again}", code=INTERRUPTED)
    if len(report.complete) < len(report.scans):
        told = f"{state}, {out / REPORT} says more."
        return fail(told, code=SOME_FAILED)
    console.say(f"{state} -> {out}")
    return 0


def format_plan(plan: Plan) -> str:
    """Return what a plan would do: a row for each scan that is to be converted."""
    sums = f"{len(plan.to_convert):,} scans to convert, {len(plan.done):,} done"
    if not plan.to_convert:
        return sums
    rows = [
        [job.name, plan.reasons[job.name], f"{job.scan.num_points:,}"] for job in plan.to_convert
    ]
    return "\n".join([console.format_table(["scan", "why", "points (about)"], rows), sums])


def _say_costs(plan: Plan, out: Path, arguments: Arguments) -> str:
    """Return what a plan would take, in words, or that there is nothing to do."""
    jobs = plan.to_convert
    if not jobs:
        return "nothing to do"
    workers, limit = _workers_and_memory(arguments)
    workers, memory, at_once = workers or num_cores(), 0, 0
    for needed in sorted((job.memory for job in jobs), reverse=True)[:workers]:
        if at_once and memory + needed > limit:
            break
        memory, at_once = memory + needed, at_once + 1
    source, num_points = jobs[0].source, sum(job.scan.num_points for job in jobs)
    cost, of_what = arguments.seconds_per_million
    hours = cost * num_points / 1e6 / 3600
    return (
        f"disk: about {source.bytes_per_point * num_points / 1e9:,.3f} GB of "
        f"{free_space(out) / 1e9:,.1f} that are free\n"
        f"memory: about {memory / 1e9:,.1f} GB for {at_once} at a time, within {limit / 1e9:,.1f}\n"
        f"time: about {hours / at_once:,.2f} hours, at {cost:g} s of a core for a million {of_what}"
    )


def _workers_and_memory(arguments: Arguments) -> tuple[int | None, int]:
    """Return how many scans may run at a time, and the bytes that they may take."""
    given = arguments.limit_memory
    return arguments.workers, spare_memory() if given is None else int(given * 1e9)


def format_report(report: BatchReport, *, unit: str = "scan") -> str:
    """Return a report as text: a row for each scan, notes below, then the sums.

    With more than :data:`MOST_ROWS` scans, only failures have a row. ``unit`` is what a scan is
    called where its number in a second counts.
    """
    stages = list(report.stage_seconds)
    shown = report.scans if len(report.scans) <= MOST_ROWS else report.with_status("failed")
    head = ["scan", "status", "points", "planes", *stages, "GB"]
    rows = [_row(scan, stages) for scan in shown]
    totals = report.with_status("converted")
    rows.append(
        [
            "all",
            f"{len(totals)} converted",
            f"{report.num_points:,}",
            f"{sum(scan.num_regions for scan in totals):,}",
            *(f"{seconds:.1f}" for seconds in report.stage_seconds.values()),
            f"{max((scan.peak_memory for scan in totals), default=0) / 1e9:.2f}",
        ]
    )
    notes = [
        console.printable(f"{scan.name}: {note}")
        for scan in shown
        for note in (
            *(f"repaired: {text}" for text in scan.repairs),
            *scan.warnings,
            *([f"done at attempt {scan.attempts}"] if scan.attempts > 1 else []),
        )
        if scan.status != "failed"
    ]
    points, scans = (
        number / report.seconds if report.seconds else 0.0
        for number in (report.num_points, len(totals))
    )
    speed = (
        f"{report.num_points:,} points in {report.seconds:,.1f} s: {points:,.0f} points, "
        f"{scans:,.2f} {unit}s a second"
    )
    return "\n".join([console.format_table(head, rows), *notes, speed])


def _row(scan: TaskReport, stages: Sequence[str]) -> list[str]:
    """Return the cells of a scan."""
    points = f"{scan.num_points:,}" if scan.num_points else ""
    return [
        scan.name,
        scan.status,
        points,
        f"{scan.num_regions:,}" if points else "",
        *(f"{scan.seconds[stage]:.1f}" if stage in scan.seconds else "" for stage in stages),
        f"{scan.peak_memory / 1e9:.2f}" if scan.peak_memory else "",
    ]
