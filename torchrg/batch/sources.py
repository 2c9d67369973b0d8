"""The kinds of data sets that are converted.

A new kind is a :class:`~torchrg.batch.scans.Source` here, its arguments in ``torchrg.cli.convert``,
and a test.
"""

import dataclasses
import json
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchrg._optional import require
from torchrg.batch.records import Record
from torchrg.batch.scans import (
    Reading,
    Scan,
    Source,
    check_finite,
    check_stems,
    find_objects,
    note_on_copies,
    note_on_origin,
    segment_cloud,
    write_results,
    write_scan,
)
from torchrg.batch.task import Begin, TaskReport, collecting_notes
from torchrg.config import PipelineConfig, SuperpointsConfig
from torchrg.datasets import (
    S3DIS,
    FolderOfClouds,
    ScanNet,
    SceneFiles,
    layouts,
    read_pointcept_scene,
    read_room,
    read_scannet_scan,
)
from torchrg.datasets.layouts import check_layout
from torchrg.datasets.lists import check_lists, write_lists
from torchrg.datasets.pointcept import GIVEN_ARRAYS
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.rgbd_files import num_pixels, read_depth
from torchrg.datasets.scannet import MESH_PLUSPLUS, read_objects
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import Pinhole, numbers_of, points_of_image
from torchrg.errors import ConfigError, FormatError
from torchrg.io import FOLDER_SUFFIXES, estimate_points, read_cloud, takes_columns
from torchrg.io.colors import read_colors
from torchrg.io.fields import Values
from torchrg.io.npy import map_folder
from torchrg.normals.orient import Orientation
from torchrg.structures import Cloud, Segmentation

_COPIED = tuple(name for name in GIVEN_ARRAYS if name != "normal")
"""Arrays of a folder in Pointcept's layout that go along with its results."""


@dataclass(frozen=True)
class CloudSource(Source):
    """What sources of clouds share: how a cloud is converted, what is written, in which layout.

    A source of its own lists scans and reads one of them.

    Args:
        superpoint: Whether superpoints are written too; every layout but ``"pointcept"`` has them.
        layout: ``"pointcept"``, or a key of :data:`torchrg.datasets.layouts.LAYOUTS`.
        partition: How superpoints are made.
        level: Which of their levels is written.
        orient: Side to which normals point; see :func:`torchrg.normals.orient_normals`.
        within: Array of objects that planes are kept within; see
            :func:`torchrg.batch.scans.find_objects`. Default: planes go across.
    """

    settings: PipelineConfig
    _: KW_ONLY
    superpoint: bool = False
    layout: str = "pointcept"
    partition: SuperpointsConfig = field(default_factory=SuperpointsConfig)
    level: int = 0
    orient: Orientation = "auto"
    within: str | None = None
    bytes_per_point: ClassVar[int] = 104
    """Space of a point in the largest of the layouts."""
    kind: ClassVar[str]
    """The name of the kind of source."""
    dataset: ClassVar[str] = "ScanNet"
    """The data set whose layouts it has; clouds without labels are written as those of ScanNet."""

    def read(self, scan: Scan) -> Reading:
        """Return what is read of a scan."""
        raise NotImplementedError

    def convert(self, scan: Scan, folder: Path, begin: Begin) -> TaskReport:
        """Read a scan, segment it, and write its results, each file whole or not at all."""
        begin("read")
        reading = self.read(scan)
        cloud = reading.cloud
        notes = (*cloud.notes, *check_finite(cloud), *note_on_origin(self.layout, cloud))
        has_superpoints = self.superpoint or self.layout != "pointcept"
        partition = self.partition if has_superpoints else None
        objects = find_objects({**cloud.fields, **reading.arrays}, self.within, cloud)
        seg, superpoints = segment_cloud(
            cloud,
            self.settings,
            orient=self.orient,
            partition=partition,
            within=objects,
            begin=begin,
        )
        notes += note_on_copies(seg.num_copies, len(cloud))
        begin("write")
        what, place = (reading, seg, superpoints), _place_of(scan)
        files = write_scan(self.layout, scan.name, folder, *what, level=self.level, place=place)
        return TaskReport(
            scan.name,
            "converted",
            len(cloud),
            len(seg.planes),
            tuple(files),
            repairs=reading.repairs,
            warnings=(*notes, *reading.notes),
            measured=self.settings.measured(seg.sampling),
        )

    def describe(self) -> Record:
        """Return the kind of the source, and the settings that differ from their defaults."""
        changed: Record = {"kind": self.kind, "superpoint": self.superpoint, "orient": self.orient}
        if self.layout != "pointcept":
            changed |= {"layout": self.layout, "version": layouts.VERSION}
        if (self.partition, self.level) != (SuperpointsConfig(), 0):
            partition = json.loads(json.dumps(dataclasses.asdict(self.partition)))
            changed |= {"partition": partition, "level": self.level}
        if self.within is not None:
            changed["within"] = self.within
        return changed

    def check_results(self, scans: Sequence[Scan], out: Path) -> None:
        """Raise FormatError if a scan would write into files of another, or lists into others."""
        check_stems(self.layout, {scan.name: _place_of(scan) for scan in scans})
        check_lists(self.layout, self.dataset, out)

    def write_lists(self, out: Path, mark: str, *, without: Collection[Path] = ()) -> None:
        """Write what the layout has for the data set as a whole, from all scans in ``out``."""
        # A scan that is removed leaves the lists of all layouts that it was written in.
        for layout in layouts.LAYOUTS if without else (self.layout,):
            write_lists(layout, self.dataset, out, mark, without=without)


