"""The folder shapes in which depth frames are found."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchrg._checks import check_shapes
from torchrg.datasets.folder import listed
from torchrg.datasets.rgbd_files import (
    DEPTH_SUFFIXES,
    nearest_times,
    read_matrix,
    read_timed,
    read_trajectory,
)
from torchrg.depth.camera import make_intrinsics
from torchrg.errors import ConfigError, FormatError


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


COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of colour images."""


def recordings(root: str | os.PathLike[str], mark: str) -> list[Path]:
    """Return the recordings in a folder, which may be one itself, in natural order.

    Args:
        root: The folder.
        mark: Pattern of a name that every recording has in it.

    Raises:
        FormatError: If there is none.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder; check the spelling.")
    candidates = [folder, *(path for path in listed(folder) if path.is_dir())]
    found = [path for path in candidates if any(path.glob(mark))]
    if not found:
        raise FormatError(f"{folder}: expected recordings with {mark} in them, got none.")
    return found


def frame_name(root: str | os.PathLike[str], recording: Path, image: str) -> str:
    """Return the name of a frame: that of its recording and its own.

    Example:
        >>> frame_name("data", Path("data/office"), "12")
        'office/12'
        >>> frame_name("data/office", Path("data/office"), "12")
        'office/12'
    """
    inside = recording.relative_to(root).as_posix()
    return f"{recording.resolve().name if inside == '.' else inside}/{image}"


def numbered_images(folder: Path) -> list[Path]:
    """Return the depth images of a folder in natural order."""
    return [path for path in listed(folder) if path.suffix.lower() in DEPTH_SUFFIXES]


def image_beside(folder: Path, stem: str) -> Path | None:
    """Return the colour image of a name, None if there is none."""
    paths = (folder / f"{stem}{suffix}" for suffix in COLOR_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


TUM_SCALE = 5000.0
TUM_INTRINSICS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the three cameras, as the data set gives them."""
# The scenes were rendered with y upwards: rows count against it.
ICL_NUIM_INTRINSICS = (481.2, -480.0, 319.5, 239.5)


def find_tum_frames(
    root: str | os.PathLike[str],
    *,
    intrinsics: Tensor | None = None,
    depth_scale: float | None = None,
) -> list[RGBDFrame]:
    """Find the frames of TUM RGB-D recordings [1]: folders with ``depth.txt``.

    Colour (``rgb.txt``) and pose (``groundtruth.txt``) of a depth image are those nearest in time,
    within 0.02 seconds; without one, the frame has none.

    Args:
        root: A recording, or a folder of recordings.
        intrinsics: Camera matrix. Default: that of freiburg1, 2 or 3, by the name of the recording.
        depth_scale: Default: 5000.

    Returns:
        The frames, in the order of ``depth.txt``.

    Raises:
        ConfigError: If the name of a recording does not tell its camera.
        FormatError: If there is no recording, or a list is damaged.

    References:
        [1] J. Sturm et al. A benchmark for the evaluation of RGB-D SLAM systems. IROS, 2012.
    """
    frames = []
    for folder in recordings(root, "depth.txt"):
        camera = _tum_camera(folder) if intrinsics is None else intrinsics
        times, images = read_timed(folder / "depth.txt")
        lists = [folder / name for name in ("rgb.txt", "groundtruth.txt")]
        colors: list[int | None] = [None] * len(times)
        poses: list[int | None] = [None] * len(times)
        if lists[0].is_file():
            color_times, color_files = read_timed(lists[0])
            colors = nearest_times(times, color_times)
        if lists[1].is_file():
            pose_times, matrices = read_trajectory(lists[1])
            poses = nearest_times(times, pose_times)
        sources = tuple(path for path in (folder / "depth.txt", *lists) if path.is_file())
        frames += [
            RGBDFrame(
                folder / image,
                camera,
                depth_scale or TUM_SCALE,
                frame_name(root, folder, Path(image).stem),
                None if color is None else folder / color_files[color],
                None if pose is None else matrices[pose],
                sources=sources,
            )
            for image, color, pose in zip(images, colors, poses, strict=True)
        ]
    return frames


