"""The kinds of data sets that are converted: clouds of any data set, and depth frames."""

import copy
import dataclasses
import json
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchrg.batch.records import Record
from torchrg.batch.scans import Source
from torchrg.batch.task import Begin, TaskReport, collecting_notes
from torchrg.clouds import note_on_copies, segment_cloud
from torchrg.config import PipelineConfig, SuperpointsConfig
from torchrg.datasets import layouts
from torchrg.datasets.folder import SceneDataset, SceneFiles, check_outside
from torchrg.datasets.layouts import check_layout, check_stems, note_on_origin, write_scan
from torchrg.datasets.lists import check_lists, write_lists
from torchrg.datasets.pointcept import SOURCE_ARRAYS, write_results
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.rgbd_files import num_pixels, read_depth
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import Pinhole, numbers_of, points_of_image
from torchrg.errors import FormatError
from torchrg.normals.orient import Orientation
from torchrg.structures import Segmentation


@dataclass(frozen=True)
class CloudSource(Source):
    """The clouds of a data set, with the settings of their conversion and their layout.

    Plain clouds become ``coord``, ``normal``, ``curvature`` and ``plane`` as ``.npy``, ``color``
    too where there are colours, and ``planes.json``; coordinates are the input's own, points that
    are not finite included. Scenes of a release or in Pointcept's layout: see
    :func:`torchrg.datasets.write_pointcept_scene`.

    Args:
        data: The data set.
        superpoint: Whether superpoints are written too; every layout but ``"pointcept"`` has them.
        layout: ``"pointcept"``, or a key of :data:`torchrg.datasets.layouts.LAYOUTS`.
        partition: How superpoints are made.
        level: Which of their levels is written.
        orient: Side to which normals point; see :func:`torchrg.normals.orient_normals`.
        within: Array of objects that planes are kept within; see
            :func:`torchrg.clouds.find_objects`. Default: planes go across.
    """

    data: SceneDataset
    settings: PipelineConfig
    _: KW_ONLY
    superpoint: bool = False
    layout: str = "pointcept"
    partition: SuperpointsConfig = field(default_factory=SuperpointsConfig)
    level: int = 0
    orient: Orientation = "auto"
    within: str | None = None
    table: str | None = None
    bytes_per_point: ClassVar[int] = 104
    """Space of a point in the largest of the layouts."""

    @property
    def root(self) -> Path:  # type: ignore[override]
        """The directory of the data set."""
        return self.data.root

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the scenes in natural order, whose results go to ``out``."""
        self.data.check_output(self.layout, out)
        for scene in self.data.scenes:
            what = scene.dataset or scene.name
            check_layout(self.layout, _dataset_of(scene), what)
        in_place = out == self.root
        return [
            scene._replace(
                files=self._inputs(scene, in_place), num_points=self.data.count_points(scene)
            )
            for scene in self.data.scenes
        ]

    def _inputs(self, scene: SceneFiles, in_place: bool) -> tuple[Path, ...]:
        """Return the files that decide the results of a scene."""
        if not (scene.path / "coord.npy").is_file():
            return scene.files
        # In place, only coordinates, and colors for superpoints, decide the added arrays.
        within = self.within or "coord"
        decisive = ("coord", *["color"] * self.superpoint, within, f"{within}20")
        used = decisive if in_place else SOURCE_ARRAYS
        return tuple(file for file in scene.files if file.stem in used)

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
        """Read a scene, segment it, and write its results, each file whole or not at all."""
        begin("read")
        with collecting_notes() as notes:
            cloud = self.data.read_scene(scan)
        notes += cloud.notes
        has_superpoints = self.superpoint or self.layout != "pointcept"
        seg, superpoints = segment_cloud(
            cloud,
            self.settings,
            orient=self.orient,
            partition=self.partition if has_superpoints else None,
            within=self.within,
            begin=begin,
            warn=notes.append,
        )
        notes += note_on_origin(self.layout, cloud)
        notes += note_on_copies(seg.num_copies, len(cloud))
        others = [name for name in cloud.fields if name != "color"]
        if others and scan.dataset is None:
            notes.append(f"left out: {', '.join(others)}")
        begin("write")
        what = (cloud, seg, superpoints)
        with collecting_notes() as more:
            files = write_scan(self.layout, scan, folder, *what, level=self.level)
        notes += [note for note in more if note not in notes]
        measured = self.settings.measured(seg.sampling)
        counts = (len(cloud), len(seg.planes))
        return TaskReport(
            scan.name, "converted", *counts, tuple(files), cloud.repairs, tuple(notes), measured
        )

    def __getstate__(self) -> Record:
        """Return what travels to other processes: each job has the scene it is about."""
        data = copy.copy(self.data)
        data.scenes = []
        return vars(self) | {"data": data}

    def describe(self) -> Record:
        """Return the kind of the source, and the settings that differ from their defaults."""
        kind = self.data.kind
        changed: Record = {"kind": kind, "superpoint": self.superpoint, "orient": self.orient}
        if self.layout != "pointcept":
            changed |= {"layout": self.layout, "version": layouts.VERSION}
        if (self.partition, self.level) != (SuperpointsConfig(), 0):
            partition = json.loads(json.dumps(dataclasses.asdict(self.partition)))
            changed |= {"partition": partition, "level": self.level}
        if self.within is not None:
            changed["within"] = self.within
        return changed | self.data.describe()

    def check_results(self, scans: Sequence[SceneFiles], out: Path) -> None:
        """Raise FormatError if a scan would write into files of another, or lists into others."""
        check_stems(self.layout, {scan.name: scan.place or scan.name for scan in scans})
        check_lists(self.layout, self._listed, out)

    def write_lists(self, out: Path, mark: str, *, without: Collection[Path] = ()) -> None:
        """Write what the layout has for the data set as a whole, from all scans in ``out``."""
        # A scan that is removed leaves the lists of all layouts that it was written in.
        for layout in layouts.LAYOUTS if without else (self.layout,):
            write_lists(layout, self._listed, out, mark, without=without)

    @property
    def _listed(self) -> str:
        """The data set whose lists its layouts have."""
        return "S3DIS" if self.data.kind == "s3dis" else "ScanNet"


def _dataset_of(scene: SceneFiles) -> str:
    """Return the data set as whose scenes layouts take one."""
    return "ScanNet" if scene.dataset is None else scene.dataset


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

    root: Path
    settings: DepthConfig
    layout: str
    intrinsics: Pinhole | None = None
    depth_scale: float | None = None
    orient: Orientation = "auto"
    table: str | None = None
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

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the frames in natural order."""
        check_outside(self.root, out)
        data = RGBDFrames.from_folder(
            self.root, self.layout, intrinsics=self.intrinsics, depth_scale=self.depth_scale
        )
        # A wrong scale is the same in all frames, and a warning helps before the work.
        with suppress(FormatError, OSError):
            data.read_sample(0)
        return [
            SceneFiles(
                frame.name,
                frame.depth,
                (frame.depth, *frame.sources),
                num_points=num_pixels(frame.depth),
                item=_plain(frame),
            )
            for frame in data.frames
        ]

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
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
