"""Sources of batch conversion: clouds and depth frames."""

import dataclasses
import json
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchrg.batch.scans import Source
from torchrg.batch.task import Begin, TaskReport, collecting_notes
from torchrg.config import PipelineConfig, SuperpointsConfig
from torchrg.datasets import layouts
from torchrg.datasets.folder import SceneDataset, SceneFiles
from torchrg.datasets.layouts import check_layout, check_stems, note_on_origin, write_scan
from torchrg.datasets.lists import check_lists, write_lists
from torchrg.datasets.pointcept import SOURCE_ARRAYS, write_results
from torchrg.datasets.provenance import Record
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import format_intrinsics, unproject_image
from torchrg.errors import FormatError
from torchrg.normals.orient import Orientation
from torchrg.pipeline.clouds import note_on_copies, segment_cloud
from torchrg.structures import Segmentation

__all__ = ["CloudSource", "RGBDSource"]
__dir__ = __all__.copy


@dataclass(frozen=True)
class CloudSource(Source):
    """Clouds of a data set, with their conversion settings and layout.

    Plain clouds become ``coord``, ``normal``, ``curvature`` and ``plane`` as ``.npy``, ``color``
    if there are colors, and ``planes.json``; coordinates are unchanged, including non-finite
    points. For scenes of a release or in Pointcept's layout, see
    :func:`torchrg.datasets.write_pointcept_scene`.

    Args:
        data: The data set.
        superpoint: Whether to write superpoints; every layout but ``"pointcept"`` includes them.
        layout: ``"pointcept"``, or a key of :data:`torchrg.datasets.layouts.LAYOUTS`.
        partition: Superpoint configuration.
        level: Superpoint level to write.
        orient: Orientation of normals; see :func:`torchrg.normals.orient_normals`.
        within: Array of objects that planes must not cross; see
            :func:`torchrg.pipeline.clouds.find_objects`. Default: planes may cross objects.
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
    """Disk space per point in the largest layout."""

    @property
    def num_levels(self) -> int:  # type: ignore[override]
        """Number of levels of superpoints into which conversion also partitions clouds."""
        return (self.superpoint or self.layout != "pointcept") * self.partition.num_levels

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the scenes in natural order; their results go to ``out``."""
        for scene in self.data.scenes:
            dataset = "ScanNet" if scene.dataset is None else scene.dataset
            check_layout(self.layout, dataset, scene.dataset or scene.name)
        in_place, count = out == self.root, self.data.count_points
        return [
            scene._replace(files=self._inputs(scene, in_place), num_points=count(scene))
            for scene in self.data.scenes
        ]

    def _inputs(self, scene: SceneFiles, in_place: bool) -> tuple[Path, ...]:
        """Return the files that determine the results of a scene."""
        if not (scene.path / "coord.npy").is_file():
            return scene.files
        # In place, only coordinates (and colors for superpoints) determine the added arrays.
        within = self.within or "coord"
        inputs = ("coord", *["color"] * self.superpoint, within, f"{within}20")
        used = inputs if in_place else SOURCE_ARRAYS
        return tuple(file for file in scene.files if file.stem in used)

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
        """Read a scene, segment it, and write its results, each file atomically."""
        begin("read")
        with collecting_notes() as notes:
            cloud = self.data.read_scene(scan)
        notes += cloud.notes
        seg, superpoints = segment_cloud(
            cloud,
            self.settings,
            orient=self.orient,
            partition=self.partition if self.num_levels else None,
            within=self.within,
            begin=begin,
            warn=notes.append,
        )
        notes += note_on_origin(self.layout, cloud)
        notes += note_on_copies(seg.num_copies, len(cloud))
        skipped = [name for name in cloud.fields if name != "color"]
        if skipped and scan.dataset is None:
            notes.append(f"left out: {', '.join(skipped)}")
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

    def describe(self) -> Record:
        """Return the type of the source, and the settings that differ from their defaults."""
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
        """Raise FormatError if two scans, or lists of other origin, would be overwritten."""
        check_stems(self.layout, {scan.name: scan.release_path or scan.name for scan in scans})
        check_lists(self.layout, self._list_dataset, out)

    def write_lists(self, out: Path, *, without: Collection[Path] = ()) -> None:
        """Write the layout's data-set-wide files from all scans in ``out``."""
        write_lists(self.layout, self._list_dataset, out, without=without)

    @property
    def _list_dataset(self) -> str:
        """Data set that determines the lists."""
        return "S3DIS" if self.data.kind == "s3dis" else "ScanNet"


