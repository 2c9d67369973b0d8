"""Depth frames with their cameras, poses and colours, and the folder shapes they are found in.

A new shape is a function here that finds the frames of a folder, a row of :data:`LAYOUTS`, its name
among the choices of ``torchrg convert rgbd``, and a test.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrg._checks import check_shapes
from torchrg.datasets.folder import (
    SceneDataset,
    SceneFiles,
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

_COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
_MILLIMETERS = 1000.0
"""Stored value of one metre in ScanNet and 7-Scenes."""
_TUM_SCALE = 5000.0
"""Stored value of one metre in TUM and ICL-NUIM."""
_TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the three cameras, as the data set gives them."""
_ICL_NUIM_INTRINSICS = (481.2, -480.0, 319.5, 239.5)
"""The scenes were rendered with y upwards: rows count against it."""
_SEVEN_SCENES_INTRINSICS = (585.0, 585.0, 320.0, 240.0)
_SEVEN_SCENES_NO_DEPTH = 65535
"""Stored value of a pixel without depth in 7-Scenes."""


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
        transform: Callable[[dict[str, Any]], Any] | None = None,
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
        transform: Callable[[dict[str, Any]], Any] | None = None,
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
        frames = LAYOUTS[layout](Path(root), intrinsics, depth_scale)
        return cls(frames, transform=transform)

    def read_sample(self, index: int) -> dict[str, Any]:
        """Return the sample of a frame.

        Raises:
            FormatError: If a file is missing, damaged, or not a depth image.
        """
        frame = self.frames[index]
        depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
        sample: dict[str, Any] = {
            "depth": depth[None],
            "intrinsics": frame.intrinsics.to(torch.float64),
            "name": frame.name,
        }
        if frame.pose is not None:
            sample["pose"] = frame.pose.to(torch.float64)
        if frame.color is not None:
            sample["color"] = read_color(frame.color)
        return sample


Finder = Callable[[Path, Tensor | None, float | None], list[RGBDFrame]]
"""Finds the frames of a folder, of one recording or of several beside each other, in natural order.

Intrinsics and scale that are not given are those of the layout. Raises ConfigError if it has none,
FormatError if there is no frame, or a file that says where they are is damaged."""


def _find_tum(root: Path, intrinsics: Tensor | None, depth_scale: float | None) -> list[RGBDFrame]:
    """Find the frames of TUM RGB-D [1]: folders with ``depth.txt``, the camera in their names.

    Colour (``rgb.txt``) and pose (``groundtruth.txt``) of a depth image are those nearest in time,
    within 0.02 seconds; without one, the frame has none.

    References:
        [1] J. Sturm et al. A benchmark for the evaluation of RGB-D SLAM systems. IROS, 2012.
    """
    frames = []
    for name, folder in _recordings(root, "depth.txt"):
        camera = _tum_camera(folder) if intrinsics is None else intrinsics
        times, images = read_timed(folder / "depth.txt")
        lists = [folder / file for file in ("depth.txt", "rgb.txt", "groundtruth.txt")]
        colors = read_nearest(times, lists[1], read_timed)
        poses = read_nearest(times, lists[2], read_trajectory)
        frames += [
            RGBDFrame(
                folder / image,
                camera,
                _TUM_SCALE if depth_scale is None else depth_scale,
                f"{name}/{Path(image).stem}",
                None if color is None else folder / color,
                pose,
                sources=tuple(path for path in lists if path.is_file()),
            )
            for image, color, pose in zip(images, colors, poses, strict=True)
        ]
    return frames


def _tum_camera(folder: Path) -> Tensor:
    """Return the camera matrix of a recording by its name."""
    name = folder.resolve().name.lower()
    for camera, values in _TUM_INTRINSICS.items():
        if camera in name:
            return make_intrinsics(*values)
    raise ConfigError(
        f"{folder}: expected intrinsics, as the name says none of {', '.join(_TUM_INTRINSICS)}; "
        "pass them."
    )


def _find_icl_nuim(
    root: Path, intrinsics: Tensor | None, depth_scale: float | None
) -> list[RGBDFrame]:
    """Find the frames of ICL-NUIM [1] in its TUM-compatible form: ``depth/0.png``, ``rgb/0.png``.

    There is perhaps one trajectory ``*.gt.freiburg``, whose first column is the number of the
    image.

    References:
        [1] A. Handa et al. A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM. ICRA,
        2014.
    """
    camera = make_intrinsics(*_ICL_NUIM_INTRINSICS) if intrinsics is None else intrinsics
    frames = []
    for name, folder in _recordings(root, "depth"):
        poses: dict[str, Tensor | None] = {}
        tracks = tuple(sorted(folder.glob("*.gt.freiburg"))[:1])
        if tracks:
            numbers, matrices = read_trajectory(tracks[0])
            poses = {f"{n:.0f}": pose for n, pose in zip(numbers, matrices, strict=True)}
        frames += [
            RGBDFrame(
                image,
                camera,
                _TUM_SCALE if depth_scale is None else depth_scale,
                f"{name}/{image.stem}",
                _image_beside(folder / "rgb", image.stem),
                poses.get(image.stem),
                sources=tracks,
            )
            for image in _numbered_images(folder / "depth")
        ]
    return frames


