"""The kinds of data sets that are converted.

A new kind is a :class:`~torchrg.batch.scans.Source` here, its arguments in ``torchrg.cli.convert``,
and a test.
"""

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._optional import require
from torchrg.batch.scans import Scan, check_finite, write_results
from torchrg.batch.task import Converted
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
    write_pointcept_scene,
)
from torchrg.datasets.folder import folded_name
from torchrg.datasets.layouts import LayoutScan, check_layout, stem_of, write_layout
from torchrg.datasets.lists import check_lists, write_lists
from torchrg.datasets.pointcept import GIVEN_ARRAYS
from torchrg.datasets.rgbd import RGBDFrame, RGBDFrames
from torchrg.datasets.rgbd_files import num_pixels, read_depth
from torchrg.datasets.scannet import MESH_PLUSPLUS, read_objects
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import make_intrinsics, points_of_image
from torchrg.errors import ConfigError, FormatError
from torchrg.io import FORMATS, estimate_points, read_cloud, takes_columns
from torchrg.io.npy import map_folder
from torchrg.normals.sides import CloudOrientation, check_viewpoint, orient_cloud
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.structures import Cloud, Segmentation

_COPIED = tuple(name for name in GIVEN_ARRAYS if name != "normal")
"""Arrays of a folder in Pointcept's layout that go along with its results."""


@dataclass(frozen=True, kw_only=True)
class CloudSource:
    """What sources of clouds share: what is written of each, and in which layout.

    Args:
        superpoint: Whether superpoints are written too; every layout but ``"pointcept"`` has them.
        layout: ``"pointcept"``, or a key of :data:`torchrg.datasets.layouts.LAYOUTS`.
        partition: How superpoints are made.
        level: Which of their levels is written.
        orient: To which side normals point; see :func:`torchrg.normals.orient_cloud`.
    """

    superpoint: bool = False
    layout: str = "pointcept"
    partition: SuperpointsConfig = field(default_factory=SuperpointsConfig)
    level: int = 0
    orient: CloudOrientation = "auto"
    bytes_per_point: ClassVar[int] = 104
    """What the largest of the layouts takes."""
    dataset: ClassVar[str] = "ScanNet"
    """The data set whose layouts it has; clouds without labels are written as those of ScanNet."""

    @property
    def has_superpoints(self) -> bool:
        """Whether superpoints are made."""
        return self.superpoint or self.layout != "pointcept"

    def described(self, **options: Any) -> dict[str, Any]:  # noqa: ANN401
        """Return these settings, as far as they are not the usual ones, after others."""
        described = {**options, "superpoint": self.superpoint}
        if self.orient != "none":
            described["orient"] = self.orient
        if self.layout != "pointcept":
            described |= {"layout": self.layout, "version": layouts.VERSION}
        if (self.partition, self.level) != (SuperpointsConfig(), 0):
            described |= {"partition": dataclasses.asdict(self.partition), "level": self.level}
        return json.loads(json.dumps(described))  # type: ignore[no-any-return]

    def checked(self, scans: list[Scan]) -> list[Scan]:
        """Return scans if none of them would write into the files of another.

        See :func:`torchrg.datasets.folder.folded_name`.
        """
        taken: dict[str, str] = {}
        for scan in scans if self.layout != "pointcept" else ():
            stem = stem_of(self.layout, scan.name, _place(scan))
            other = taken.setdefault(folded_name(stem), scan.name)
            if other != scan.name:
                raise FormatError(
                    f"expected files of its own for each scan, got {stem} for {other} and "
                    f"{scan.name} in layout {self.layout}; rename one, or choose layout pointcept."
                )
        return scans

    def check_lists(self, out: Path) -> None:
        """Raise FormatError if :meth:`write_lists` would replace files from elsewhere."""
        check_lists(self.layout, self.dataset, out)

    def write_lists(self, out: Path, mark: str) -> None:
        """Write what the layout has for the data set as a whole, from all scans in ``out``."""
        write_lists(self.layout, self.dataset, out, mark)

    def segment(
        self,
        cloud: Cloud,
        settings: PipelineConfig,
        colors: Tensor | NDArray[np.generic] | None,
        begin: Callable[[str], None],
    ) -> tuple[Segmentation, NDArray[np.int32] | None]:
        """Return the planes of a cloud, its normals turned, and its superpoints if wanted."""
        check_viewpoint(cloud, self.orient, "use --orient interior")
        seg = segment_planes(
            cloud.points, settings, on_stage=begin, keep_neighbors=self.has_superpoints
        )
        parts = self._part(cloud, seg, colors, begin)
        begin("orientation")
        return seg._replace(normals=orient_cloud(cloud, seg.normals, self.orient)), parts

    def _part(
        self,
        cloud: Cloud,
        seg: Segmentation,
        colors: Tensor | NDArray[np.generic] | None,
        begin: Callable[[str], None],
    ) -> NDArray[np.int32] | None:
        """Return the superpoint of each point of a cloud, None where they are not wanted."""
        if not self.has_superpoints:
            return None
        begin("superpoints")
        found = make_superpoints(cloud.points, seg, self.partition, colors=colors)
        return [*found.by_level().values()][self.level]

    def write(
        self,
        scan: Scan,
        folder: Path,
        cloud: Cloud,
        given: Mapping[str, Any],
        seg: Segmentation,
        parts: NDArray[np.int32] | None,
        **more: Any,  # noqa: ANN401
    ) -> list[str]:
        """Write what is ``given`` of each point, and what was found, in the layout.

        ``more`` is what :class:`torchrg.datasets.layouts.LayoutScan` has beside.
        """
        if self.layout == "pointcept" or parts is None:
            origin = cloud.origin.tolist()
            return write_pointcept_scene(folder, given, seg, superpoint=parts, origin=origin)
        split, name = layouts.split_name(scan.name)
        parted = LayoutScan(
            name,
            split,
            _place(scan),
            coord=cloud.points.numpy(),
            normal=seg.normals.numpy(),
            superpoint=parts,
            plane=seg.labels.numpy(),
            given={name: np.asarray(values) for name, values in given.items()},
            **{"dataset": self.dataset, **more},
        )
        out = folder.parents[scan.name.count("/")]
        return write_layout(self.layout, folder, out, parted, seg.planes, cloud.origin)

    def notes(self, cloud: Cloud) -> tuple[str, ...]:
        """Return what a user should know about a cloud in the layout."""
        if self.layout == "pointcept" or not cloud.origin.any():
            return ()
        place = " ".join(f"{value:.12g}" for value in cloud.origin)
        return (f"coordinates are written about {place}, as they are far from the origin",)


