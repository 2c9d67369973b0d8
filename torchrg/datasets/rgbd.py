"""Depth frames with their cameras, poses and colours, as a data set."""

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
from torchrg.datasets.rgbd_layouts import LAYOUTS, find_layout, find_recordings
from torchrg.depth.camera import Pinhole, check_camera, doubt_view
from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.transforms.rows import SampleDict


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """A depth frame on disk.

    Args:
        depth: Depth image: gray PNG or PGM of 16 bits, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the middle of the first pixel is at (0, 0).
        depth_scale: Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres.
        name: Unique within a data set and fit for a path below an output folder, with forward
            slashes: ``scene0000_00/12``.
        color: Colour image registered to the depth, if there is one: PNG or JPEG.
        pose: Matrix from camera to world coordinates, shape ``(4, 4)``, if it is known.
        no_depth: Stored value that means "no depth" beside 0, if there is one.
        sources: Further files that intrinsics and pose were read from.
        origin: Where the intrinsics are from, in words.

    Raises:
        ShapeError: If a matrix has another shape.
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
                f"RGBDFrame: expected depth_scale > 0, the stored value of one metre, got "
                f"{self.depth_scale}."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every input file: depth, colour if there is one, and those of intrinsics and pose."""
        color = () if self.color is None else (self.color,)
        return (self.depth, *color, *self.sources)


class RGBDFrames(SceneDataset):
    """Depth frames, read when they are asked for.

    A sample has

    * ``depth``: float32, shape ``(1, H, W)``, in metres along the optical axis; 0 where there is
      none;
    * ``intrinsics``: float64, shape ``(3, 3)``;
    * ``pose``: float64, shape ``(4, 4)``, camera to world; absent where it is not known;
    * ``color``: uint8, shape ``(3, H, W)``, of the colour image's own size; absent without one;
    * ``name``: the frame's.

    Frames of one size are batched by torch's own ``default_collate``.

    Args:
        frames: The frames, in order.
        transform: Called with each sample, for example :class:`torchrg.transforms.SegmentDepth`.

    Attributes:
        frames: The frames.
        scenes: Name, depth image and all input files of each frame.

    Raises:
        ConfigError: If two frames have one name.

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
                    f"RGBDFrames: expected frames of different names, got {name!r} twice, for "
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
            root: The folder: of one recording, or of several beside each other.
            layout: A key of :data:`~torchrg.datasets.rgbd_layouts.LAYOUTS`: ``tum``, ``icl-nuim``,
                ``scannet``, ``7-scenes``, ``nerfstudio``, ``arkitscenes``, ``replica``,
                ``scannetpp``, ``3rscan``, or ``images`` for any folder of depth images. Default:
                the one that the folder shows.
            intrinsics: Camera matrix, shape ``(3, 3)``, or a camera of images of another size.
                Default: that of the frames or of a camera file next to them, else the built-in
                camera of ``tum``, ``icl-nuim`` and ``7-scenes``.
            depth_scale: Stored value of one metre. Default: that of the camera file, else the
                layout's; ``images`` has none.
            transform: Called with each sample.

        Returns:
            The dataset, its frames in natural order.

        Raises:
            ConfigError: If there is no such layout, it needs intrinsics or a scale, or a camera
                cannot be that of an image.
            FormatError: If there are no such frames in the folder, or a file is damaged.

        Warns:
            DepthWarning: If a camera is built in, or improbable for an image.
        """
        folder = Path(root)
        refuse_recording(folder)
        if folder.is_file():
            raise FormatError(f"{root}: expected a folder of frames, got a file; pass its folder.")
        name = find_layout(folder) if layout == "auto" else layout
        if name not in LAYOUTS:
            names = ", ".join(sorted(LAYOUTS))
            raise ConfigError(f"RGBDFrames: expected layout to be one of {names}, got {layout!r}.")
        frames = [*_find(folder, name, intrinsics, depth_scale)]
        if not frames:
            suffixes = " ".join(DEPTH_SUFFIXES)
            raise FormatError(f"{root}: expected depth images ({suffixes}), got none.")
        return cls(frames, transform=transform)

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a frame.

        Raises:
            FormatError: If a file is missing, damaged, or not a depth image.
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


def _find(
    root: Path, name: str, intrinsics: Tensor | Pinhole | None, depth_scale: float | None
) -> Iterator[RGBDFrame]:
    """Yield the frames of a folder, of one recording or of several beside each other.

    Warns:
        DepthWarning: If a camera is improbable for an image; once for each recording.
    """
    layout = LAYOUTS[name]
    for prefix, folder in find_recordings(root, layout):
        shared: dict[Path, tuple[Pinhole | None, tuple[Path, ...]]] = {}
        is_doubted = False
        for frame in layout.frames(folder):
            camera: Tensor | Pinhole | None = intrinsics
            files, origin = tuple[Path, ...](), "given"
            if camera is None and frame.camera is not None:
                camera, files = frame.camera, frame.sources[:1]
            elif camera is None:
                place = frame.depth.parent
                if place not in shared:
                    shared[place] = _shared_camera(place, folder, root, name)
                camera, files = shared[place]
            if intrinsics is None:
                origin = files[0].name if files else f"built in, {name}"
            own = camera.depth_scale if isinstance(camera, Pinhole) else None
            scales = (depth_scale, own, frame.depth_scale, layout.depth_scale)
            scale = next((value for value in scales if value is not None), None)
            if camera is None or scale is None:
                missing = "intrinsics" if camera is None else "depth_scale"
                raise ConfigError(
                    f"{frame.depth}: expected {missing}, which depth images do not hold; pass it"
                    f"{': 1 for metres, 1000 for millimetres' if camera is not None else ''}."
                )
            matrix, doubt = fit_camera(frame.depth, camera, *files[:1])
            if doubt and not is_doubted:
                warnings.warn(doubt, DepthWarning, stacklevel=3)
            is_doubted |= bool(doubt)
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
    place: Path, folder: Path, root: Path, name: str
) -> tuple[Pinhole | None, tuple[Path, ...]]:
    """Return the camera of the images of a recording in one place, and the file it was read from.

    A camera file wins over the built-in camera of the data set. It is None where there is neither.

    Warns:
        DepthWarning: If the camera is built in.
    """
    if found := find_camera(place, root):
        return found[0], found[1:]
    layout = LAYOUTS[name]
    if layout.camera is None:
        return None, ()
    camera = layout.camera(folder)
    numbers = ",".join(f"{number:g}" for number in camera[:4])
    warnings.warn(
        f"{root}: frames without a camera file get the built-in camera of {name}, {numbers}; pass "
        "--intrinsics if they are of another.",
        DepthWarning,
        stacklevel=4,
    )
    return camera, ()


def fit_camera(
    image: Path, camera: Tensor | Pinhole, file: Path | None = None
) -> tuple[Tensor, str]:
    """Return the camera matrix for a depth image, and why it is improbable, if it is.

    Args:
        image: The depth image. The size of one that is too large to be read does not count.
        camera: The camera, or its matrix.
        file: Where the camera was read from, for messages.

    Raises:
        ConfigError: If the camera cannot be that of the image.
    """
    caller = f"{image}" if file is None else f"{image}: {file.name}"
    size = image_size(image)
    size = None if size and math.prod(size) > MAX_PIXELS else size
    matrix = camera.matrix(size, caller) if isinstance(camera, Pinhole) else camera
    check_shapes(caller, intrinsics=(matrix, "3 3"))
    check_camera(caller, matrix)
    values = matrix.double()[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return matrix, doubt_view(caller, Pinhole(*values), size, name="--intrinsics") if size else ""
