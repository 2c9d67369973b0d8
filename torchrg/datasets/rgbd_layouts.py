"""The folder shapes in which depth frames are found."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

from torch import Tensor

from torchrg.datasets.rgbd_frame import RGBDFrame
from torchrg.datasets.rgbd_images import DEPTH_SUFFIXES
from torchrg.datasets.rgbd_scannet import find_scannet_frames, find_seven_scenes_frames
from torchrg.datasets.rgbd_tum import find_icl_nuim_frames, find_tum_frames
from torchrg.datasets.scene_list import listed
from torchrg.errors import ConfigError, FormatError


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