@dataclass(frozen=True)
class RGBDSource(Source):
    """Depth frames of a folder.

    Files per frame, all of its height and width: ``coord`` ``(H, W, 3)``, ``normal``
    ``(H, W, 3)``, ``curvature`` and ``plane`` ``(H, W)`` as ``.npy``, and ``planes.json``.
    Coordinates are in the world if the pose is known, else in the camera; zero without depth.

    Args:
        data: The frames of a folder; see :meth:`torchrg.datasets.RGBDFrames.from_folder`.
        orient: Orientation of normals; see :func:`torchrg.depth.segment_depth`.
    """

    data: RGBDFrames
    settings: DepthConfig
    _: KW_ONLY
    orient: Orientation = "auto"
    table: str | None = None
    bytes_per_point: ClassVar[int] = 12 + 12 + 4 + 4
    unit: ClassVar[str] = "frame"
    seconds_per_million: ClassVar[tuple[float, str]] = (0.4, "pixels")
    """Measured on frames of 640 x 480 pixels, 0.12 s each (``scripts/bench.py steady``)."""

    def describe(self) -> Record:
        """Return the type of the source and its options that affect results."""
        return {"kind": self.data.kind, "orient": self.orient} | self.data.describe()

    def list_scans(self, out: Path) -> list[SceneFiles]:
        """Return the frames in natural order."""
        # A wrong scale affects all frames, so warn before the work.
        with suppress(FormatError, OSError):
            self.data.read_sample(0)
        count = self.data.count_points
        return [
            scene._replace(
                files=tuple(file for file in scene.files if file != scene.item.color),
                num_points=count(scene),
            )
            for scene in self.data.scenes
        ]

    def convert(self, scan: SceneFiles, folder: Path, begin: Begin) -> TaskReport:
        """Read a frame, segment it, and write its results, each file atomically."""
        begin("read")
        frame: RGBDFrame = scan.item
        with collecting_notes() as notes:
            depth = frame.read_depth()
        if not bool((depth > 0).any()):
            raise FormatError(f"{frame.depth}: expected pixels with depth, got none; remove it.")
        begin("planes")
        seg = segment_depth(
            depth, frame.intrinsics, self.settings, pose=frame.pose, orient=self.orient
        )
        points = unproject_image(depth, frame.intrinsics, frame.pose)
        begin("write")
        files = tuple(write_frame(folder, depth, points, seg))
        num_planes = len(seg.planes)
        notes += [] if num_planes else ["no plane found"]
        measured = {
            "intrinsics": format_intrinsics(frame.intrinsics),
            "camera": frame.origin,
            "depth_scale": frame.depth_scale,
            "pose": "camera" if frame.pose is None else "world",
        }
        counts = (depth.numel(), num_planes)
        return TaskReport(
            scan.name, "converted", *counts, files, warnings=tuple(notes), measured=measured
        )


def write_frame(folder: Path, depth: Tensor, points: Tensor, seg: Segmentation) -> list[str]:
    """Write a frame ``(H, W)`` and its points ``(H, W, 3)``; see :func:`write_results`.

    Pixels without depth are zero.
    """
    coord = torch.where(depth[..., None] > 0, points, 0.0).float().numpy()
    return write_results(folder, coord, seg)
