"""What a batch is made of: scans, where they come from, and the task of converting one of them."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchrg.batch.memory import memory_of_scan
from torchrg.batch.records import (
    RECORD,
    check_record,
    describe_work,
    is_unchanged,
    read_record,
    write_record,
)
from torchrg.batch.task import Converted, TaskReport, report_on
from torchrg.datasets.pointcept import write_arrays
from torchrg.errors import FormatError
from torchrg.io.files import check_place, make_mark, marked_parts, remove_leftovers, sync_folder
from torchrg.result import describe_planes
from torchrg.structures import FARTHEST, Cloud, Segmentation

_LOOKED_AT = 10_000
"""Points, spread over a cloud, that tell where most of its points are."""
_MIDDLE = (0.25, 0.75)
"""Quantiles of each coordinate between which the middle half of a cloud lies."""
_FAR_OFF = 1000
"""Ratio of the extent of a cloud to that of its middle half from which on the user is warned. As
float32 has seven digits, its steps are then a ten-thousandth of where most points are."""


@dataclass(frozen=True)
class Scan:
    """One scan of a data set, as far as can be told without reading it.

    Attributes:
        name: Folder of its results below the output directory, with forward slashes.
        inputs: The files that it is made of.
        num_points: Its number of points by the headers or sizes of its files.
        item: What else its source needs to read it; plain values that travel between processes.
    """

    name: str
    inputs: tuple[Path, ...]
    num_points: int
    item: Any = None


class Source(Protocol):
    """A data set that can be converted: it lists its scans, and reads and writes one of them.

    Sources travel to other processes, so they hold settings and paths but no open files.
    """

    @property
    def root(self) -> Path:
        """The directory of the data set."""

    @property
    def in_place(self) -> bool:
        """Whether results may go into :attr:`root` itself."""

    @property
    def settings(self) -> Any:  # noqa: ANN401
        """A dataclass of settings of the segmentation."""

    @property
    def bytes_per_point(self) -> int:
        """Space that the results of one point take, to see beforehand whether the disk has it."""

    def describe(self) -> dict[str, Any]:
        """Return the kind of the source and what else decides results, for JSON."""

    def list_scans(self) -> list[Scan]:
        """Return the scans in natural order."""

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read a scan, segment it, and write its results, each file whole or not at all.

        The folder exists; ``begin`` is to be called with the name of each stage when it starts.
        """


@dataclass(frozen=True)
class Job:
    """The task of converting one scan.

    Attributes:
        source: The data set.
        scan: One of its scans.
        out: Where results go.
        mark: Part of the names that results are written under before they have their own; see
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
    is_new = False

    def convert(begin: Callable[[str], None]) -> Converted:
        nonlocal is_new
        begin("hash")
        description = job.describe()
        is_new = not job.folder.exists()
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

    report = report_on(job.name, convert)
    if report.status == "failed" and is_new:
        with contextlib.suppress(OSError):
            job.folder.rmdir()  # If it is empty.
    return report


def check_finite(cloud: Cloud) -> tuple[str, ...]:
    """Return warnings if points of a cloud are missing, far off, or have lost digits.

    Raises:
        FormatError: If none is finite.

    Example:
        >>> check_finite(Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]])))
        ('2 of 3 points are not finite or beyond 1e+12; they stay in place, unlabelled',)
    """
    known = cloud.coordinates if cloud.finite.all() else cloud.coordinates[cloud.finite]
    num_bad = len(cloud) - len(known)
    if len(known) == 0:
        raise FormatError(
            f"{cloud.source}: expected finite points, got none in {num_bad:,} points; those beyond "
            f"{FARTHEST:g} count as missing: use another unit, or look where they come from."
        )
    notes = []
    if num_bad:
        notes.append(
            f"{num_bad:,} of {len(cloud):,} points are not finite or beyond {FARTHEST:g}; they "
            "stay in place, unlabelled"
        )
    low, high = np.quantile(known[:: max(len(cloud) // _LOOKED_AT, 1)], _MIDDLE, axis=0)
    ends = known.min(axis=0).astype(np.float64), known.max(axis=0).astype(np.float64)
    size, width = float((ends[1] - ends[0]).max()), float((high - low).max())
    if width > 0 and size > _FAR_OFF * width:
        notes.append(
            f"half of its points lie within {width:.3g}, single ones {size:.3g} apart, which "
            "costs the others their precision; remove those that are none"
        )
        return tuple(notes)
    return (*notes, cloud.precision_note) if cloud.precision_note else tuple(notes)


def write_results(
    folder: Path,
    coord: NDArray[np.floating],
    segmentation: Segmentation,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write ``coord``, ``normal``, ``curvature``, ``plane`` as ``.npy``, and ``planes.json``.

    Into a folder that exists; ``coord`` ``(*, 3)`` in the dtype to be written, the segmentation of
    the same leading axes, further ``fields`` by name. ``origin`` is where the origin of the
    segmentation is, in the coordinates of ``coord``. Returns the names of the files; those of
    others are never replaced, see :func:`torchrg.datasets.pointcept.write_arrays`.
    """
    arrays: dict[str, NDArray[Any]] = {
        "coord": coord,
        "normal": segmentation.normals.numpy(),
        "curvature": segmentation.curvature.numpy(),
        "plane": segmentation.labels.numpy().astype(np.int32),
        **(fields or {}),
    }
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    return write_arrays(folder, arrays, describe_planes(segmentation.planes, origin=origin))