def _place_of(scan: Scan) -> str:
    """Return where a scan is in its data set."""
    return scan.name if scan.item is None else str(scan.item)


@dataclass(frozen=True)
class FolderSource(CloudSource):
    """Every readable cloud below a folder; folders in Pointcept's layout are clouds too.

    Files: ``coord``, ``normal``, ``curvature`` and ``plane`` as ``.npy``, ``color`` too where the
    cloud has colours, and ``planes.json``. Coordinates are the input's own, points that are not
    finite included. Folders in Pointcept's layout: see
    :func:`torchrg.datasets.write_pointcept_scene`.

    Args:
        out: Where results go. ``root`` itself completes folders in Pointcept's layout in place;
            no other folder below it can be.
        columns: Names for the columns of text and of bare ``.npy`` arrays; see
            :func:`torchrg.read_cloud`.
        suffixes: Which files are clouds. Default: all that can be read but ``.csv``.
    """

    out: Path
    columns: tuple[str, ...] | None = None
    suffixes: tuple[str, ...] = FOLDER_SUFFIXES
    kind: ClassVar[str] = "folder"

    @property
    def in_place(self) -> bool:
        """Whether results go into the folders of the clouds."""
        return self.out == self.root

    def describe(self) -> Record:
        """Return the kind and what else decides results."""
        columns = {} if self.columns is None else {"columns": list(self.columns)}
        return super().describe() | columns

    def list_scans(self) -> list[Scan]:
        """Return the clouds in natural order, if results do not go in among them."""
        scenes = FolderOfClouds(self.root, suffixes=self.suffixes).scenes
        files = [scene.path for scene in scenes if not scene.path.is_dir()]
        if self.in_place and (files or self.layout != "pointcept"):
            what = f"the results of {files[0].name}" if files else f"layout {self.layout}"
            raise ConfigError(
                f"{self.out}: expected a directory outside {self.root} for {what}; choose another."
            )
        if self.columns is not None and not any(map(takes_columns, files)):
            raise ConfigError("expected text or .npy for --columns, got files that name their own.")
        for scene in scenes:
            check_layout(self.layout, _dataset({file.stem for file in scene.files}), scene.name)
        return [self._scan(scene) for scene in scenes]

    def _scan(self, scene: SceneFiles) -> Scan:
        """Return a cloud with its input files."""
        if not scene.path.is_dir():
            return Scan(scene.name, (scene.path,), estimate_points(scene.path))
        # In place, nothing but the coordinates, for superpoints the colours, decides what is added.
        within = self.within or "coord"
        decisive = ("coord", *["color"] * self.superpoint, within, f"{within}20")
        used = decisive if self.in_place else _COPIED
        files = tuple(file for file in scene.files if file.stem in used)
        return Scan(scene.name, files, estimate_points(scene.path / "coord.npy"))

    def read(self, scan: Scan) -> Reading:
        """Read a file, or a folder in Pointcept's layout."""
        first = scan.inputs[0]
        if first.parent.relative_to(self.root).as_posix() == scan.name:
            return self._read_scene(first.parent)
        cloud = read_cloud(first, columns=self.columns if takes_columns(first) else None)
        others = [name for name in cloud.fields if name != "color"]
        notes = (f"left out: {', '.join(others)}",) if others else ()
        arrays = {name: cloud.fields[name] for name in cloud.fields.keys() & {"color"}}
        return Reading(cloud, arrays, notes=notes)

    def _read_scene(self, folder: Path) -> Reading:
        """Read a folder in Pointcept's layout."""
        sample, arrays = read_pointcept_scene(folder), map_folder(folder, _COPIED)
        colors, notes = dict[str, Values](), tuple[str, ...]()
        if "color" in arrays:
            colors["color"], notes = read_colors(folder / "color.npy", arrays["color"])
        cloud = Cloud(sample["coord"].numpy(), colors, source=str(folder), notes=notes)
        return Reading(cloud, {**arrays, **colors}, _dataset(arrays.keys()))