def _find_scannet(
    root: Path, intrinsics: Tensor | None, depth_scale: float | None
) -> list[RGBDFrame]:
    """Find the frames of ScanNet [1], as its reader exports it: ``depth/0.png``, ``color/0.jpg``.

    Poses are in ``pose/0.txt``, ..., intrinsics in ``intrinsic/intrinsic_depth.txt``.

    References:
        [1] A. Dai et al. ScanNet: richly-annotated 3D reconstructions of indoor scenes. CVPR, 2017.
    """
    frames = []
    for name, folder in _recordings(root, "depth"):
        calibration = folder / "intrinsic" / "intrinsic_depth.txt"
        camera = read_matrix(calibration)[:3, :3] if intrinsics is None else intrinsics
        check_camera(f"{calibration if intrinsics is None else root}", camera)
        frames += [
            _posed_frame(
                image,
                camera,
                depth_scale,
                f"{name}/{image.stem}",
                _image_beside(folder / "color", image.stem),
                folder / "pose" / f"{image.stem}.txt",
                sources=(calibration,) if intrinsics is None else (),
            )
            for image in _numbered_images(folder / "depth")
        ]
    return frames


def _find_seven_scenes(
    root: Path, intrinsics: Tensor | None, depth_scale: float | None
) -> list[RGBDFrame]:
    """Find the frames of 7-Scenes [1]: ``frame-000000.depth.png``, ``.color.png``, ``.pose.txt``.

    The stored value 65535 means no depth.

    References:
        [1] J. Shotton et al. Scene coordinate regression forests for camera relocalization in RGB-D
        images. CVPR, 2013.
    """
    camera = make_intrinsics(*_SEVEN_SCENES_INTRINSICS) if intrinsics is None else intrinsics
    ending = ".depth.png"
    return [
        _posed_frame(
            image,
            camera,
            depth_scale,
            f"{name}/{stem}",
            _image_beside(folder, f"{stem}.color"),
            folder / f"{stem}.pose.txt",
            no_depth=_SEVEN_SCENES_NO_DEPTH,
        )
        for name, folder in _recordings(root, f"frame-*{ending}")
        for image in listed(folder)
        if (stem := image.name.removesuffix(ending)) != image.name
    ]


def _find_images(
    root: Path, intrinsics: Tensor | None, depth_scale: float | None
) -> list[RGBDFrame]:
    """Find all depth images below a folder, by one camera, without colours and poses.

    They do not tell intrinsics and scale, and nothing is guessed.
    """
    if intrinsics is None or depth_scale is None:
        missing = "intrinsics" if intrinsics is None else "depth_scale"
        raise ConfigError(f"{root}: expected {missing}, which depth images do not hold; pass it.")
    images = [path for path in files_below(root) if path.suffix.lower() in DEPTH_SUFFIXES]
    if not images:
        raise FormatError(f"{root}: expected depth images ({' '.join(DEPTH_SUFFIXES)}), got none.")
    names = [image.relative_to(root).with_suffix("").as_posix() for image in images]
    return [
        RGBDFrame(image, intrinsics, depth_scale, name)
        for image, name in zip(images, names, strict=True)
    ]


LAYOUTS: dict[str, Finder] = {
    "tum": _find_tum,
    "icl-nuim": _find_icl_nuim,
    "scannet": _find_scannet,
    "7-scenes": _find_seven_scenes,
    "images": _find_images,
}
"""What finds the frames of a folder, by the name of its shape."""


def _recordings(root: Path, mark: str) -> Iterator[tuple[str, Path]]:
    """Yield name and folder of the recordings in a folder, which may be one itself.

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
        yield (folder.resolve() if folder == root else folder).name, folder


def _numbered_images(folder: Path) -> list[Path]:
    """Return the depth images of a folder in natural order."""
    return [path for path in listed(folder) if path.suffix.lower() in DEPTH_SUFFIXES]


def _image_beside(folder: Path, stem: str) -> Path | None:
    """Return the colour image of a name, None if there is none."""
    paths = (folder / f"{stem}{suffix}" for suffix in _COLOR_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _posed_frame(
    image: Path,
    camera: Tensor,
    depth_scale: float | None,
    name: str,
    color: Path | None,
    track: Path,
    *,
    no_depth: int | None = None,
    sources: tuple[Path, ...] = (),
) -> RGBDFrame:
    """Return a frame whose pose is in a file of its own, if that is there and it is known."""
    pose = known_pose(read_matrix(track)) if track.is_file() else None
    sources = (*sources, track) if track.is_file() else sources
    scale = _MILLIMETERS if depth_scale is None else depth_scale
    return RGBDFrame(image, camera, scale, name, color, pose, no_depth, sources)