def _place(scan: Scan) -> str:
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
        root: The folder.
        settings: How to segment.
        out: Where results go. ``root`` itself completes folders in Pointcept's layout in place;
            no other folder below it can be.
        columns: Names for the columns of text and of bare ``.npy`` arrays; see
            :func:`torchrg.read_cloud`.
        suffixes: Which files are clouds. Default: all that can be read.
    """

    root: Path
    settings: PipelineConfig
    out: Path
    columns: tuple[str, ...] | None = None
    suffixes: tuple[str, ...] = tuple(FORMATS)

    @property
    def in_place(self) -> bool:
        """Whether results go into the folders of the clouds."""
        return self.out == self.root

    def describe(self) -> dict[str, Any]:
        """Return the kind and what else decides results."""
        described = self.described(kind="folder")
        return described if self.columns is None else described | {"columns": list(self.columns)}

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
        return self.checked([self._scan(scene) for scene in scenes])

    def _scan(self, scene: SceneFiles) -> Scan:
        """Return a cloud with its input files."""
        if not scene.path.is_dir():
            return Scan(scene.name, (scene.path,), estimate_points(scene.path))
        # In place, nothing but the coordinates, for superpoints the colours, decides what is added.
        decisive = ("coord", "color") if self.superpoint else ("coord",)
        used = decisive if self.in_place else _COPIED
        files = tuple(file for file in scene.files if file.stem in used)
        return Scan(scene.name, files, estimate_points(scene.path / "coord.npy"))

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one cloud."""
        begin("read")
        first = scan.inputs[0]
        is_file = first.parent.relative_to(self.root).as_posix() != scan.name
        if is_file:
            cloud = read_cloud(first, columns=self.columns if takes_columns(first) else None)
            given = {name: cloud.fields[name] for name in cloud.fields.keys() & {"color"}}
        else:
            sample, given = read_pointcept_scene(first.parent), map_folder(first.parent, _COPIED)
            # Pointcept's colours are 0 to 255 in any type.
            colors = {n: sample[n].clamp(0, 255).byte().numpy() for n in sample.keys() & {"color"}}
            cloud = Cloud(sample["coord"].numpy(), colors, source=str(first.parent))
        warnings = (*cloud.notes, *check_finite(cloud), *self.notes(cloud))
        color = cloud.fields.get("color")
        seg, parts = self.segment(cloud, self.settings, color, begin)
        begin("write")
        if is_file:
            others = [name for name in cloud.fields if name != "color"]
            warnings += (f"left out: {', '.join(others)}",) if others else ()
        if is_file and self.layout == "pointcept":
            found = {"color": color, "superpoint": parts}
            fields = {name: values for name, values in found.items() if values is not None}
            origin = cloud.origin.tolist()
            files = write_results(folder, cloud.coordinates, seg, fields=fields, origin=origin)
        else:
            dataset = _dataset(given.keys())
            files = self.write(scan, folder, cloud, given, seg, parts, dataset=dataset)
        return Converted(len(cloud), len(seg.planes.count), tuple(files), warnings=warnings)


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
        root: The folder that holds ``Area_1`` to ``Area_6``.
        settings: How to segment.
        areas: Numbers of the areas.
        class_order: Meaning of the numbers in ``segment``; see :class:`torchrg.datasets.S3DIS`.
            Other layouts than Pointcept's have its order.
    """

    root: Path
    settings: PipelineConfig
    areas: tuple[int, ...]
    class_order: str = "pointcept"
    in_place: ClassVar[bool] = False
    dataset: ClassVar[str] = "S3DIS"

    def describe(self) -> dict[str, Any]:
        """Return the kind and what else decides results."""
        return self.described(kind="s3dis", class_order=self.class_order)

    def list_scans(self) -> list[Scan]:
        """Return the rooms in natural order; warn if an area has not as many as the release."""
        check_layout(self.layout, self.dataset, self.dataset)
        if self.layout != "pointcept" and self.class_order != "pointcept":
            raise ConfigError(
                f"expected --class-order with --layout pointcept, got layout {self.layout}, which "
                "has the order pointcept; leave it out."
            )
        require("pyarrow", extra="s3dis", purpose="read S3DIS")
        rooms = S3DIS(self.root, self.areas, class_order=self.class_order)
        return self.checked(
            [Scan(scene.name, scene.files, _estimate(scene)) for scene in rooms.scenes]
        )

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one room."""
        begin("read")
        room = read_room(self.root / scan.name, class_order=self.class_order)
        cloud = Cloud(room.coord, source=scan.name)
        notes = (*check_finite(cloud), *self.notes(cloud), *room.notes)
        seg, parts = self.segment(cloud, self.settings, room.color, begin)
        begin("write")
        arrays = {name: getattr(room, name) for name in ("coord", "color", "segment", "instance")}
        files = self.write(scan, folder, cloud, arrays, seg, parts)
        return Converted(len(cloud), len(seg.planes.count), tuple(files), room.repairs, notes)


