"""Depth frames with their cameras, poses and colours as a dataset."""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrg.datasets.folder import Scene, SceneDataset
from torchrg.datasets.rgbd_files import read_color, read_depth
from torchrg.datasets.rgbd_layouts import LAYOUTS, RGBDFrame
from torchrg.errors import ConfigError


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
        self.scenes = [Scene(frame.name, frame.depth, frame.files) for frame in self.frames]
        twice = [name for name, count in Counter(s.name for s in self.scenes).items() if count > 1]
        if twice:
            raise ConfigError(
                f"RGBDFrames: expected frames of different names, got {twice[0]!r} twice."
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
            layout: A name from :data:`torchrg.datasets.rgbd_layouts.LAYOUTS`: ``tum``,
                ``icl-nuim``, ``scannet``, ``7-scenes``, or ``images`` for any folder of depth
                images.
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
