"""Convert one scan: the task that batches are made of."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrg.batch.memory import memory_of_scan
from torchrg.batch.records import (
    RECORD,
    check_record,
    describe_work,
    is_unchanged,
    read_record,
    write_record,
)
from torchrg.batch.scans import Scan, Source
from torchrg.batch.task import Converted, TaskReport, report_on
from torchrg.io.files import check_place, make_mark, marked_parts, remove_leftovers, sync_folder


@dataclass(frozen=True)
class Job:
    """The task of converting one scan.

    Attributes:
        source: The data set.
        scan: One of its scans.
        out: Where results go.
        mark: Of the names that results are written under before they have their own; see
            :func:`torchrg.io.files.marked_parts`. What a killed process leaves is removed by those
            who know it.
    """

    source: Source
    scan: Scan
    out: Path
    mark: str = field(default_factory=make_mark, compare=False)

    @property
    def name(self) -> str:
        """The name of the scan."""
        return self.scan.name

    @property
    def memory(self) -> int:
        """What the scan takes at once."""
        return memory_of_scan(self.scan.num_points)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files of the scan."""
        return self.scan.inputs

    @property
    def folder(self) -> Path:
        """Where the results of the scan go."""
        return self.out / self.scan.name

    @property
    def record(self) -> Path:
        """Where the record of the results goes."""
        return self.folder / RECORD

    def place_of(self, name: str) -> Path:
        """Return where a result is that a record names."""
        return self.folder / name

    def describe(self) -> dict[str, Any]:
        """Return what decides the results; see :func:`torchrg.batch.records.describe_work`."""
        source = self.source
        return describe_work(source.settings, source.describe(), self.inputs, source.root)

    def run(self) -> TaskReport:
        """Convert the scan; what goes wrong with it is in the report."""
        return convert_scan(self)

    def clean(self) -> None:
        """Remove what a process that was killed left half-written."""
        if self.folder.is_dir():
            remove_leftovers(self.folder, self.mark)


def convert_scan(job: Job) -> TaskReport:
    """Convert one scan; what goes wrong with it is in the report and never raised.

    The record of an earlier run is removed first, and the new one written last: whoever finds a
    record finds complete files.
    """

    def convert(begin: Callable[[str], None]) -> Converted:
        begin("hash")
        description = job.describe()
        job.folder.mkdir(parents=True, exist_ok=True)
        for folder in (job.folder, *job.folder.parents):
            sync_folder(folder.parent)
            if folder == job.out:
                break
        check_place(job.record)
        check_record(job)
        job.clean()
        earlier = read_record(job) or {"outputs": {}}
        job.record.unlink(missing_ok=True)
        with marked_parts(job.mark):
            converted = job.source.convert(job.scan, job.folder, begin)
            begin("record")
            for name in earlier["outputs"].keys() - set(converted.files):
                if is_unchanged(job, name, earlier["outputs"][name]):
                    job.place_of(name).unlink()
            write_record(job, description, converted)
        return converted

    is_new = not job.folder.exists()
    report = report_on(job.name, convert)
    if report.status == "failed" and is_new:
        with contextlib.suppress(OSError):
            job.folder.rmdir()  # If it is empty.
    return report