def _tum_camera(folder: Path) -> Tensor:
    """Return the camera matrix of a recording by its name."""
    name = folder.resolve().name.lower()
    for camera, values in TUM_INTRINSICS.items():
        if camera in name:
            return make_intrinsics(*values)
    raise ConfigError(
        f"{folder}: expected intrinsics, as the name says none of {', '.join(TUM_INTRINSICS)}; "
        "pass them."
    )


def find_icl_nuim_frames(
    root: str | os.PathLike[str],
    *,
    intrinsics: Tensor | None = None,
    depth_scale: float | None = None,
) -> list[RGBDFrame]:
    """Find the frames of ICL-NUIM recordings [1] in their TUM-compatible form.

    A recording is a folder with ``depth/0.png``, ``rgb/0.png``, ... and perhaps one trajectory
    ``*.gt.freiburg``, whose first column is the number of the image.

    Args:
        root: A recording, or a folder of recordings.
        intrinsics: Default: 481.2, -480, 319.5, 239.5; the y axis points up.
        depth_scale: Default: 5000.

    Returns:
        The frames, by number.

    Raises:
        FormatError: If there is no recording, or the trajectory is damaged.

    References:
        [1] A. Handa et al. A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM. ICRA,
        2014.
    """
    camera = make_intrinsics(*ICL_NUIM_INTRINSICS) if intrinsics is None else intrinsics
    frames = []
    for folder in recordings(root, "depth"):
        poses: dict[str, Tensor] = {}
        tracks = tuple(sorted(folder.glob("*.gt.freiburg"))[:1])
        if tracks:
            numbers, matrices = read_trajectory(tracks[0])
            poses = {f"{n:.0f}": pose for n, pose in zip(numbers, matrices, strict=True)}
        frames += [
            RGBDFrame(
                image,
                camera,
                depth_scale or TUM_SCALE,
                frame_name(root, folder, image.stem),
                image_beside(folder / "rgb", image.stem),
                poses.get(image.stem),
                sources=tracks,
            )
            for image in numbered_images(folder / "depth")
        ]
    return frames


MILLIMETERS = 1000.0
SEVEN_SCENES_INTRINSICS = (585.0, 585.0, 320.0, 240.0)
SEVEN_SCENES_NO_DEPTH = 65535


def find_scannet_frames(
    root: str | os.PathLike[str],
    *,
    intrinsics: Tensor | None = None,
    depth_scale: float | None = None,
) -> list[RGBDFrame]:
    """Find the frames of ScanNet scenes [1], as its reader exports them.

    A scene is a folder with ``depth/0.png``, ..., ``color/0.jpg``, ``pose/0.txt`` and
    ``intrinsic/intrinsic_depth.txt``. A pose that is not finite, which is how tracking that was
    lost is written, counts as none.

    Args:
        root: A scene, or a folder of scenes.
        intrinsics: Default: those of the scene.
        depth_scale: Default: 1000.

    Returns:
        The frames, by number.

    Raises:
        FormatError: If there is no scene, or a file is missing or damaged.

    References:
        [1] A. Dai et al. ScanNet: richly-annotated 3D reconstructions of indoor scenes. CVPR, 2017.
    """
    frames = []
    for folder in recordings(root, "depth"):
        calibration = folder / "intrinsic" / "intrinsic_depth.txt"
        camera = read_matrix(calibration)[:3, :3] if intrinsics is None else intrinsics
        shared = () if intrinsics is not None else (calibration,)
        for image in numbered_images(folder / "depth"):
            track = folder / "pose" / f"{image.stem}.txt"
            pose = read_matrix(track) if track.is_file() else None
            frames.append(
                RGBDFrame(
                    image,
                    camera,
                    depth_scale or MILLIMETERS,
                    frame_name(root, folder, image.stem),
                    image_beside(folder / "color", image.stem),
                    finite_or_none(pose),
                    sources=(*shared, *([track] if pose is not None else [])),
                )
            )
    return frames