def _dataset(names: Collection[str]) -> str:
    """Return the data set whose classes a folder in Pointcept's layout has, by what it holds.

    Without ``segment`` or with ``segment20`` it is ScanNet, and else nobody knows.
    """
    return "" if "segment" in names and "segment20" not in names else "ScanNet"


@dataclass(frozen=True)
class S3DISSource(CloudSource):
    """The rooms of S3DIS, ``ROOT/Area_i/<room>/Annotations/*.txt``.

    Writes ``OUT/Area_i/<room>`` as :func:`torchrg.datasets.write_pointcept_scene` does.

    Args:
        areas: Numbers of the areas.
        class_order: Meaning of the numbers in ``segment``; see :class:`torchrg.datasets.S3DIS`.
            Other layouts than Pointcept's have its order.
    """

    areas: tuple[int, ...]
    class_order: str = "pointcept"
    kind: ClassVar[str] = "s3dis"
    dataset: ClassVar[str] = "S3DIS"

    def describe(self) -> Record:
        """Return the kind and what else decides results."""
        return super().describe() | {"class_order": self.class_order}

    def list_scans(self) -> list[Scan]:
        """Return the rooms in natural order; warn if an area has not as many as the release."""
        check_layout(self.layout, self.dataset, self.dataset)
        if self.layout != "pointcept" and self.class_order != "pointcept":
            raise ConfigError(
                f"expected --class-order with --layout pointcept, got layout {self.layout}, which "
                "has the order pointcept; leave it out."
            )
        require("pyarrow", extra="text", purpose="read S3DIS")
        rooms = S3DIS(self.root, self.areas, class_order=self.class_order)
        return [Scan(scene.name, scene.files, _estimate(scene)) for scene in rooms.scenes]

    def read(self, scan: Scan) -> Reading:
        """Read a room."""
        room = read_room(self.root / scan.name, class_order=self.class_order)
        arrays = {name: getattr(room, name) for name in ("coord", "color", "segment", "instance")}
        cloud = Cloud(room.coord, {"color": room.color}, source=scan.name)
        return Reading(cloud, arrays, self.dataset, repairs=room.repairs, notes=room.notes)


@dataclass(frozen=True)
class ScanNetSource(CloudSource):
    """The scans of ScanNet or ScanNet++; see :class:`torchrg.datasets.ScanNet`.

    Its root holds ``scans`` or ``data``. Writes ``OUT/<split>/<scan>`` as
    :func:`torchrg.datasets.write_pointcept_scene` does.
    """

    kind: ClassVar[str] = "scannet"

    @property
    def in_place(self) -> bool:
        """Whether results may go beside the folders of meshes, where programs look for them."""
        return self.layout != "scannet"

    def list_scans(self) -> list[Scan]:
        """Return the scans in natural order."""
        scans = []
        for name, mesh, files in ScanNet(self.root).scenes:
            dataset = _dataset_of_mesh(mesh)
            check_layout(self.layout, dataset, dataset)
            place = mesh.parent.relative_to(self.root).as_posix()
            if dataset == "ScanNet++":
                # Programs that read superpoints of it have scans where the release has data.
                place = f"scans/{mesh.parent.parent.name}/scans"
            scans.append(Scan(name, files, estimate_points(mesh), place))
        return scans

    def read(self, scan: Scan) -> Reading:
        """Read a scan."""
        mesh = scan.inputs[0]
        dataset, objects = _dataset_of_mesh(mesh), None
        with collecting_notes() as notes:
            arrays = read_scannet_scan(mesh, self.root)
            if self.layout == "scannet" and dataset == "ScanNet":
                objects = read_objects(mesh, len(arrays["coord"]))
        front = arrays.pop("front", None)
        colors = {name: arrays[name] for name in arrays.keys() & {"color"}}
        cloud = Cloud(arrays["coord"], colors, source=str(mesh), front=front)
        if "instance" not in arrays and not scan.name.startswith("test/"):
            notes.append("no labels: annotations or the table of their words are missing")
        return Reading(cloud, arrays, dataset, objects, notes=tuple(notes))


