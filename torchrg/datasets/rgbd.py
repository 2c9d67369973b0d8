"""Depth frames with their cameras, poses and colours, and the folder shapes they are found in.

A new shape is a function here that lists the frames of a folder, a row of :data:`LAYOUTS`, its name
among the choices of ``torchrg convert rgbd``, and a test.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._checks import check_shapes
from torchrg.datasets.folder import (
    SceneDataset,
    SceneFiles,
    Transform,
    check_folder,
    files_below,
    listed,
    warn_of_links,
)
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    known_pose,
    read_color,
    read_depth,
    read_matrix,
    read_nearest,
    read_timed,
    read_trajectory,
)
from torchrg.depth.camera import check_camera, make_intrinsics
from torchrg.errors import ConfigError, FormatError
from torchrg.transforms.rows import SampleDict

_COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
_TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the three cameras, as the data set gives them."""
_ICL_NUIM_INTRINSICS = (481.2, -480.0, 319.5, 239.5)
"""The scenes were rendered with y upwards: rows count against it."""
_SEVEN_SCENES_INTRINSICS = (585.0, 585.0, 320.0, 240.0)


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """A depth frame on disk.

    Args:
        depth: Depth image: 16-bit gray PNG, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the middle of the first pixel is at (0, 0).
        depth_scale: Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres.
        name: Unique within a data set and fit for a path below an output folder, with forward
            slashes: ``scene0000_00/12``.
        color: Colour image registered to the depth, if there is one: PNG or JPEG.
        pose: Matrix from camera to world coordinates, shape ``(4, 4)``, if it is known.
        no_depth: Stored value that means "no depth" beside 0, if there is one.
        sources: Further files that intrinsics and pose were read from.

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
        for number, (name, path, _) in enumerate(self.scenes):
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
        layout: str,
        *,
        intrinsics: Tensor | None = None,
        depth_scale: float | None = None,
        transform: Transform | None = None,
    ) -> "RGBDFrames":
        """Find the frames of a folder.

        Args:
            root: The folder: of one recording, or of several beside each other.
            layout: ``tum``, ``icl-nuim``, ``scannet``, ``7-scenes``, or ``images`` for any folder
                of depth images.
            intrinsics: Camera matrix, shape ``(3, 3)``. Default: the layout's; ``images`` has none.
            depth_scale: Stored value of one metre. Default: the layout's; ``images`` has none.
            transform: Called with each sample.

        Returns:
            The dataset, its frames in natural order.

        Raises:
            ConfigError: If there is no such layout, or it needs intrinsics or a scale.
            FormatError: If there are no such frames in the folder, or a file is damaged.
        """
        if layout not in LAYOUTS:
            names = ", ".join(sorted(LAYOUTS))
            raise ConfigError(f"RGBDFrames: expected layout to be one of {names}, got {layout!r}.")
        frames = [*_find(Path(root), LAYOUTS[layout], intrinsics, depth_scale)]
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


class ListedFrame(NamedTuple):
    """A frame as a folder lists it; the fields are those of :class:`RGBDFrame`."""

    name: str
    depth: Path
    color: Path | None = None
    pose: Tensor | None = None
    sources: tuple[Path, ...] = ()


Camera = Callable[[Path], tuple[Tensor, tuple[Path, ...]]]
"""Returns the camera matrix of a recording, and the files that it was read from."""


class FrameLayout(NamedTuple):
    """The shape of a folder of frames.

    Attributes:
        frames: Yields the frames of a recording in natural order.
        mark: Pattern of the name of an entry of every recording; nothing where a folder is one.
        camera: The camera of a recording, None where it is not known.
        depth_scale: Stored value of one metre, None where it is not known.
        no_depth: As of :class:`RGBDFrame`.
    """

    frames: Callable[[Path], Iterable[ListedFrame]]
    mark: str = ""
    camera: Camera | None = None
    depth_scale: float | None = None
    no_depth: int | None = None


def _find(
    root: Path, layout: FrameLayout, intrinsics: Tensor | None, depth_scale: float | None
) -> Iterator[RGBDFrame]:
    """Yield the frames of a folder, of one recording or of several beside each other."""
    scale = layout.depth_scale if depth_scale is None else depth_scale
    camera = layout.camera if intrinsics is None else lambda folder: (intrinsics, ())
    if scale is None or camera is None:
        missing = "intrinsics" if camera is None else "depth_scale"
        raise ConfigError(f"{root}: expected {missing}, which depth images do not hold; pass it.")
    for prefix, folder in _recordings(root, layout.mark) if layout.mark else [("", root)]:
        matrix, files = camera(folder)
        for name, depth, color, pose, sources in layout.frames(folder):
            yield RGBDFrame(
                depth, matrix, scale, prefix + name, color, pose, layout.no_depth, files + sources
            )


def _tum_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of TUM RGB-D, which are listed in ``depth.txt``.

    Colour (``rgb.txt``) and pose (``groundtruth.txt``) of a depth image are those nearest in time;
    without one, the frame has none.
    """
    lists = [folder / file for file in ("depth.txt", "rgb.txt", "groundtruth.txt")]
    times, images = read_timed(lists[0])
    colors = read_nearest(times, lists[1], read_timed)
    poses = read_nearest(times, lists[2], read_trajectory)
    sources = tuple(path for path in lists if path.is_file())
    for image, color, pose in zip(images, colors, poses, strict=True):
        beside = None if color is None else folder / color
        yield ListedFrame(Path(image).stem, folder / image, beside, pose, sources)