@dataclass(frozen=True)
class ScanNetSource(CloudSource):
    """The scans of ScanNet or ScanNet++; see :class:`torchrg.datasets.ScanNet`.

    Writes ``OUT/<split>/<scan>`` as :func:`torchrg.datasets.write_pointcept_scene` does.

    Args:
        root: The folder that holds ``scans`` or ``data``.
        settings: How to segment.
    """

    root: Path
    settings: PipelineConfig
    in_place: ClassVar[bool] = False

    def describe(self) -> dict[str, Any]:
        """Return the kind and what else decides results."""
        return self.described(kind="scannet")

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
        return self.checked(scans)

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one scan."""
        begin("read")
        mesh = scan.inputs[0]
        given = read_scannet_scan(mesh, self.root)
        cloud = Cloud(given["coord"], source=str(mesh), front=given.pop("front", None))
        dataset, objects = _dataset_of_mesh(mesh), None
        if self.layout == "scannet" and dataset == "ScanNet":
            objects = read_objects(mesh, len(cloud))
        notes = (*check_finite(cloud), *self.notes(cloud))
        if "instance" not in given and not scan.name.startswith("test/"):
            notes += ("no labels: annotations or the table of their words are missing",)
        seg, parts = self.segment(cloud, self.settings, given.get("color"), begin)
        begin("write")
        more = {"dataset": dataset, "objects": objects}
        files = self.write(scan, folder, cloud, given, seg, parts, **more)
        return Converted(len(cloud), len(seg.planes.count), tuple(files), warnings=notes)


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
class RGBDSource:
    """The depth frames of a folder.

    Files of each frame, all of its height and width: ``coord`` ``(H, W, 3)``, ``normal``
    ``(H, W, 3)``, ``curvature`` and ``plane`` ``(H, W)`` as ``.npy``, and ``planes.json``. In world
    coordinates where the pose is known, else in camera coordinates; pixels without depth have zeros
    and plane -1.

    Args:
        root: The folder.
        settings: How to segment.
        layout: Its shape; see :meth:`torchrg.datasets.RGBDFrames.from_folder`.
        intrinsics: ``fx, fy, cx, cy``. Default: the layout's.
        depth_scale: Stored value of one metre. Default: the layout's.
        compile: Whether to run kernels compiled.
        orient: To which side normals point: to the camera, unless it says ``"interior"`` or
            ``"up"``.
    """

    root: Path
    settings: DepthConfig
    layout: str
    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None
    compile: bool = False
    orient: CloudOrientation = "auto"
    in_place: ClassVar[bool] = False
    bytes_per_point: ClassVar[int] = 12 + 12 + 4 + 4

    def describe(self) -> dict[str, Any]:
        """Return the kind and what else decides results."""
        return {
            "kind": "rgbd",
            "layout": self.layout,
            "intrinsics": self.intrinsics,
            "depth_scale": self.depth_scale,
            **({"compile": True} if self.compile else {}),
            **({"orient": self.orient} if self.turns else {}),
        }

    @property
    def turns(self) -> bool:
        """Whether normals shall point elsewhere than to the camera."""
        return self.orient in ("interior", "up")

    def turned(self, seg: Segmentation, points: Tensor) -> Segmentation:
        """Return a segmentation of an image, of these points ``(H, W, 3)``, with turned normals."""
        if not self.turns:
            return seg
        cloud = Cloud(points.reshape(-1, 3).numpy())
        normals = orient_cloud(cloud, seg.normals.view(-1, 3), self.orient)
        return seg._replace(normals=normals.view_as(seg.normals))

    def list_scans(self) -> list[Scan]:
        """Return the frames in natural order."""
        matrix = None if self.intrinsics is None else make_intrinsics(*self.intrinsics)
        data = RGBDFrames.from_folder(
            self.root, self.layout, intrinsics=matrix, depth_scale=self.depth_scale
        )
        return [
            Scan(frame.name, (frame.depth, *frame.sources), num_pixels(frame.depth), _plain(frame))
            for frame in data.frames
        ]

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one frame."""
        begin("read")
        frame = _frame(scan.item)
        depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
        if not bool((depth > 0).any()):
            raise FormatError(f"{frame.depth}: expected pixels with depth, got none.")
        begin("planes")
        found = segment_depth(
            depth, frame.intrinsics, self.settings, pose=frame.pose, compile=self.compile
        )
        points = points_of_image(depth, frame.intrinsics, frame.pose)
        found = self.turned(found, points)
        coord = torch.where(depth[..., None] > 0, points, 0.0).float().numpy()
        begin("write")
        files = write_results(folder, coord, found)
        num_points, num_planes = depth.numel(), len(found.planes.count)
        notes = () if num_planes else ("no plane found",)
        return Converted(num_points, num_planes, tuple(files), warnings=notes)


def _plain(frame: RGBDFrame) -> dict[str, Any]:
    """Return a frame as plain values."""
    pose = None if frame.pose is None else frame.pose.tolist()
    return vars(frame) | {"intrinsics": frame.intrinsics.tolist(), "pose": pose}


def _frame(values: dict[str, Any]) -> RGBDFrame:
    """Return the frame that plain values describe."""
    matrices = {
        name: None if values[name] is None else torch.tensor(values[name], dtype=torch.float64)
        for name in ("intrinsics", "pose")
    }
    return RGBDFrame(**(values | matrices))
