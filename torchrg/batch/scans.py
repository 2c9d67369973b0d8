"""What a batch is made of: scans, where they come from, and the task of converting one of them."""

import contextlib
import json
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

from torchrg.batch.memory import memory_of_scan
from torchrg.batch.records import (
    RECORD,
    Record,
    describe_versions,
    fingerprint,
    is_unchanged,
    layout_of,
    read_record,
    remove_earlier,
    split_by_layout,
    write_record,
)
from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.config import DepthConfig, PipelineConfig
from torchrg.datasets.folder import SceneFiles
from torchrg.datasets.pointcept import protecting_files
from torchrg.errors import FormatError
from torchrg.io.files import check_place, mark_of, marked_parts, remove_leftovers, sync_folder
from torchrg.result import PLANES_FILE, write_table


class Source:
    """A data set that can be converted: it lists its scans, and converts one of them.

    Sources travel to other processes, so they hold settings and paths but no open files.

    Attributes:
        root: The directory of the data set.
        settings: How to segment.
        table: Name of a further table of planes in the folder of each scan. Default: none.
    """

    root: Path
    settings: PipelineConfig | DepthConfig
    table: str | None
    bytes_per_point: ClassVar[int]
    """Space that the results of one point take, to see beforehand whether the disk has it."""

    def describe(self) -> Record:
        """Return the kind of the source and what else decides results, for JSON."""
        raise NotImplementedError

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the scans in natural order, whose results go to ``out``."""
        raise NotImplementedError

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
        """Read a scan, segment it, and write its results, each file whole or not at all.

        The folder exists; ``begin`` is to be called with the name of each stage when it starts.
        """
        raise NotImplementedError

    def check_results(self, scans: Sequence[SceneFiles], out: Path) -> None:
        """Raise FormatError if files of the results would replace those of others."""

    def write_lists(self, out: Path, mark: str, *, without: Collection[Path] = ()) -> None:
        """Write what results have for the data set as a whole, from all scans in ``out``.

        The scans of files in ``without`` are about to be removed.
        """


@dataclass(frozen=True)
class Job:
    """The task of converting one scan, which any process can do.

    Attributes:
        source: The data set.
        scan: One of its scans.
        out: Where results go.
    """

    source: Source
    scan: SceneFiles
    out: Path

    @property
    def name(self) -> str:
        """The name of the scan."""
        return self.scan.name

    @property
    def memory(self) -> int:
        """Bytes that a process with this scan takes at most."""
        return memory_of_scan(self.scan.num_points)

    @property
    def folder(self) -> Path:
        """Where the results of the scan go, and the record of them."""
        return self.out / self.scan.name

    @property
    def mark(self) -> str:
        """Mark of the names that results are written under before they have their own."""
        return mark_of(self.scan.name)

    def input_name(self, path: Path) -> str:
        """Return the path of an input file from the root of the data set, as records name it."""
        root = self.source.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def describe(self) -> Record:
        """Return what decides the results, as JSON holds it; OSError if an input cannot be read."""
        config, table = asdict(self.source.settings), self.source.table
        # It never changes a result, and lowering it after running out of memory must cost nothing.
        config.pop("chunk_size", None)
        inputs = [(self.input_name(path), path) for path in self.scan.files]
        return {
            "versions": describe_versions(),
            "config": config,
            "source": self.source.describe() | ({"table": table} if table else {}),
            "inputs": [{"name": name} | fingerprint(path) for name, path in inputs],
            "device": "cpu",
        }

    def clean(self) -> None:
        """Remove what a process that was killed left half-written."""
        if self.folder.is_dir():
            remove_leftovers(self.folder, self.mark)


def convert_scan(job: Job) -> TaskReport:
    """Convert one scan; what goes wrong with it is in the report and never raised.

    The record of an earlier run is removed first, and the new one written last: whoever finds a
    record finds complete files.
    """
    is_new = not os.path.lexists(job.folder)
    report = report_on(job.name, partial(_convert, job))
    if report.status == "failed" and is_new:
        with contextlib.suppress(OSError):
            job.folder.rmdir()  # If it is empty.
    return report


def _convert(job: Job, begin: Begin) -> TaskReport:
    """Convert one scan, between the record of an earlier run and the new one."""
    begin("hash")
    description, folder = job.describe(), job.folder
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder, *folder.parents):
        sync_folder(path.parent)
        if path == job.out:
            break
    check_place(folder / RECORD)
    earlier = read_record(folder, is_ours=True) or {"outputs": {}, "other_layouts": {}}
    table = job.source.table
    if table is not None and table not in earlier["outputs"] and (folder / table).exists():
        raise FormatError(
            f"{folder / table}: was not written by torchrg; move it away, or give another --table."
        )
    job.clean()
    (folder / RECORD).unlink(missing_ok=True)
    replaced, other_layouts = split_by_layout(earlier, layout_of(description))
    edited = [n for n, noted in replaced.items() if not is_unchanged(folder / n, noted)]
    with marked_parts(job.mark), protecting_files(edited):
        report = job.source.convert(job.scan, folder, begin)
        if table is not None:
            described = json.loads((folder / PLANES_FILE).read_text("utf-8"))
            write_table(folder / table, {k: v for k, v in described.items() if k != "written"})
            report = replace(report, files=(*report.files, table))
        begin("record")
        for name in report.files:
            replaced.pop(name, None)
        changed = remove_earlier(job.out, folder, replaced)
        notes = [f"{name} stays, as it was changed since torchrg wrote it" for name in changed]
        report = replace(report, warnings=(*report.warnings, *notes))
        write_record(folder, description, report, other_layouts)
    return report
