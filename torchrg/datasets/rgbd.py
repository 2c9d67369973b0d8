"""Depth frames with their cameras, poses and colours as a dataset."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from torchrg._checks import check_shapes
from torchrg.datasets.rgbd_images import read_color, read_depth
from torchrg.errors import ConfigError


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """Where one frame is, and what its numbers mean.

    Args:
        depth: Depth image: 16-bit gray PNG, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the middle of the first pixel is at (0, 0).
        depth_scale: Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres.
        color: Colour image registered to the depth, if there is one: PNG or JPEG.
        pose: Matrix from camera to world coordinates, shape ``(4, 4)``, if it is known.
        scene: Name of the recording.
        name: Name of the frame, unique within its scene, fit for a file name.
        no_depth: Stored value that means "no depth" beside 0, if there is one.
    """

    depth: Path
    intrinsics: Tensor
    depth_scale: float
    color: Path | None = None
    pose: Tensor | None = None
    scene: str = ""
    name: str = ""
    no_depth: int | None = None

    def __post_init__(self) -> None:
        check_shapes("RGBDFrame", intrinsics=(self.intrinsics, "3 3"), pose=(self.pose, "4 4"))
        if not 0 < self.depth_scale < float("inf"):
            raise ConfigError(
                f"RGBDFrame: expected depth_scale > 0, the stored value of one metre, got "
                f"{self.depth_scale}."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that the frame is read from: depth, and colour if there is one."""
        return (self.depth,) if self.color is None else (self.depth, self.color)

    @property
    def key(self) -> str:
        """``scene/name``, or the name alone."""
        return f"{self.scene}/{self.name}" if self.scene else self.name


class RGBDFrames(Dataset[dict[str, Any]]):
    """Depth frames: a list of :class:`RGBDFrame`, read when they are asked for.

    An item is a dict of

    * ``depth``: float32, shape ``(1, H, W)``, in metres along the optical axis; 0 where there is
      none;
    * ``intrinsics``: float64, shape ``(3, 3)``;
    * ``pose``: float64, shape ``(4, 4)``, camera to world; absent where it is not known;
    * ``color``: uint8, shape ``(3, H, W)`` (of the colour image's own size); absent without one;
    * ``scene`` and ``name``: the frame's.

    Frames of one size are batched by torch's own ``default_collate``. What is left of a frame to
    record (for a hash of its input, say) is in ``dataset.frames[i]``: ``files``, ``depth_scale``.

    Args:
        frames: The frames; see :mod:`torchrg.datasets.rgbd_layouts` for readers of the folders of
            TUM, ICL-NUIM, ScanNet and 7-Scenes.
        transform: Called with each item, for example :class:`torchrg.transforms.SegmentDepth`.

    Example:
        >>> import numpy as np, tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> np.save(folder / "a.npy", np.full((4, 6), 1500))
        >>> frame = RGBDFrame(folder / "a.npy", torch.eye(3), depth_scale=1000, name="a")
        >>> sample = RGBDFrames([frame])[0]
        >>> sample["depth"].shape, float(sample["depth"][0, 0, 0]), sorted(sample)
        (torch.Size([1, 4, 6]), 1.5, ['depth', 'intrinsics', 'name', 'scene'])
    """

    def __init__(
        self,
        frames: Sequence[RGBDFrame],
        *,
        transform: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    ) -> None:
        self.frames = tuple(frames)
        self.transform = transform

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Read a frame.

        Raises:
            FormatError: If a file is missing, damaged, or not a depth image.
        """
        frame = self.frames[index]
        depth = read_depth(frame.depth, depth_scale=frame.depth_scale, no_depth=frame.no_depth)
        sample: dict[str, Any] = {
            "depth": depth[None],
            "intrinsics": frame.intrinsics.to(torch.float64),
            "scene": frame.scene,
            "name": frame.name,
        }
        if frame.pose is not None:
            sample["pose"] = frame.pose.to(torch.float64)
        if frame.color is not None:
            sample["color"] = read_color(frame.color)
        return sample if self.transform is None else self.transform(sample)