def _tum_camera(folder: Path) -> tuple[Tensor, tuple[Path, ...]]:
    """Return the camera matrix of a recording by its name."""
    name = folder.resolve().name.lower()
    for camera, values in _TUM_INTRINSICS.items():
        if camera in name:
            return make_intrinsics(*values), ()
    raise ConfigError(
        f"{folder}: expected intrinsics, as the name says none of {', '.join(_TUM_INTRINSICS)}; "
        "pass them."
    )


def _icl_nuim_frames(folder: Path) -> Iterator[ListedFrame]:
    """Yield the frames of ICL-NUIM in its TUM-compatible form: ``depth/0.png``, ``rgb/0.png``.

    There is perhaps one trajectory ``*.gt.freiburg``, whose first column is the number of the
    image.
    """
    tracks = tuple(sorted(folder.glob("*.gt.freiburg"))[:1])
    numbers, matrices = read_trajectory(tracks[0]) if tracks else ([], [])
    poses = {f"{number:.0f}": pose for number, pose in zip(numbers, matrices, strict=True)}
    for name, image in _depth_images(folder, "depth/*"):
        yield ListedFrame(name, image, _color_image(folder / "rgb" / name), poses.get(name), tracks)


def _named_frames(depth: str, color: str, pose: str) -> Callable[[Path], Iterator[ListedFrame]]:
    """Return what yields frames by the names of their files, where ``*`` is that of the frame."""

    def frames(folder: Path) -> Iterator[ListedFrame]:
        for name, image in _depth_images(folder, depth):
            path = folder / pose.replace("*", name)
            known = (known_pose(read_matrix(path)), (path,)) if path.is_file() else (None, ())
            yield ListedFrame(name, image, _color_image(folder / color.replace("*", name)), *known)

    return frames


def _depth_images(folder: Path, pattern: str) -> Iterator[tuple[str, Path]]:
    """Yield names and depth images of a folder, in natural order; the pattern has no suffix."""
    before, after = pattern.split("*")
    for path in listed(folder / before):
        if path.suffix.lower() in DEPTH_SUFFIXES and path.stem.endswith(after):
            yield path.stem.removesuffix(after), path


def _color_image(path: Path) -> Path | None:
    """Return the colour image of a path without its suffix, None if there is none."""
    paths = (path.with_name(f"{path.name}{suffix}") for suffix in _COLOR_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _same_camera(*values: float) -> Camera:
    """Return what gives every recording the same fx, fy, cx, cy."""
    return lambda folder: (make_intrinsics(*values), ())


def _scannet_camera(folder: Path) -> tuple[Tensor, tuple[Path, ...]]:
    """Return the camera matrix of a scan."""
    calibration = folder / "intrinsic" / "intrinsic_depth.txt"
    camera = read_matrix(calibration)[:3, :3]
    check_camera(str(calibration), camera)
    return camera, (calibration,)


def _all_images(folder: Path) -> Iterator[ListedFrame]:
    """Yield all depth images below a folder, by one camera, without colours and poses."""
    images = [path for path in files_below(folder) if path.suffix.lower() in DEPTH_SUFFIXES]
    if not images:
        known = " ".join(DEPTH_SUFFIXES)
        raise FormatError(f"{folder}: expected depth images ({known}), got none.")
    for image in images:
        yield ListedFrame(image.relative_to(folder).with_suffix("").as_posix(), image)


LAYOUTS = {
    "tum": FrameLayout(_tum_frames, "depth.txt", _tum_camera, 5000.0),
    "icl-nuim": FrameLayout(_icl_nuim_frames, "depth", _same_camera(*_ICL_NUIM_INTRINSICS), 5000.0),
    "scannet": FrameLayout(
        _named_frames("depth/*", "color/*", "pose/*.txt"), "depth", _scannet_camera, 1000.0
    ),
    "7-scenes": FrameLayout(
        _named_frames("*.depth", "*.color", "*.pose.txt"),
        "frame-*.depth.png",
        _same_camera(*_SEVEN_SCENES_INTRINSICS),
        1000.0,
        no_depth=65535,
    ),
    "images": FrameLayout(_all_images),
}
"""Shapes of folders of frames by their names: those of J. Sturm et al., A benchmark for the
evaluation of RGB-D SLAM systems, IROS, 2012; A. Handa et al., A benchmark for RGB-D visual
odometry, 3D reconstruction and SLAM, ICRA, 2014; A. Dai et al., ScanNet, CVPR, 2017, as its reader
exports it; J. Shotton et al., Scene coordinate regression forests, CVPR, 2013; and any other."""


def _recordings(root: Path, mark: str) -> Iterator[tuple[str, Path]]:
    """Yield the recordings in a folder, which may be one itself, with the folder of their names.

    Every recording has an entry in it whose name fits the pattern ``mark``. One that is there under
    several names has the one without links, or else the one that comes first.
    """
    check_folder(root)
    candidates = [root, *(path for path in listed(root) if path.is_dir())]
    marked = [path for path in candidates if any(path.glob(mark))]
    own: dict[Path, Path] = {}
    for path in sorted(marked, key=lambda path: path != root and path.is_symlink()):
        own.setdefault(path.resolve(), path)
    found = [path for path in marked if own[path.resolve()] == path]
    warn_of_links(root, [path for path in marked if path not in found])
    if not found:
        raise FormatError(f"{root}: expected recordings with {mark} in them, got none.")
    for folder in found:
        name = (folder.resolve() if folder == root else folder).name
        yield f"{name}/", folder
