"""Depth frames as a source: planes, normals and curvature of each as images."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from torchrg.batch.results import write_results
from torchrg.batch.scans import Converted, Scan
from torchrg.datasets.rgbd import RGBDFrames
from torchrg.datasets.rgbd_frame import RGBDFrame
from torchrg.errors import FormatError
from torchrg.io.counts import estimate_points
from torchrg.transforms import DepthConfig, segment_depth
from torchrg.transforms.depth_camera import depth_to_points

PNG_SIZE = struct.Struct(">II")
PNG_SIZE_AT = 16


@dataclass(frozen=True)
class RGBDSource:
    """The depth frames of a folder.

    Files of each frame, all of its height and width: ``coord`` ``(H, W, 3)``, ``normal``
    ``(H, W, 3)``, ``curvature`` and ``plane`` ``(H, W)`` as ``.npy``, and ``planes.json``. In world
    coordinates where the pose is known, else in camera coordinates; pixels without depth have zeros
    and plane -1.

    Args:
        root: The folder.
        settings: How to segment.
        layout: Its shape; see :meth:`torchrg.datasets.RGBDFrames.from_folder`.
        intrinsics: ``fx, fy, cx, cy``. Default: the layout's.
        depth_scale: Stored value of one metre. Default: the layout's.
    """

    root: Path
    settings: DepthConfig
    layout: str
    intrinsics: tuple[float, float, float, float] | None = None
    depth_scale: float | None = None
    in_place: ClassVar[bool] = False
    bytes_per_point: ClassVar[int] = 12 + 12 + 4 + 4

    def describe(self) -> dict[str, Any]:
        """Return kind, shape of the folder and what was said about the camera."""
        return {
            "kind": "rgbd",
            "layout": self.layout,
            "intrinsics": None if self.intrinsics is None else list(self.intrinsics),
            "depth_scale": self.depth_scale,
        }

    def list_scans(self) -> list[Scan]:
        """Return the frames in natural order.

        Raises:
            FormatError: If there is none, or a file that says where they are is damaged.
            ConfigError: If the layout has no intrinsics or scale, and they are not given.
        """
        matrix = None
        if self.intrinsics is not None:
            fx, fy, cx, cy = self.intrinsics
            matrix = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
        frames = RGBDFrames.from_folder(
            self.root, self.layout, intrinsics=matrix, depth_scale=self.depth_scale
        ).frames
        return [
            Scan(frame.name, (frame.depth, *frame.sources), _num_pixels(frame.depth), _plain(frame))
            for frame in frames
        ]

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one frame.

        Raises:
            FormatError: If it cannot be read or has no depth, or a result not be written.
        """
        begin("read")
        frame = _frame(scan.item)
        sample = RGBDFrames([frame])[0]
        depth, intrinsics = sample["depth"][0], sample["intrinsics"]
        if not bool((depth > 0).any()):
            raise FormatError(f"{frame.depth}: expected pixels with depth, got none.")
        begin("planes")
        found = segment_depth(depth, intrinsics, self.settings, pose=frame.pose)
        points = depth_to_points(depth[None].double(), intrinsics[None])[0]
        if frame.pose is not None:
            pose = frame.pose.to(points)
            points = points @ pose[:3, :3].T + pose[:3, 3]
        coord = torch.where(depth[..., None] > 0, points, 0.0).float().numpy()
        begin("write")
        files = write_results(folder, coord, found)
        num_points, num_planes = depth.numel(), len(found.planes.count)
        notes = () if num_planes else ("no plane found",)
        return Converted(num_points, num_planes, tuple(files), warnings=notes)


def _num_pixels(path: Path) -> int:
    """Return the number of pixels of a depth image from its header, 0 if it is damaged."""
    if path.suffix.lower() != ".png":
        return estimate_points(path) if path.stat().st_size == 0 else path.stat().st_size // 2
    with path.open("rb") as stream:
        head = stream.read(PNG_SIZE_AT + PNG_SIZE.size)
    return int(np.prod(PNG_SIZE.unpack_from(head, PNG_SIZE_AT))) if len(head) == 24 else 0


def _plain(frame: RGBDFrame) -> dict[str, Any]:
    """Return a frame as plain values."""
    return {
        "depth": frame.depth,
        "intrinsics": frame.intrinsics.tolist(),
        "depth_scale": frame.depth_scale,
        "name": frame.name,
        "pose": None if frame.pose is None else frame.pose.tolist(),
        "no_depth": frame.no_depth,
    }


def _frame(values: dict[str, Any]) -> RGBDFrame:
    """Return the frame that plain values describe."""
    matrices = {
        name: None if values[name] is None else torch.tensor(values[name], dtype=torch.float64)
        for name in ("intrinsics", "pose")
    }
    return RGBDFrame(**(values | matrices))
