"""Pinhole cameras."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Array, Frame, cos_sin, cross, unit
from torchrg.scenes.scene import SceneModel
from torchrg.scenes.streams import random_stream

_CAMERA_STREAM = 300
_GOLDEN_ANGLE = (3 - np.sqrt(5)) * np.pi
_STEEPEST = 0.5  # tangent of the steepest look downwards


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in a scene; the default is that of a Kinect.

    Convention:
        Camera axes are x to the right, y down, z forwards. The middle of the first pixel is at
        (0, 0).

    Args:
        frame: Position and axes in the world.
        width: Pixels in a row.
        height: Pixels in a column.
        fx: Focal length in pixels.
        fy: Focal length in pixels.
        cx: Column of the optical axis. Default: the middle.
        cy: Row of the optical axis. Default: the middle.

    Example:
        >>> camera = Camera.looking((1, 1, 1.5), (4, 1, 1.5))
        >>> camera.pose[:3, 2].tolist()
        [1.0, 0.0, 0.0]
    """

    frame: Frame
    width: int = 640
    height: int = 480
    fx: float = 525.0
    fy: float = 525.0
    cx: float | None = None
    cy: float | None = None

    @classmethod
    def looking(
        cls,
        position: ArrayLike,
        target: ArrayLike,
        *,
        width: int = 640,
        height: int = 480,
        focal: float | None = None,
    ) -> "Camera":
        """Return an upright camera that looks at a place, not straight up or down.

        Args:
            position: Where it is, shape ``(3,)``.
            target: What is in the middle of the picture, shape ``(3,)``.
            width: Pixels in a row.
            height: Pixels in a column.
            focal: Focal length in pixels. Default: as wide a view as that of a Kinect.

        Returns:
            The camera.

        Raises:
            ConfigError: If the view is vertical.
        """
        origin = np.asarray(position, dtype=np.float64)
        forwards = np.asarray(target, dtype=np.float64) - origin
        if not forwards[:2].any():
            raise ConfigError("Camera: expected a target not above or below the position.")
        forwards = unit(forwards)
        right = unit(cross(forwards, np.array([0, 0, 1.0])))
        frame = Frame(origin, np.stack([right, cross(forwards, right), forwards]))
        focal = 525 * width / 640 if focal is None else focal
        return cls(frame, width, height, focal, focal)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row of the optical axis."""
        cx = (self.width - 1) / 2 if self.cx is None else self.cx
        cy = (self.height - 1) / 2 if self.cy is None else self.cy
        return cx, cy

    @property
    def intrinsics(self) -> Tensor:
        """Matrix from camera coordinates to pixels, shape ``(3, 3)``, float64."""
        cx, cy = self.principal_point
        rows = [[self.fx, 0, cx], [0, self.fy, cy], [0, 0, 1]]
        return torch.tensor(rows, dtype=torch.float64)

    @property
    def pose(self) -> Tensor:
        """Matrix from camera to world coordinates, shape ``(4, 4)``, float64."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.frame.axes.T, self.frame.origin
        return torch.from_numpy(pose)

    def rays(self) -> Array:
        """Return what each pixel sees, in camera coordinates with depth 1, ``(H, W, 3)``."""
        cx, cy = self.principal_point
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = (np.arange(self.width) - cx) / self.fx
        rays[..., 1] = ((np.arange(self.height) - cy) / self.fy)[:, None]
        return rays


def cameras_around(
    model: SceneModel, num_cameras: int, *, seed: int = 0, width: int = 640, height: int = 480
) -> list[Camera]:
    """Return cameras at the viewpoints of a scene, as of someone who turns around and looks down.

    Args:
        model: The scene.
        num_cameras: How many; they take turns at the viewpoints, in directions apart by the golden
            angle.
        seed: Of the first direction and of how far down they look.
        width: Pixels in a row.
        height: Pixels in a column.

    Returns:
        The cameras.

    Example:
        >>> from torchrg.scenes import build_room
        >>> len(cameras_around(build_room(), 5))
        5
    """
    rng = random_stream(seed, _CAMERA_STREAM)
    cosines, sines = cos_sin(rng.random() * 2 * np.pi + _GOLDEN_ANGLE * np.arange(num_cameras))
    drops = rng.random(num_cameras) * _STEEPEST
    cameras = []
    for number, (cosine, sine, drop) in enumerate(zip(cosines, sines, drops, strict=True)):
        position = model.viewpoints[number % len(model.viewpoints)]
        target = position + np.array([cosine, sine, -drop])
        cameras.append(Camera.looking(position, target, width=width, height=height))
    return cameras
