"""Sources, jobs, and the conversion of a single scan."""

import contextlib
import copy
import json
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

from torchrg import scratch
from torchrg.batch.memory import scan_memory
from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.config import DepthConfig, PipelineConfig
from torchrg.datasets import provenance
from torchrg.datasets.folder import SceneDataset, SceneFiles
from torchrg.errors import FormatError
from torchrg.io.files import check_writable, fingerprint, remove_leftovers, sync_folder
from torchrg.io.result import PLANES_FILE, RECORD, write_table

__all__ = ["Job", "Source", "convert_scan"]
__dir__ = __all__.copy

_RESULTS = {"points": int, "regions": int, "repairs": list, "warnings": list}
"""Types of the record entries that reports repeat."""


class Source:
    """Convertible data set: lists its scans, and converts one of them.

    Sources are sent to other processes, so they hold settings and paths but no open files.

    Attributes:
        data: The data set.
        settings: Segmentation configuration.
        table: Name of an additional plane table in the folder of each scan. Default: none.
    """

    data: SceneDataset
    settings: PipelineConfig | DepthConfig
    table: str | None
    layout = ""
    """Layout of the results, if the data set has several."""
    num_levels = 0
    """Number of levels of superpoints into which conversion also partitions clouds."""
    bytes_per_point: ClassVar[int]
    """Disk space of the results per point, to check the free space in advance."""
    unit: ClassVar[str] = "scan"
    """Name of a scan in messages."""
    seconds_per_million: ClassVar[tuple[float, str]] = (10.0, "points, as consensus takes")
    """Time in seconds for a million points on one core of an AMD EPYC, and the name of the points.
    Measured with ``torchrg segment`` on a synthetic room of four million points. ``classic`` takes
    0.6 times as long, ``paper`` 1.5 times, and every preset about three times without kernels."""

    @property
    def root(self) -> Path:
        """The directory of the data set."""
        return self.data.root

    def __getstate__(self) -> provenance.Record:
        """Return the state for other processes, without scenes: each job has its own."""
        data = copy.copy(self.data)
        data.scenes = []
        return vars(self) | {"data": data}

    def describe(self) -> provenance.Record:
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

    def write_lists(self, out: Path, *, without: Collection[Path] = ()) -> None:
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
        on_disk: Whether its large arrays go to disk; the results are identical.
    """

    source: Source
    scan: SceneFiles
    out: Path
    on_disk: bool = False

    @property
    def name(self) -> str:
        """Name of the scan."""
        return self.scan.name

    @property
    def memory(self) -> int:
        """Maximum memory of a process with this scan, in bytes."""
        k, num_levels = self.source.settings.max_neighbors, self.source.num_levels
        num_points, on_disk = self.scan.num_points, self.on_disk
        return scan_memory(num_points, k=k, num_levels=num_levels, on_disk=on_disk)

    def within(self, limit: int) -> "Job":
        """Return the job for a memory limit in bytes: on disk if it exceeds it, except images."""
        is_large = self.memory > limit and self.source.settings.max_neighbors > 0
        return replace(self, on_disk=is_large)

    @property
    def folder(self) -> Path:
        """Folder of the results of the scan and their record."""
        return self.out / self.scan.name

    def input_name(self, path: Path) -> str:
        """Return the path of an input file relative to the data set, as in records."""
        root = self.source.root
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name

    def describe(self) -> provenance.Record:
        """Return what determines the results, as JSON values; OSError if an input is unreadable."""
        config, table = asdict(self.source.settings), self.source.table
        # It never changes results, so lowering it after a memory error must not reconvert scans.
        config.pop("chunk_size", None)
        inputs = [(self.input_name(path), path) for path in self.scan.files]
        return {
            "versions": provenance.describe_versions(),
            "config": config,
            "source": self.source.describe() | ({"table": table} if table else {}),
            "inputs": [{"name": name} | fingerprint(path) for name, path in inputs],
            "device": "cpu",
            "name": self.name,
        }

    def clean(self) -> None:
        """Remove temporary files of a killed process, and a claim on no file."""
        if self.folder.is_dir():
            remove_leftovers(self.folder)
            if (provenance.read_record(self.folder) or {}).get("claims") == {}:
                (self.folder / RECORD).unlink()


def reason_to_convert(job: Job) -> str:
    """Return why a scan must be converted, or "" if it is up to date.

    ``"new"`` without a complete record; else the first of version, settings, options, input or
    results that differs from the record, or that the record is damaged.
    """
    record = provenance.read_record(job.folder)
    if record is None or "outputs" not in record:
        return "new"
    try:
        description = json.loads(json.dumps(job.describe()))
    except (OSError, FormatError):
        return "input cannot be read"
    changes = {"versions": "version", "config": "settings", "source": "options", "inputs": "input"}
    for key, name in changes.items():
        if record.get(key) != description[key]:
            return f"{name} changed"
    if not all(isinstance(record.get(name), kind) for name, kind in _RESULTS.items()):
        return "record damaged"
    for name, stored in record["outputs"].items():
        try:
            if fingerprint(job.folder / name) != stored:
                return f"{name} changed"
        except OSError:
            return f"{name} missing"
    return ""


def convert_scan(job: Job) -> TaskReport:
    """Convert one scan; errors are put into the report and never raised.

    The record of an earlier run becomes a claim first, and the new one is written last, so that a
    record of outputs implies complete files.
    """
    is_ours = not os.path.lexists(job.folder) or provenance.read_record(job.folder) is not None
    report = report_on(job.name, partial(_convert, job))
    if report.status == "failed":
        with contextlib.suppress(OSError):
            job.clean()
            if is_ours:
                job.folder.rmdir()  # Fails unless the folder is empty.
    return report


def _convert(job: Job, begin: Begin) -> TaskReport:
    """Convert one scan: claim its files, write them, and record them."""
    begin("hash")
    description, folder, table = job.describe(), job.folder, job.source.table
    folder.mkdir(parents=True, exist_ok=True)
    for path in (folder, *folder.parents):
        sync_folder(path.parent)
        if path == job.out:
            break
    check_writable(folder / RECORD)
    earlier = provenance.read_record(folder, strict=True)
    provenance.check_owned(folder, [RECORD, *([] if table is None else [table])], earlier)
    if earlier is not None:
        provenance.check_source(folder, earlier, description["source"])
        description |= {key: earlier[key] for key in earlier.keys() & {"pages"}}
    job.clean()
    provenance.write_record(folder, description | {"claims": provenance.owned_files(earlier)})
    storage = scratch.on_disk(os.environ.get("TMPDIR") or folder)
    with storage if job.on_disk else contextlib.nullcontext():
        report = job.source.convert(job.scan, folder, begin)
    if table is not None:
        provenance.write_record(
            folder, provenance.claim_files(provenance.read_record(folder) or description, [table])
        )
        write_table(folder / table, json.loads((folder / PLANES_FILE).read_text("utf-8")))
        report = replace(report, files=(*report.files, table))
    begin("record")
    changed = provenance.remove_unwritten(job.out, folder, earlier, report.files)
    notes = [f"{name} is kept, as it was changed since torchrg wrote it" for name in changed]
    report = replace(report, warnings=(*report.warnings, *notes))
    results = {
        "points": report.num_points,
        "regions": report.num_regions,
        "repairs": list(report.repairs),
        "warnings": list(report.warnings),
        "measured": report.measured,
        "outputs": {name: fingerprint(folder / name) for name in report.files},
    }
    provenance.write_record(folder, description | results)
    return report


def claim_pages(job: Job, folder: Path) -> None:
    """Add a folder of pages to the record of a complete scan, before they are written."""
    record, pages = provenance.read_record(job.folder), os.path.realpath(folder)
    name = os.path.relpath(pages, job.out)
    if record is not None and name not in (known := record.get("pages", [])):
        provenance.write_record(job.folder, record | {"pages": sorted([*known, name])})
