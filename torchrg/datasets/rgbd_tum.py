"""Frames of TUM RGB-D and ICL-NUIM recordings."""

import os
from pathlib import Path

from torch import Tensor

from torchrg.datasets.rgbd_frame import RGBDFrame
from torchrg.datasets.rgbd_listing import frame_name, image_beside, numbered_images, recordings
from torchrg.datasets.rgbd_poses import nearest_times, read_timed, read_trajectory
from torchrg.errors import ConfigError
from torchrg.transforms.depth_camera import make_intrinsics

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
