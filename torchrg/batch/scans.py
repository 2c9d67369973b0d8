"""What a batch is made of: scans, where they come from, and the task of converting one of them.

The road of a cloud is :func:`check_finite`, :func:`segment_cloud` and :func:`write_scan`, for every
source of clouds and for ``torchrg segment``.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

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
from torchrg.config import DepthConfig, PipelineConfig, SuperpointsConfig
from torchrg.datasets.folder import folded_name
from torchrg.datasets.layouts import LayoutScan, split_name, stem_of, write_layout
from torchrg.datasets.pointcept import keeping_files, write_arrays, write_pointcept_scene
from torchrg.errors import FormatError
from torchrg.io.colors import narrow_colors
from torchrg.io.fields import are_whole
from torchrg.io.files import check_place, marked_parts, remove_leftovers, sync_folder
from torchrg.normals.orient import Orientation
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.regions.selection import choose_planes, keep_planes, renumber_planes
from torchrg.result import PLANES_FILE, describe_planes, write_table
from torchrg.structures import FARTHEST, Cloud, Segmentation, Superpoints, bounding_box

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


@dataclass(frozen=True)
class Reading:
    """A cloud as a source reads it.

    Attributes:
        cloud: The cloud; its field ``color``, if it has one, plays a part in superpoints.
        arrays: What is written beside the results, by name. With ``coord`` among them it is a scene
            in Pointcept's types, else the coordinates of the cloud are written as they are.
        dataset: The data set whose classes and objects it has; see
            :class:`torchrg.datasets.layouts.LayoutScan`.
        objects: Its objects, likewise.
        repairs: What was put right in the input, a line each.
        notes: What a user should know, a line each.
    """

    cloud: Cloud
    arrays: Mapping[str, Any]
    dataset: str = "ScanNet"
    objects: Sequence[tuple[Mapping[str, Any], NDArray[np.integer]]] | None = None
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """A data set that can be converted: it lists its scans, and converts one of them.

    Sources travel to other processes, so they hold settings and paths but no open files. Those of
    clouds only list and read: see :class:`torchrg.batch.sources.CloudSource`.

    Args:
        root: The directory of the data set.
        settings: How to segment.
        table: Name of a further table of planes in the folder of each scan. Default: none.
    """

    root: Path
    settings: PipelineConfig | DepthConfig
    _: KW_ONLY
    table: str | None = None
    bytes_per_point: ClassVar[int]
    """Space that the results of one point take, to see beforehand whether the disk has it."""

    @property
    def in_place(self) -> bool:
        """Whether results may go into ``root`` itself."""
        return False

    def describe(self) -> Record:
        """Return the kind of the source and what else decides results, for JSON."""
        raise NotImplementedError

    def list_scans(self) -> list[Scan]:
        """Return the scans in natural order."""
        raise NotImplementedError

    def convert(self, scan: Scan, folder: Path, begin: Begin) -> TaskReport:
        """Read a scan, segment it, and write its results, each file whole or not at all.

        The folder exists; ``begin`` is to be called with the name of each stage when it starts.
        """
        raise NotImplementedError

    def check_results(self, scans: Sequence[Scan], out: Path) -> None:
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
    scan: Scan
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
        inputs = [(self.input_name(path), path) for path in self.scan.inputs]
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


def mark_of(name: str) -> str:
    """Return the mark of the files that are being written for a scan in an output directory.

    It is the same in every run, so that each removes what one that was killed has left; see
    :func:`torchrg.io.files.marked_parts`.

    Example:
        >>> mark_of("Area_1/office_1")
        '65d1ec9889e61d51'
    """
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:16]


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
    with marked_parts(job.mark), keeping_files(edited):
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


def check_finite(cloud: Cloud) -> tuple[str, ...]:
    """Return warnings if points are missing, far off, or have lost digits; one has to be finite.

    Example:
        >>> check_finite(Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]])))
        ('2 of 3 points are not finite or beyond 1e+12; they stay in place, unlabelled',)
    """
    num_bad = len(cloud) - int(np.count_nonzero(cloud.finite))
    if num_bad == len(cloud):
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
    finite = cloud.coordinates[cloud.finite] if num_bad else cloud.coordinates
    low, high = bounding_box(finite)
    size = float((high - low).max())
    low, high = np.quantile(finite[:: max(len(cloud) // _LOOKED_AT, 1)], _MIDDLE, axis=0)
    width = float((high - low).max())
    if width > 0 and size > _FAR_OFF * width:
        notes.append(
            f"half of its points lie within {width:.3g}, single ones {size:.3g} apart, which costs "
            "the others their precision; remove those that are none"
        )
    elif cloud.precision_note:
        notes.append(cloud.precision_note)
    return tuple(notes)


def note_on_copies(num_copies: int, num_points: int) -> tuple[str, ...]:
    """Return a line for people if points of a cloud repeat the coordinates of others.

    Example:
        >>> note_on_copies(2, 3)
        ('2 of 3 points are copies of others; copies count once and get one result',)
    """
    if not num_copies:
        return ()
    return (
        f"{num_copies:,} of {num_points:,} points are copies of others; copies count once and get "
        "one result",
    )


def segment_cloud(
    cloud: Cloud,
    settings: PipelineConfig,
    *,
    orient: Orientation = "auto",
    viewpoint: Sequence[float] | None = None,
    partition: SuperpointsConfig | None = None,
    voxel: float | None = None,
    within: NDArray[np.integer] | None = None,
    begin: Begin = lambda stage: None,
) -> tuple[Segmentation, Superpoints | None]:
    """Return the planes of a cloud, and with a ``partition`` its superpoints.

    See :func:`torchrg.segment_planes` for the arguments; it calls ``begin`` as ``on_stage``.

    Raises:
        ConfigError: If normals shall point to scanners, and the cloud does not name any.
    """
    is_kept = partition is not None
    seg = segment_planes(
        cloud,
        # Superpoints keep to the borders of all planes.
        settings.of_all_planes() if is_kept else settings,
        orient=orient,
        viewpoint=viewpoint,
        voxel=voxel,
        within=within,
        keep_neighbors=is_kept,
        on_stage=begin,
    )
    if partition is None:
        return seg, None
    begin("superpoints")
    colors = cloud.fields.get("color")
    superpoints = make_superpoints(cloud.points, seg, partition, colors=colors, voxel=voxel)
    rows = choose_planes(seg.planes, settings)
    plane = renumber_planes(superpoints.plane, rows, len(seg.planes))
    return keep_planes(seg, rows), replace(superpoints, plane=plane)


def find_objects(
    fields: Mapping[str, NDArray[Any]], name: str | None, cloud: Cloud
) -> NDArray[np.int64] | None:
    """Return the object of each point of a cloud, the field of a name; None without a name.

    ``segment`` is ``segment20`` where there is only that. Of several labels of a point the first
    is taken; text and scalar fields of PLY have whole numbers as floats.

    Raises:
        FormatError: If there is no such field, or it does not hold a whole number for each point.

    Example:
        >>> cloud = Cloud(np.zeros((2, 3)))
        >>> find_objects({"instance": np.array([[3, 5], [4, -1]])}, "instance", cloud).tolist()
        [3, 4]
    """
    if name is None:
        return None
    values, wanted = fields.get(name, fields.get(f"{name}20")), f"the field {name} of --within"
    if values is None:
        names = ", ".join(sorted(fields)) or "none"
        names += "".join(f" ({note})" for note in cloud.notes if name in note)
        raise FormatError(f"{cloud.source}: expected {wanted}, got {names}; name one of these.")
    if values.dtype.kind not in "iubf" or len(values) != len(cloud) or not are_whole(values):
        raise FormatError(
            f"{cloud.source}: expected {wanted} to be a whole number for each of {len(cloud):,} "
            f"points, got {values.dtype} of shape {values.shape}; number the objects."
        )
    return values.reshape(len(values), -1)[:, 0].astype(np.int64)


def check_stems(layout: str, places: Mapping[str, str]) -> None:
    """Raise FormatError if a scan would write into the files of another in a layout.

    ``places`` says where each scan is in its data set, by its name.
    """
    taken: dict[str, str] = {}
    for name, place in places.items() if layout != "pointcept" else ():
        stem = stem_of(layout, name, place)
        other = taken.setdefault(folded_name(stem), name)
        if other != name:
            raise FormatError(
                f"expected files of its own for each scan, got {stem} for {other} and {name} in "
                f"layout {layout}; rename one, or choose layout pointcept."
            )


def note_on_origin(layout: str, cloud: Cloud) -> tuple[str, ...]:
    """Return what a user should know of the coordinates of a cloud in a layout."""
    if layout == "pointcept" or not cloud.origin.any():
        return ()
    place = " ".join(f"{value:.12g}" for value in cloud.origin)
    return (f"coordinates are written about {place}, as they are far from the origin",)


def write_scan(
    layout: str,
    name: str,
    folder: Path,
    reading: Reading,
    seg: Segmentation,
    superpoints: Superpoints | None,
    *,
    level: int = 0,
    place: str | None = None,
) -> list[str]:
    """Write a scan in a layout, into the folder of its name; return the files by their paths there.

    Every layout but ``"pointcept"`` needs superpoints, of which it takes one ``level``. Colors of
    16 bits are rounded to 8, which is what readers of layouts expect. ``place``
    is where the scan is in its data set, which some layouts keep; the default is its name.
    """
    cloud, arrays = reading.cloud, {**reading.arrays}
    if "color" in arrays:
        arrays["color"] = narrow_colors(arrays["color"])
    levels = [] if superpoints is None else [*superpoints.by_level().values()][level:]
    superpoint = levels[0] if levels else None
    if layout == "pointcept" or superpoint is None:
        origin = cloud.origin.tolist()
        if "coord" in arrays:
            return write_pointcept_scene(folder, arrays, seg, superpoint=superpoint, origin=origin)
        fields = arrays if superpoint is None else {**arrays, "superpoint": superpoint}
        return write_results(folder, cloud.coordinates, seg, fields=fields, origin=origin)
    split, stem = split_name(name)
    scan = LayoutScan(
        stem,
        split,
        folder=name if place is None else place,
        dataset=reading.dataset,
        coord=cloud.points.numpy(),
        normal=seg.normals.numpy(),
        superpoint=superpoint,
        plane=seg.labels.numpy(),
        given={key: np.asarray(values) for key, values in arrays.items()},
        objects=reading.objects,
        coarser=levels[1:],
    )
    out = folder.parents[name.count("/")]
    return write_layout(layout, folder, out, scan, seg.planes, cloud.origin)


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
