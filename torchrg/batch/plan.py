"""What a batch will do, found out and checked before the first scan."""

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from torchrg.batch.memory import memory_of_scan
from torchrg.batch.records import reason_to_convert
from torchrg.batch.scans import Job, Source
from torchrg.errors import ConfigError, FormatError


class Plan(NamedTuple):
    """The scans of a batch.

    Attributes:
        jobs: All that were asked for, in natural order.
        reasons: Why each is to be converted, by name; a scan that is done is not among them.
    """

    jobs: tuple[Job, ...]
    reasons: dict[str, str]

    @property
    def to_convert(self) -> list[Job]:
        """The jobs that are not done."""
        return [job for job in self.jobs if job.scan.name in self.reasons]

    @property
    def done(self) -> list[Job]:
        """The jobs that are."""
        return [job for job in self.jobs if job.scan.name not in self.reasons]


def list_jobs(source: Source, out: Path, *, only: str | None = None) -> list[Job]:
    """Return a job for each scan of a source.

    Args:
        source: The data set.
        out: Where results go.
        only: Pattern of the names to convert, as in a shell; ``*`` matches slashes too.

    Returns:
        The jobs in natural order.

    Raises:
        ConfigError: If no name matches the pattern, or results would go in among the scans.
        FormatError: If the source has no scans.
    """
    if source.root in out.parents or (source.root == out and not source.in_place):
        raise ConfigError(
            f"{out}: expected a directory outside {source.root}, so that no result is read as a "
            "scan; choose another."
        )
    scans = source.list_scans()
    chosen = [scan for scan in scans if only is None or fnmatchcase(scan.name, only)]
    if not chosen:
        names = ", ".join(scan.name for scan in scans[:5])
        more = f" and {len(scans) - 5:,} more" if len(scans) > 5 else ""
        raise ConfigError(f"expected --only to match a scan, got {only!r}; they are {names}{more}.")
    return [Job(source, scan, out) for scan in chosen]


def make_plan(
    jobs: list[Job],
    *,
    force: bool = False,
    threads: int = 1,
    on_scan: Callable[[], object] = lambda: None,
) -> Plan:
    """Find out which scans are to be converted.

    A scan is done if its record says what would be done now, from the same bytes, and its results
    have not changed since: files are read to see, those of scans without a record are not.

    Args:
        jobs: The scans.
        force: Whether to convert those that are done too.
        threads: Scans looked at at a time.
        on_scan: Called when one has been looked at.
    """

    def look(job: Job) -> str:
        reason = "forced" if force else reason_to_convert(job)
        on_scan()
        return reason

    with ThreadPoolExecutor(threads) as pool:
        reasons = list(pool.map(look, jobs))
    named = {job.scan.name: reason for job, reason in zip(jobs, reasons, strict=True) if reason}
    return Plan(tuple(jobs), named)


def check_space(plan: Plan) -> None:
    """Check that the disk has room for the results, by the estimates of the scans.

    Raises:
        FormatError: If it has not.
    """
    if not plan.to_convert:
        return
    source, out = plan.jobs[0].source, plan.jobs[0].out
    needed = source.bytes_per_point * sum(job.scan.num_points for job in plan.to_convert)
    existing = next(place for place in (out, *out.absolute().parents) if place.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise FormatError(
            f"{out}: expected about {needed / 1e6:,.1f} MB of free disk for "
            f"{len(plan.to_convert):,} scans, got {free / 1e6:,.1f} MB; make room, choose another "
            "directory, or convert fewer with --only."
        )


def too_large(plan: Plan, limit: int) -> list[Job]:
    """Return the jobs that need more memory than a limit by themselves."""
    return [job for job in plan.to_convert if memory_of_scan(job.scan.num_points) > limit]
