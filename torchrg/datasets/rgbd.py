"""Data set of depth frames with cameras, poses and colors."""

import math
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrg._checks import check_shapes
from torchrg.datasets.camera_files import find_camera
from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    MAX_PIXELS,
    image_size,
    read_color,
    read_depth,
    refuse_recording,
)
from torchrg.datasets.rgbd_layouts import FRAME_LAYOUTS, find_layout, find_recordings
from torchrg.depth.camera import Pinhole, check_camera, describe_improbable_view
from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.io.files import local_path
from torchrg.transforms.rows import SampleDict


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """Depth frame on disk.

    Args:
        depth: Depth image: 16-bit gray PNG or PGM, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the center of pixel (0, 0) is at (0, 0).
        depth_scale: Depth units per meter: 1000 for millimeters, 5000 for TUM, 1 for meters.
        name: Unique name within a data set, usable as a path below an output folder, with forward
            slashes: ``scene0000_00/12``.
        color: Color image registered to the depth, PNG or JPEG, or None.
        pose: Camera-to-world matrix, shape ``(4, 4)``, or None.
        no_depth: Stored value that means "no depth" in addition to 0, or None.
        sources: Further files that intrinsics and pose were read from.
        origin: Description of where the intrinsics come from.

    Raises:
        ShapeError: If a matrix has a wrong shape.
        ConfigError: If ``depth_scale`` is not positive.
    """

    depth: Path
    intrinsics: Tensor
    depth_scale: float
    name: str = ""
    color: Path | None = None
    pose: Tensor | None = None
    no_depth: int | None = None
    sources: tuple[Path, ...] = ()
    origin: str = ""

    def __post_init__(self) -> None:
        check_shapes("RGBDFrame", intrinsics=(self.intrinsics, "3 3"), pose=(self.pose, "4 4"))
        check_camera("RGBDFrame", self.intrinsics)
        if not 0 < self.depth_scale < float("inf"):
            raise ConfigError(
                "RGBDFrame: expected depth_scale > 0, the depth units per meter, got "
                f"{self.depth_scale}."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """All input files: depth, color if present, and the files of intrinsics and pose."""
        color = () if self.color is None else (self.color,)
        return (self.depth, *color, *self.sources)


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
        frames: The frames.
        scenes: Name, depth image and all input files of each frame.

    Raises:
        ConfigError: If two frames have the same name.

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

    def __init__(
        self,
        frames: Sequence[RGBDFrame],
        *,
        transform: Transform | None = None,
    ) -> None:
        self.frames = tuple(frames)
        self.transform = transform
        self.scenes = [SceneFiles(frame.name, frame.depth, frame.files) for frame in self.frames]
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
        transform: Transform | None = None,
    ) -> "RGBDFrames":
        """Find the frames of a folder.

        Args:
            root: The folder of one recording, or of several.
            layout: A key of :data:`~torchrg.datasets.rgbd_layouts.FRAME_LAYOUTS`: ``tum``,
                ``icl-nuim``, ``scannet``, ``7-scenes``, ``nerfstudio``, ``arkitscenes``,
                ``replica``, ``scannetpp``, ``3rscan``, or ``images`` for any folder of depth
                images. Default: detected from the folder.
            intrinsics: Camera matrix, shape ``(3, 3)``, or a camera of images of another size.
                Default: from the frames or a camera file next to them, else the built-in camera of
                ``tum``, ``icl-nuim`` and ``7-scenes``.
            depth_scale: Depth units per meter. Default: from the camera file, else the layout's;
                ``images`` has no default.
            transform: Applied to each sample.

        Returns:
            The data set, with frames in natural order.

        Raises:
            ConfigError: If the layout is unknown, needs intrinsics or a scale, or a camera cannot
                belong to an image.
            FormatError: If the folder contains no such frames, or a file is corrupt.

        Warns:
            DepthWarning: If a camera is built in, or implausible for an image.
        """
        folder = local_path(root)
        refuse_recording(folder)
        if folder.is_file():
            raise FormatError(f"{root}: expected a folder of frames, got a file; pass its folder.")
        name = find_layout(folder) if layout == "auto" else layout
        if name not in FRAME_LAYOUTS:
            names = ", ".join(sorted(FRAME_LAYOUTS))
            raise ConfigError(f"RGBDFrames: expected layout to be one of {names}, got {layout!r}.")
        frames = [*_find_frames(folder, name, intrinsics, depth_scale)]
        if not frames:
            suffixes = " ".join(DEPTH_SUFFIXES)
            raise FormatError(f"{root}: expected depth images ({suffixes}), got none.")
        return cls(frames, transform=transform)

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a frame.

        Raises:
            FormatError: If a file is missing, corrupt, or not a depth image.
        """
        frame = self.frames[index]
        depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
        sample: SampleDict = {
            "depth": depth[None],
            "intrinsics": frame.intrinsics.to(torch.float64),
            "name": frame.name,
        }
        if frame.pose is not None:
            sample["pose"] = frame.pose.to(torch.float64)
        if frame.color is not None:
            sample["color"] = read_color(frame.color)
        return sample


def _find_frames(
    root: Path, name: str, intrinsics: Tensor | Pinhole | None, depth_scale: float | None
) -> Iterator[RGBDFrame]:
    """Yield the frames of a folder of one or several recordings.

    Warns:
        DepthWarning: If a camera is implausible for an image; once per recording.
    """
    layout = FRAME_LAYOUTS[name]
    for prefix, folder in find_recordings(root, layout):
        shared: dict[Path, tuple[Pinhole | None, tuple[Path, ...]]] = {}
        has_warned = False
        for frame in layout.frames(folder):
            camera: Tensor | Pinhole | None = intrinsics
            files, origin = tuple[Path, ...](), "given"
            if camera is None and frame.camera is not None:
                camera, files = frame.camera, frame.sources[:1]
            elif camera is None:
                image_folder = frame.depth.parent
                if image_folder not in shared:
                    shared[image_folder] = _shared_camera(image_folder, folder, root, name)
                camera, files = shared[image_folder]
            if intrinsics is None:
                origin = files[0].name if files else f"built in, {name}"
            camera_scale = camera.depth_scale if isinstance(camera, Pinhole) else None
            scales = (depth_scale, camera_scale, frame.depth_scale, layout.depth_scale)
            scale = next((value for value in scales if value is not None), None)
            if camera is None or scale is None:
                missing = "intrinsics" if camera is None else "depth_scale"
                raise ConfigError(
                    f"{frame.depth}: expected {missing}, which depth images do not store; pass it"
                    f"{': 1 for meters, 1000 for millimeters' if camera is not None else ''}."
                )
            matrix, warning = fit_camera(frame.depth, camera, *files[:1])
            if warning and not has_warned:
                warnings.warn(warning, DepthWarning, stacklevel=3)
            has_warned |= bool(warning)
            yield RGBDFrame(
                frame.depth,
                matrix,
                scale,
                prefix + frame.name,
                frame.color,
                frame.pose,
                layout.no_depth,
                tuple(dict.fromkeys((*files, *frame.sources))),
                origin,
            )


def _shared_camera(
    image_folder: Path, folder: Path, root: Path, name: str
) -> tuple[Pinhole | None, tuple[Path, ...]]:
    """Return the camera of the images in a folder of a recording, and its file.

    A camera file takes precedence over the built-in camera. The camera is None without either.

    Warns:
        DepthWarning: If the camera is built in.
    """
    if found := find_camera(image_folder, root):
        return found[0], found[1:]
    layout = FRAME_LAYOUTS[name]
    if layout.camera is None:
        return None, ()
    camera = layout.camera(folder)
    numbers = ",".join(f"{number:g}" for number in camera[:4])
    warnings.warn(
        f"{root}: using the built-in camera of {name}, {numbers}, for frames without a camera "
        "file; pass --intrinsics if they have another.",
        DepthWarning,
        stacklevel=4,
    )
    return camera, ()


def fit_camera(
    image: Path, camera: Tensor | Pinhole, file: Path | None = None
) -> tuple[Tensor, str]:
    """Return the camera matrix for a depth image, and a warning if it is implausible.

    Args:
        image: The depth image. Its size is ignored if it is too large to be read.
        camera: The camera, or its matrix.
        file: File of the camera, for messages.

    Raises:
        ConfigError: If the camera cannot belong to the image.
    """
    caller = f"{image}" if file is None else f"{image}: {file.name}"
    size = image_size(image)
    size = None if size and math.prod(size) > MAX_PIXELS else size
    matrix = camera.matrix(size, caller) if isinstance(camera, Pinhole) else camera
    check_shapes(caller, intrinsics=(matrix, "3 3"))
    check_camera(caller, matrix)
    values = matrix.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return matrix, describe_improbable_view(
        caller, Pinhole(*values), size, name="--intrinsics"
    ) if size else ""