def _dataset_of_mesh(mesh: Path) -> str:
    """Return which of the two a mesh is of."""
    return "ScanNet++" if mesh.name == MESH_PLUSPLUS else "ScanNet"


def find_areas(root: Path) -> tuple[int, ...]:
    """Return the numbers of the areas that are there; all six if none is, to be told so."""
    return tuple(n for n in range(1, 7) if (root / f"Area_{n}").is_dir()) or tuple(range(1, 7))


def _estimate(scene: SceneFiles) -> int:
    """Return the number of points by the size of the files and the lines of the largest."""
    sizes = {file: file.stat().st_size for file in scene.files}
    largest = max(sizes, key=lambda file: sizes[file])
    return round(sum(sizes.values()) * estimate_points(largest) / max(sizes[largest], 1))


@dataclass(frozen=True)
class RGBDSource(Source):
    """The depth frames of a folder.

    Files of each frame, all of its height and width: ``coord`` ``(H, W, 3)``, ``normal``
    ``(H, W, 3)``, ``curvature`` and ``plane`` ``(H, W)`` as ``.npy``, and ``planes.json``. In world
    coordinates where the pose is known, else in camera coordinates; pixels without depth have zeros
    and plane -1.

    Args:
        layout: The shape of the folder; see :meth:`torchrg.datasets.RGBDFrames.from_folder`.
        intrinsics: The camera. Default: that of a camera file, or the layout's.
        depth_scale: Stored value of one metre. Default: that of a camera file, or the layout's.
        orient: Side to which normals point; see :func:`torchrg.depth.segment_depth`.
    """

    settings: DepthConfig
    layout: str
    intrinsics: Pinhole | None = None
    depth_scale: float | None = None
    orient: Orientation = "auto"
    bytes_per_point: ClassVar[int] = 12 + 12 + 4 + 4

    def describe(self) -> Record:
        """Return the kind and what else decides results."""
        return {
            "kind": "rgbd",
            "layout": self.layout,
            "intrinsics": self.intrinsics,
            "depth_scale": self.depth_scale,
            "orient": self.orient,
        }

    def list_scans(self) -> list[Scan]:
        """Return the frames in natural order."""
        data = RGBDFrames.from_folder(
            self.root, self.layout, intrinsics=self.intrinsics, depth_scale=self.depth_scale
        )
        # A wrong scale is the same in all frames, and a warning helps before the work.
        with suppress(FormatError, OSError):
            data.read_sample(0)
        return [
            Scan(frame.name, (frame.depth, *frame.sources), num_pixels(frame.depth), _plain(frame))
            for frame in data.frames
        ]

    def convert(self, scan: Scan, folder: Path, begin: Begin) -> TaskReport:
        """Read a frame, segment it, and write its results, each file whole or not at all."""
        begin("read")
        frame = _frame(scan.item)
        with collecting_notes() as notes:
            depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
        if not bool((depth > 0).any()):
            raise FormatError(
                f"{frame.depth}: expected pixels with depth, got none; take this frame out."
            )
        begin("planes")
        seg = segment_depth(
            depth, frame.intrinsics, self.settings, pose=frame.pose, orient=self.orient
        )
        points = points_of_image(depth, frame.intrinsics, frame.pose)
        begin("write")
        files = tuple(write_frame(folder, depth, points, seg))
        num_planes = len(seg.planes)
        notes += [] if num_planes else ["no plane found"]
        return TaskReport(
            scan.name,
            "converted",
            depth.numel(),
            num_planes,
            files,
            warnings=tuple(notes),
            measured={
                "intrinsics": numbers_of(frame.intrinsics),
                "camera": frame.origin,
                "depth_scale": frame.depth_scale,
            },
        )


def write_frame(folder: Path, depth: Tensor, points: Tensor, seg: Segmentation) -> list[str]:
    """Write a frame ``(H, W)`` and its points ``(H, W, 3)``; see :func:`write_results`.

    Pixels without depth have zeros.
    """
    coord = torch.where(depth[..., None] > 0, points, 0.0).float().numpy()
    return write_results(folder, coord, seg)


def _plain(frame: RGBDFrame) -> Record:
    """Return a frame as plain values."""
    pose = None if frame.pose is None else frame.pose.tolist()
    return vars(frame) | {"intrinsics": frame.intrinsics.tolist(), "pose": pose}


def _frame(values: Record) -> RGBDFrame:
    """Return the frame that plain values describe."""
    matrices = {
        name: None if values[name] is None else torch.tensor(values[name], dtype=torch.float64)
        for name in ("intrinsics", "pose")
    }
    return RGBDFrame(**(values | matrices))
