"""Frames of ScanNet and 7-Scenes: a file of its own for each pose."""

import os

from torch import Tensor

from torchrg.datasets.rgbd_frame import RGBDFrame
from torchrg.datasets.rgbd_listing import frame_name, image_beside, numbered_images, recordings
from torchrg.datasets.rgbd_poses import read_matrix
from torchrg.datasets.scene_list import listed
from torchrg.transforms.depth_camera import make_intrinsics

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
