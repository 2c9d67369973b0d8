"""Sources, jobs, and the conversion of a single scan."""

import contextlib
import json
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

from torchrg.batch.memory import scan_memory
from torchrg.batch.records import (
    RECORD,
    Record,
    describe_versions,
    fingerprint,
    get_layout,
    is_unchanged,
    read_record,
    remove_replaced,
    split_by_layout,
    write_record,
)
from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.config import DepthConfig, PipelineConfig
from torchrg.datasets.folder import SceneFiles
from torchrg.datasets.pointcept import protecting_files
from torchrg.errors import FormatError
from torchrg.io.files import check_writable, marked_parts, remove_leftovers, run_mark, sync_folder
from torchrg.result import PLANES_FILE, write_table

__all__ = ["Job", "Source", "convert_scan"]
__dir__ = __all__.copy


class Source:
    """Convertible data set: lists its scans, and converts one of them.

    Sources are sent to other processes, so they hold settings and paths but no open files.

    Attributes:
        root: The directory of the data set.
        settings: Segmentation configuration.
        table: Name of an additional plane table in the folder of each scan. Default: none.
    """

    root: Path
    settings: PipelineConfig | DepthConfig
    table: str | None
    num_levels = 0
    """Number of levels of superpoints into which conversion also partitions clouds."""
    bytes_per_point: ClassVar[int]
    """Disk space of the results per point, to check the free space in advance."""

    def describe(self) -> Record:
        """Return the type of the source and its options that affect results, for JSON."""
        raise NotImplementedError

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the scans in natural order; their results go to ``out``."""
        raise NotImplementedError

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
        """Read a scan, segment it, and write its results, each file atomically.

        The folder exists; ``begin`` must be called with the name of each stage when it starts.
        """
        raise NotImplementedError

    def check_results(self, scans: Sequence[SceneFiles], out: Path) -> None:
        """Raise FormatError if result files would replace files of other origin."""

    def write_lists(self, out: Path, mark: str, *, without: Collection[Path] = ()) -> None:
        """Write data-set-wide files from all scans in ``out``.

        ``without`` contains files of scans that are about to be removed.
        """


@dataclass(frozen=True)
class Job:
    """Conversion of one scan, which can run in any process.

    Attributes:
        source: The data set.
        scan: One of its scans.
        out: Output directory.
    """

    source: Source
    scan: SceneFiles
    out: Path

    @property
    def name(self) -> str:
        """Name of the scan."""
        return self.scan.name

    @property
    def memory(self) -> int:
        """Maximum memory of a process with this scan, in bytes."""
        k, num_levels = self.source.settings.max_neighbors, self.source.num_levels
        return scan_memory(self.scan.num_points, k=k, num_levels=num_levels)

    @property
    def folder(self) -> Path:
        """Folder of the results of the scan and their record."""
        return self.out / self.scan.name

    @property
    def mark(self) -> str:
        """Mark of the scan's temporary files."""
        return run_mark(self.scan.name)

    def input_name(self, path: Path) -> str:
        """Return the path of an input file relative to the data set, as in records."""
        root = self.source.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def describe(self) -> Record:
        """Return what determines the results, as JSON values; OSError if an input is unreadable."""
        config, table = asdict(self.source.settings), self.source.table
        # It never changes results, so lowering it after a memory error must not reconvert scans.
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
        """Remove temporary files of a killed process."""
        if self.folder.is_dir():
            remove_leftovers(self.folder, self.mark)


def convert_scan(job: Job) -> TaskReport:
    """Convert one scan; errors are put into the report and never raised.

    The record of an earlier run is removed first, and the new one is written last, so that a record
    implies complete files.
    """
    is_new = not os.path.lexists(job.folder)
    report = report_on(job.name, partial(_convert, job))
    if report.status == "failed" and is_new:
        with contextlib.suppress(OSError):
            job.folder.rmdir()  # Fails unless the folder is empty.
    return report


def _convert(job: Job, begin: Begin) -> TaskReport:
    """Convert one scan, after removing the earlier record, and write the new one."""
    begin("hash")
    description, folder = job.describe(), job.folder
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder, *folder.parents):
        sync_folder(path.parent)
        if path == job.out:
            break
    check_writable(folder / RECORD)
    earlier = read_record(folder, strict=True) or {"outputs": {}, "other_layouts": {}}
    table = job.source.table
    if table is not None and table not in earlier["outputs"] and (folder / table).exists():
        raise FormatError(
            f"{folder / table}: was not written by torchrg; move it, or choose another --table."
        )
    job.clean()
    (folder / RECORD).unlink(missing_ok=True)
    replaced, other_layouts = split_by_layout(earlier, get_layout(description))
    edited = [n for n, stored in replaced.items() if not is_unchanged(folder / n, stored)]
    with marked_parts(job.mark), protecting_files(edited):
        report = job.source.convert(job.scan, folder, begin)
        if table is not None:
            table_data = json.loads((folder / PLANES_FILE).read_text("utf-8"))
            write_table(folder / table, {k: v for k, v in table_data.items() if k != "written"})
            report = replace(report, files=(*report.files, table))
        begin("record")
        for name in report.files:
            replaced.pop(name, None)
        changed = remove_replaced(job.out, folder, replaced)
        notes = [f"{name} is kept, as it was changed since torchrg wrote it" for name in changed]
        report = replace(report, warnings=(*report.warnings, *notes))
        write_record(folder, description, report, other_layouts)
    return report
