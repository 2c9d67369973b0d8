"""``torchrg convert``: a whole data set, scan by scan, on one machine or on a Ray cluster."""

import os
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from tqdm import tqdm

from torchrg.batch.convert import ScanReport
from torchrg.batch.local import run_local
from torchrg.batch.lock import DirectoryLock
from torchrg.batch.memory import SHARE, available_memory
from torchrg.batch.plan import Plan, check_space, list_jobs, make_plan, too_large
from torchrg.batch.report import format_plan, format_report
from torchrg.batch.run import REPORT, Ending, Reports, run_plan, write_report
from torchrg.batch.scans import Job
from torchrg.cli.console import (
    INTERRUPTED,
    SOME_FAILED,
    fail,
    parse,
    warn,
)
from torchrg.cli.convert_arguments import (
    KINDS,
    Arguments,
    build_source,
    check_arguments,
    starting_point,
)
from torchrg.errors import ConfigError, FormatError

OVERVIEW = f"""usage: torchrg convert {{{",".join(KINDS)}}} ROOT OUT ...

Normals, curvature and plane labels of every scan of a data set.

  s3dis   the rooms of S3DIS as released, into Pointcept's layout
  folder  every cloud below a folder
  rgbd    depth frames, in the folders of TUM, ICL-NUIM, ScanNet, 7-Scenes, or any

torchrg convert s3dis --help says more."""


def run(argv: list[str]) -> int:
    """Parse the arguments, check the plan, convert, and report."""
    if not argv or argv[0] in ("-h", "--help"):
        print(OVERVIEW)
        raise SystemExit(0)
    kind, *rest = argv
    if kind not in KINDS:
        raise ConfigError(f"expected a kind of data set ({', '.join(KINDS)}), got {kind!r}.")
    start = starting_point(kind, rest)
    arguments = parse(KINDS[kind], rest, prog=f"torchrg convert {kind}", default=start)
    check_arguments(arguments)
    out = arguments.out.resolve()
    with _warnings_as_lines():
        jobs = list_jobs(build_source(arguments), out, only=arguments.only)
    if arguments.dry_run:
        print(format_plan(_look_at(jobs, arguments)))
        return 0
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"{out}: cannot be made: {error.strerror or error}.") from error
    with DirectoryLock(out) as lock, _terminate_as_interrupt():
        return _convert(_look_at(jobs, arguments), out, arguments, lock)


def _look_at(jobs: list[Job], arguments: Arguments) -> Plan:
    """Find out what is to be done, with a progress bar where files are many."""
    with tqdm(total=len(jobs), desc="looking", unit="scan", leave=False, disable=None) as bar:
        return make_plan(jobs, force=arguments.force, threads=_num_cores(), on_scan=bar.update)


def _convert(plan: Plan, out: Path, arguments: Arguments, lock: DirectoryLock) -> int:
    """Convert the scans of a plan, print what became of them, and return the exit code."""
    check_space(plan)
    limit = int(SHARE * available_memory())
    if arguments.limit_memory is not None:
        limit = int(arguments.limit_memory * 1e9)
    for job in too_large(plan, limit):
        warn(
            f"{job.scan.name}: about {job.scan.num_points:,} points may need more memory than "
            f"{limit / 1e9:.1f} GB; it runs alone."
        )
    jobs, workers = plan.to_convert, arguments.workers
    if arguments.engine == "local":
        workers = min(workers or _num_cores(), max(len(jobs), 1))
        reports: Reports = run_local(jobs, workers=workers, memory_limit=limit, lock=lock)
    else:
        from torchrg.batch.ray_tasks import run_ray

        reports = run_ray(jobs, workers=workers, memory_limit=limit, address=arguments.ray_address)
    total = sum(job.scan.num_points for job in jobs)
    # The mean of the whole run: scans end rarely, and a recent rate would jump with each.
    with tqdm(total=total, unit="pt", unit_scale=True, smoothing=0, disable=None) as bar:
        progress = _Progress(bar, plan)
        ending = run_plan(
            plan, reports, engine=arguments.engine, workers=workers, on_report=progress
        )
    return _finish(ending, out)


class _Progress:
    """A progress bar that moves by points and counts scans."""

    def __init__(self, bar: "tqdm[NoReturn]", plan: Plan) -> None:
        self.bar = bar
        self.sizes = {job.scan.name: job.scan.num_points for job in plan.to_convert}
        self.num_done = self.num_failed = 0

    def __call__(self, report: ScanReport | None) -> None:
        """Take a report, or only show that time passes."""
        if report is not None:
            self.num_done += 1
            self.num_failed += report.status == "failed"
            self.bar.update(self.sizes[report.name])
        failed = f", {self.num_failed} failed" if self.num_failed else ""
        self.bar.set_description_str(f"{self.num_done}/{len(self.sizes)} scans{failed}")


def _finish(ending: Ending, out: Path) -> int:
    """Write and print the report, and return the exit code."""
    report = ending.report
    print(format_report(report))
    for scan in report.with_status("failed"):
        fail(f"{scan.name}: {scan.reason}")
    num_done = len(report.with_status("converted")) + len(report.with_status("kept"))
    state = f"{num_done:,} of {len(report.scans):,} scans are complete"
    try:
        write_report(out, report)
    except FormatError as error:
        if not ending.disk_full:
            raise
        warn(str(error))
    if ending.disk_full:
        return fail(
            f"{out}: the disk is full; {state}. Make room, and the same command goes on from here.",
            code=SOME_FAILED,
        )
    if ending.interrupted:
        return fail(f"interrupted; {state}. The same command goes on from here.", code=INTERRUPTED)
    if num_done < len(report.scans):
        return fail(f"{state}, {out / REPORT} says more.", code=SOME_FAILED)
    print(f"{state} -> {out}")
    return 0


def _num_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Print warnings as single lines."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    for warning in caught:
        warn(str(warning.message))


@contextmanager
def _terminate_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, which batch systems send, end the command as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