def find_seven_scenes_frames(
    root: str | os.PathLike[str],
    *,
    intrinsics: Tensor | None = None,
    depth_scale: float | None = None,
) -> list[RGBDFrame]:
    """Find the frames of 7-Scenes sequences [1]: folders with ``frame-000000.depth.png``, ...

    Beside them are ``frame-000000.color.png`` and ``frame-000000.pose.txt``. The stored value 65535
    means no depth.

    Args:
        root: A sequence, or a folder of sequences.
        intrinsics: Default: 585, 585, 320, 240.
        depth_scale: Default: 1000.

    Returns:
        The frames, by number.

    Raises:
        FormatError: If there is no sequence, or a pose is damaged.

    References:
        [1] J. Shotton et al. Scene coordinate regression forests for camera relocalization in RGB-D
        images. CVPR, 2013.
    """
    camera = make_intrinsics(*SEVEN_SCENES_INTRINSICS) if intrinsics is None else intrinsics
    frames = []
    for folder in recordings(root, "frame-*.depth.png"):
        for image in (path for path in listed(folder) if path.name.endswith(".depth.png")):
            name = image.name.removesuffix(".depth.png")
            track = folder / f"{name}.pose.txt"
            pose = read_matrix(track) if track.is_file() else None
            frames.append(
                RGBDFrame(
                    image,
                    camera,
                    depth_scale or MILLIMETERS,
                    frame_name(root, folder, name),
                    image_beside(folder, f"{name}.color"),
                    finite_or_none(pose),
                    SEVEN_SCENES_NO_DEPTH,
                    (track,) if pose is not None else (),
                )
            )
    return frames


def finite_or_none(pose: Tensor | None) -> Tensor | None:
    """Return a pose, None if it is not finite."""
    return pose if pose is not None and bool(pose.isfinite().all()) else None


def find_depth_images(
    root: str | os.PathLike[str],
    *,
    intrinsics: Tensor | None = None,
    depth_scale: float | None = None,
) -> list[RGBDFrame]:
    """Find all depth images below a folder, by one camera, without colours and poses.

    Args:
        root: The folder.
        intrinsics: Camera matrix; has to be given.
        depth_scale: Stored value of one metre; has to be given.

    Returns:
        The frames, in natural order of their paths.

    Raises:
        ConfigError: If intrinsics or scale are not given: images do not tell, and nothing is
            guessed.
        FormatError: If there is no such image.
    """
    if intrinsics is None or depth_scale is None:
        missing = "intrinsics" if intrinsics is None else "depth_scale"
        raise ConfigError(f"{root}: expected {missing}, which depth images do not hold; pass it.")
    folder = Path(root)
    images = [path for path in _below(folder) if path.suffix.lower() in DEPTH_SUFFIXES]
    if not images:
        raise FormatError(f"{root}: expected depth images ({' '.join(DEPTH_SUFFIXES)}), got none.")
    names = [image.relative_to(folder).with_suffix("").as_posix() for image in images]
    return [
        RGBDFrame(image, intrinsics, depth_scale, name)
        for image, name in zip(images, names, strict=True)
    ]


def _below(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder in natural order, without hidden ones."""
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder; check the spelling.")
    for path in listed(folder):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            yield from _below(path)
        else:
            yield path


LAYOUTS: dict[str, Callable[..., list[RGBDFrame]]] = {
    "tum": find_tum_frames,
    "icl-nuim": find_icl_nuim_frames,
    "scannet": find_scannet_frames,
    "7-scenes": find_seven_scenes_frames,
    "images": find_depth_images,
}
"""What finds the frames of a folder, by the name of its shape."""
