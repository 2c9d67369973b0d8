"""Data set of depth frames with cameras, poses and colors."""

import math
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg.datasets import rgbd_files
from torchrg.datasets.camera_files import find_camera
from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform
from torchrg.datasets.rgbd_layouts import FRAME_LAYOUTS, find_layout, find_recordings
from torchrg.depth.camera import Pinhole, check_camera, describe_improbable_view, unproject_image
from torchrg.depth.values import DepthKind, check_conversion
from torchrg.errors import ConfigError, DepthWarning, FormatError, ShapeError, warn
from torchrg.io.files import local_path, wrap_errors
from torchrg.linalg.rigid import check_rigid
from torchrg.structures import FARTHEST, Cloud
from torchrg.structures.points import short_repr
from torchrg.transforms.depth import fuse_depth
from torchrg.transforms.rows import SampleDict


@short_repr
@dataclass(frozen=True, eq=False, repr=False)
class RGBDFrame:
    """Depth frame on disk.

    Args:
        depth: Depth image: 16-bit gray PNG or PGM, OpenEXR, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the center of pixel (0, 0) is at (0, 0).
        depth_scale: Depth units per meter: 1000 for millimeters, 5000 for TUM, 1 for meters.
        name: Unique name within a data set, usable as a path below an output folder, with forward
            slashes: ``scene0000_00/12``.
        color: Color image registered to the depth, PNG or JPEG, or None.
        pose: Camera-to-world matrix, shape ``(4, 4)``, or None.
        depth_kind: ``"z"`` for depth, ``"ray"`` for distances from the camera center.
        sources: Further files that intrinsics and pose were read from.
        origin: Description of where the intrinsics come from.
        confidence: Gray image of the size of the depth, PNG, or None. Pixels of confidence 0 have
            no depth.
        recording: Name of the recording with the frame, or "".

    Raises:
        ShapeError: If a matrix has a wrong shape, or the pose is no rigid motion.
        ConfigError: If ``depth_scale`` is not positive.
    """

    depth: Path
    intrinsics: Tensor
    depth_scale: float
    name: str = ""
    color: Path | None = None
    pose: Tensor | None = None
    depth_kind: DepthKind = "z"
    sources: tuple[Path, ...] = ()
    origin: str = ""
    confidence: Path | None = None
    recording: str = ""

    def __post_init__(self) -> None:
        check_shapes("RGBDFrame", intrinsics=(self.intrinsics, "3 3"), pose=(self.pose, "4 4"))
        check_camera("RGBDFrame", self.intrinsics)
        check_rigid("RGBDFrame", "pose", self.pose)
        check_conversion("RGBDFrame", self.depth_scale, self.depth_kind)

    def __getstate__(self) -> dict[str, Any]:
        """Return plain values, because other processes would share the memory of tensors."""
        return {k: v.tolist() if isinstance(v, Tensor) else v for k, v in vars(self).items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        matrices = {k: torch.tensor(v).double() for k, v in state.items() if isinstance(v, list)}
        vars(self).update(state | matrices)

    @property
    def files(self) -> tuple[Path, ...]:
        """All input files: images, and the files of intrinsics and pose."""
        images = (self.depth, self.color, self.confidence)
        return (*(image for image in images if image is not None), *self.sources)

    def read_depth(self) -> Tensor:
        """Return the depth in meters along the optical axis, shape ``(H, W)``, float32."""
        options = (self.depth_scale, self.depth_kind, self.intrinsics, self.confidence)
        return rgbd_files.read_depth(self.depth, *options)


class RGBDFrames(SceneDataset):
    """Depth frames, read on demand.

    A sample has

    * ``depth``: float32, shape ``(1, H, W)``, in meters along the optical axis; 0 for no depth;
    * ``intrinsics``: float64, shape ``(3, 3)``;
    * ``pose``: float64, shape ``(4, 4)``, camera to world; absent if unknown;
    * ``color``: uint8, shape ``(3, H, W)``, in the size of the color image; absent without one;
    * ``name``: name of the frame.

    torch's ``default_collate`` can batch frames of one size.

    Args:
        frames: The frames, in order.
        transform: Applied to each sample, for example :class:`torchrg.transforms.SegmentDepth`.

    Attributes:
        scenes: Name, depth image and all input files of each frame, which is its ``item``.

    Raises:
        ConfigError: If two frames have the same name, or ``frames`` is a folder.

    Example:
        >>> import numpy as np, tempfile
        >>> from pathlib import Path
        >>> folder = Path(tempfile.mkdtemp())
        >>> np.save(folder / "a.npy", np.full((4, 6), 1500))
        >>> frame = RGBDFrame(folder / "a.npy", torch.eye(3), depth_scale=1000, name="a")
        >>> sample = RGBDFrames([frame])[0]
        >>> sample["depth"].shape, float(sample["depth"][0, 0, 0]), sorted(sample)
        (torch.Size([1, 4, 6]), 1.5, ['depth', 'intrinsics', 'name'])
    """

    kind = "rgbd"
    options: Mapping[str, Any] = MappingProxyType({})
    """Arguments of :meth:`from_folder` that affect the samples."""

    def __init__(self, frames: Sequence[RGBDFrame], *, transform: Transform | None = None) -> None:
        is_path = isinstance(frames, os.PathLike)
        if is_path or not all(isinstance(frame, RGBDFrame) for frame in frames):
            raise ConfigError(
                f"RGBDFrames: expected a list of RGBDFrame, got {frames!r:.60}; use "
                "RGBDFrames.from_folder for a folder."
            )
        self.transform = transform
        self.scenes = [SceneFiles(f.name, f.depth, f.files, item=f) for f in frames]
        first: dict[str, Path] = {}
        for number, (name, path, *_) in enumerate(self.scenes):
            first.setdefault(name, path)
            if len(first) <= number:
                raise ConfigError(
                    f"RGBDFrames: expected distinct frame names, got {name!r} twice, for "
                    f"{first[name]} and {path}; move or rename one."
                )

    @classmethod
    def from_folder(
        cls,
        root: str | os.PathLike[str],
        layout: str = "auto",
        *,
        intrinsics: Tensor | Pinhole | None = None,
        depth_scale: float | None = None,
        depth_kind: DepthKind = "z",
        transform: Transform | None = None,
    ) -> "RGBDFrames":
        """Find the frames of a folder.

        Args:
            root: The folder of one recording, or of several.
            layout: A key of :data:`~torchrg.datasets.rgbd_layouts.FRAME_LAYOUTS`, such as ``tum``,
                or ``images`` for any folder of depth images. Default: detected from the folder.
            intrinsics: Camera matrix, shape ``(3, 3)``, or a camera of images of another size.
                Default: from the frames or a camera file next to them, else the built-in camera of
                ``tum`` and ``7-scenes``.
            depth_scale: Depth units per meter. Default: from the camera file, else the layout's;
                ``images`` and ``.npy`` have no default.
            depth_kind: ``"ray"`` for distances from the camera center. Default: ``"z"``, depth.
            transform: Applied to each sample.

        Returns:
            The data set, with frames in natural order.

        Raises:
            ConfigError: If the layout is unknown, needs intrinsics or a scale, or a camera cannot
                belong to an image.
            FormatError: If the folder contains no such frames, or a file is corrupt.

        Warns:
            DepthWarning: If a camera is built in, or implausible for an image, if the depth unit
                is the layout's and the camera is not, or frames lack poses that others have.
        """
        folder = local_path(root)
        if folder.is_file():
            rgbd_files.refuse_form(folder, folder.suffix.lower())
            raise FormatError(f"{root}: expected a folder of frames, got a file; pass its folder.")
        name = find_layout(folder) if layout == "auto" else layout
        if name not in FRAME_LAYOUTS:
            names = ", ".join(sorted(FRAME_LAYOUTS))
            raise ConfigError(f"RGBDFrames: expected layout to be one of {names}, got {layout!r}.")
        camera = intrinsics
        if camera is not None and not isinstance(camera, Pinhole):
            matrix = as_tensor("RGBDFrames", "intrinsics", camera)
            check_shapes("RGBDFrames", intrinsics=(matrix, "3 3"))
            check_camera("RGBDFrames", matrix)
            camera = Pinhole(*matrix.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
        frames = _find_frames(folder, name, camera, depth_scale, depth_kind)
        if not frames:
            suffixes = " ".join(rgbd_files.DEPTH_SUFFIXES)
            raise FormatError(f"{root}: expected depth images ({suffixes}), got none.")
        data = cls(frames, transform=transform)
        data.root = folder
        data.options = {"layout": name, "intrinsics": camera, "depth_scale": depth_scale} | (
            {} if depth_kind == "z" else {"depth_kind": depth_kind}
        )
        return data

    @property
    def frames(self) -> tuple[RGBDFrame, ...]:
        """The frames."""
        return tuple(scene.item for scene in self.scenes)

    def describe(self) -> dict[str, Any]:
        """Return the JSON-serializable parameters that affect the samples."""
        return dict(self.options)

    def count_points(self, scene: SceneFiles) -> int:
        """Return the number of pixels of a frame."""
        return rgbd_files.num_pixels(scene.path)

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the pixels of a frame as an organized cloud, with its front towards the camera.

        Coordinates are in the world if the pose is known. Pixels without depth are NaN.
        """
        frame: RGBDFrame = scene.item
        depth = frame.read_depth()
        points = unproject_image(depth, frame.intrinsics, frame.pose)
        center = points.new_zeros(3) if frame.pose is None else frame.pose[:3, 3].to(points)
        points = torch.where(depth[..., None] > 0, points, torch.nan).view(-1, 3)
        front = (center - points).nan_to_num(0.0).float().numpy()
        height, width = depth.shape
        shape = (height, width)
        return Cloud(points.numpy(), grid_shape=shape, source=f"{frame.depth}", front=front)

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a frame.

        Raises:
            FormatError: If a file is missing, corrupt, or not a depth image.
        """
        frame: RGBDFrame = self.scenes[index].item
        sample: SampleDict = {
            "depth": frame.read_depth()[None],
            "intrinsics": frame.intrinsics.to(torch.float64),
            "name": frame.name,
        }
        if frame.pose is not None:
            sample["pose"] = frame.pose.to(torch.float64)
        if frame.color is not None:
            sample["color"] = rgbd_files.read_color(frame.color)
        return sample


class FusedRecordings(SceneDataset):
    """Recordings in a folder of frames, each fused into one cloud, without frames without a pose.

    Args:
        data: Result of :meth:`RGBDFrames.from_folder`.
        voxel_size: Voxel size in meters; see :func:`torchrg.transforms.fuse_depth`.
        max_depth: Maximum depth, in meters. Default: no limit.
    """

    kind = "rgbd-fused"

    def __init__(self, data: RGBDFrames, voxel_size: float, max_depth: float | None = None) -> None:
        self.root, groups = data.root, defaultdict[str, list[RGBDFrame]](list)
        self.options = {**data.options, "voxel_size": voxel_size, "max_depth": max_depth}
        for frame in data.frames:
            groups[frame.recording or self.root.resolve().name].append(frame)
        files = {k: dict.fromkeys(f for frame in v for f in frame.files) for k, v in groups.items()}
        self.scenes = [SceneFiles(k, v[0].depth, (*files[k],), item=v) for k, v in groups.items()]

    def count_points(self, scene: SceneFiles) -> int:
        """Return the number of pixels of a recording."""
        return sum(rgbd_files.num_pixels(frame.depth) for frame in scene.item)

    def describe(self) -> dict[str, Any]:
        """Return the JSON-serializable parameters that affect the clouds."""
        return self.options

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return a cloud, its front towards the cameras; ``images`` maps labels to named frames."""
        frames = [frame for frame in scene.item if frame.pose is not None]
        if not frames:
            raise FormatError(f"{scene.name}: expected frames with poses, got none; omit --fuse.")
        limit = self.options["max_depth"] or math.inf
        depths = ((sample, sample["depth"]) for sample in RGBDFrames(frames))
        near = (sample | {"depth": depth * (depth <= limit)} for sample, depth in depths)
        fused = fuse_depth(near, voxel_size=self.options["voxel_size"])
        centers = torch.stack([frame.pose[:3, 3] for frame in frames])[fused.frame]
        fields = {} if fused.color is None else {"color": fused.color.numpy()}
        coord, front = fused.coord.numpy(), (centers - fused.coord).float().numpy()
        names = [frame.name.removeprefix(f"{scene.name}/") for frame in frames]
        images = {"images": lambda labels: zip(names, fused.to_frames(labels), strict=True)}
        return Cloud(coord, fields, source=scene.name, front=front, header=images)


def _find_frames(
    root: Path, name: str, camera: Pinhole | None, depth_scale: float | None, kind: DepthKind
) -> list[RGBDFrame]:
    """Return the frames of a folder of one or several recordings; ``camera`` is the user's.

    Warns:
        DepthWarning: See :meth:`RGBDFrames.from_folder`; once per kind, of cameras per recording.
    """
    layout, frames, is_posed = FRAME_LAYOUTS[name], list[RGBDFrame](), False
    signs = layout.signs
    notes: dict[object, str] = {}
    for prefix, folder in find_recordings(root, layout):
        shared: dict[Path, tuple[Pinhole | None, tuple[Path, ...]]] = {}
        for frame in layout.frames(folder):
            images, chosen, files = frame.depth.parent, camera, tuple[Path, ...]()
            if camera is None and frame.camera is not None:
                chosen, files = frame.camera, frame.sources[:1]
            elif camera is None:
                if images not in shared:
                    found = find_camera(images, root)
                    lower = folder.resolve().name.lower()
                    matches = (known for part, known in layout.cameras.items() if part in lower)
                    built_in = None if found else next(matches, None)
                    shared[images] = (found[0], found[1:]) if found else (built_in, ())
                chosen, files = shared[images]
            origin = files[0].name if files else "given" if camera else f"built in, {name}"
            scales = (depth_scale, *(c.depth_scale for c in (chosen, frame.camera) if c))
            scale = next((value for value in scales if value is not None), None)
            is_array = frame.depth.suffix.lower() in (".npy", ".exr")
            assumed = layout.array_scale if is_array else layout.depth_scale
            is_assumed = scale is None and assumed is not None
            scale = assumed if is_assumed else scale
            is_known = chosen is frame.camera or any(f.match(sign) for f in files for sign in signs)
            if chosen is None or scale is None:
                missing, example = "depth_scale", "1000 for millimeters"
                if chosen is None:
                    missing, example = "intrinsics", "fx,fy,cx,cy or a camera file"
                raise ConfigError(
                    f"{frame.depth}: expected {missing}, which images lack; pass it "
                    f"(--{missing.replace('_', '-')}), {example}."
                )
            if not camera and not files:
                numbers = ",".join(f"{number:g}" for number in chosen[:4])
                notes["camera"] = (
                    f"{root}: using the built-in camera of {name}, {numbers}, for frames without a "
                    "camera file; pass --intrinsics if they have another."
                )
            elif is_assumed and not is_known:
                notes["unit"] = (
                    f"{root}: using the depth unit of {name}, {scale:g} units per meter, with a "
                    f"camera of other origin ({origin}); pass --depth-scale (depth_scale), 1000 "
                    "for millimeters."
                )
            matrix, doubt = scale_camera(frame.depth, chosen, *files[:1])
            notes[folder] = notes.get(folder) or doubt
            pose, files = frame.pose, tuple(dict.fromkeys((*files, *frame.sources)))
            pose = pose if pose is None or layout.axes is None else pose @ layout.axes
            if pose is not None and not bool((pose.abs() <= FARTHEST).all()):
                pose = None  # Tracking was lost.
            options = (prefix + frame.name, frame.color, pose, kind, files, origin)
            with wrap_errors(f"{[root, *files][-1]}: ", ShapeError):
                check_rigid(frame.name, "pose", pose)
            more = (frame.confidence, prefix[:-1])
            frames.append(RGBDFrame(frame.depth, matrix, scale, *options, *more))
            is_posed |= frame.pose is not None or frame.camera is not None
    num_lost = sum(frame.pose is None for frame in frames)
    if num_lost and is_posed:
        notes["pose"] = (
            f"{root}: {num_lost:,} of {len(frames):,} frames have no pose; their results are in "
            "camera coordinates, and --fuse leaves them out."
        )
    for note in filter(None, notes.values()):
        warn(note, DepthWarning)
    return frames


def scale_camera(image: Path, camera: Pinhole, file: Path | None = None) -> tuple[Tensor, str]:
    """Return the camera matrix for a depth image, and a warning if it is implausible.

    Args:
        image: The depth image. Its size is ignored if it is too large to be read.
        camera: The camera.
        file: File of the camera, for messages.

    Raises:
        ConfigError: If the camera cannot belong to the image.
    """
    caller = f"{image}" if file is None else f"{image}: {file.name}"
    size = rgbd_files.image_size(image)
    size = None if size and math.prod(size) > rgbd_files.MAX_PIXELS else size
    matrix = camera.matrix(size, caller)
    fitted = Pinhole(*matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    doubt = describe_improbable_view(caller, fitted, size, name="--intrinsics") if size else ""
    return matrix, doubt
