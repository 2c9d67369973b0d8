"""Depth frames rendered from scenes, exact or as a Kinect would give them."""

from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.scenes.cameras import Camera, cameras_around
from torchrg.scenes.frames import Array
from torchrg.scenes.rays import cast_rays
from torchrg.scenes.scene import SceneModel
from torchrg.scenes.streams import random_stream
from torchrg.structures import UNLABELED

Sensor = Literal["exact", "kinect"]

_KINECT_BASELINE = 0.075  # metres
_KINECT_RANGE = (0.4, 8.0)  # metres
_DISPARITY_STEP = 1 / 8  # pixels
_NOISE_STREAM = 200


class DepthFrame(NamedTuple):
    """A depth image with its exact truth.

    Attributes:
        depth: Distance along the optical axis in metres, shape ``(H, W)``, float32; 0 where there
            is none.
        labels: Faces of the scene, shape ``(H, W)``, int64; ``torchrg.UNLABELED`` where there is no
            depth. Not every face is seen.
        normals: Unit normals before noise, towards the camera, in camera coordinates (x right, y
            down, z forwards), shape ``(H, W, 3)``, float32; zero where there is no depth.
        planar: Whether each face of the scene lies in a plane, shape ``(M,)``, bool.
        camera: The camera.
    """

    depth: Tensor
    labels: Tensor
    normals: Tensor
    planar: Tensor
    camera: Camera


def render_depth(
    model: SceneModel, camera: Camera | None = None, *, sensor: Sensor = "exact", seed: int = 0
) -> DepthFrame:
    """Render what a depth camera sees, by exact ray casting.

    The Kinect's noise is the axial one of [1]: a standard deviation of
    ``0.0012 + 0.0019 (z - 0.4)^2`` metres along the optical axis; then the disparity, for a
    baseline of 7.5 cm, is rounded to an eighth of a pixel, and depth outside of 0.4 to 8 m is
    dropped.

    Args:
        model: The scene.
        camera: Default: the first of :func:`cameras_around`.
        sensor: ``"exact"`` or ``"kinect"``.
        seed: Of the noise, and of the default camera.

    Returns:
        The frame.

    Raises:
        ConfigError: If there is no such sensor.

    References:
        [1] C. V. Nguyen, S. Izadi, D. Lovell. Modeling Kinect sensor noise for improved 3D
        reconstruction and tracking. 3DIMPVT, 2012.

    Example:
        >>> from torchrg.scenes import build_room
        >>> camera = Camera.looking((1, 1, 1.5), (4, 3, 1), width=64, height=48)
        >>> render_depth(build_room(), camera).depth.shape
        torch.Size([48, 64])
    """
    if sensor not in get_args(Sensor):
        options = ", ".join(get_args(Sensor))
        raise ConfigError(f"render_depth: expected sensor to be one of {options}, got {sensor!r}.")
    camera = cameras_around(model, 1, seed=seed)[0] if camera is None else camera
    rays = camera.rays()
    steps = camera.frame.turned(rays.reshape(-1, 3))
    exact, faces = cast_rays(model, camera.frame.origin, steps.reshape(rays.shape))
    normals = np.zeros_like(steps)
    for face, surface in enumerate(model.surfaces):
        rows = np.flatnonzero(faces == face)
        points = camera.frame.origin + exact.ravel()[rows, None] * steps[rows]
        normals[rows] = camera.frame.turned_back(surface.normals_at(points))
    depth = np.where(faces == UNLABELED, 0, exact)
    if sensor == "kinect":
        depth = _as_kinect(depth, camera.fx, random_stream(seed, _NOISE_STREAM))
    seen = depth > 0
    return DepthFrame(
        depth=torch.from_numpy(depth.astype(np.float32)),
        labels=torch.from_numpy(np.where(seen, faces, UNLABELED)),
        normals=torch.from_numpy(
            (normals.reshape(rays.shape) * seen[..., None]).astype(np.float32)
        ),
        planar=torch.tensor([surface.plane is not None for surface in model.surfaces]),
        camera=camera,
    )


def _as_kinect(depth: Array, focal: float, rng: np.random.Generator) -> Array:
    """Return depth with the noise and the steps of a Kinect; 0 where out of its range."""
    nearest, furthest = _KINECT_RANGE
    beyond = depth - nearest
    noisy = depth + (0.0012 + 0.0019 * beyond * beyond) * rng.standard_normal(depth.shape)
    scale = focal * _KINECT_BASELINE / _DISPARITY_STEP
    valid = (depth > 0) & (noisy >= nearest) & (noisy <= furthest)
    steps = np.rint(scale / np.where(valid, noisy, 1))
    return np.where(valid, scale / steps, 0)
