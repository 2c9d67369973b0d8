"""Depth cameras: pinhole geometry, the noise of a Kinect, and frames fused to a cloud."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tests.made.rays import cast_rays
from tests.made.scanners import ScannedLayout, ScannedModel, build_scanned_room
from torchrg.scenes import Scene, SceneModel
from torchrg.scenes.geometry import Doubles, Frame, unit
from torchrg.scenes.scene import label_points
from torchrg.structures import UNLABELED

Sensor = Literal["exact", "kinect", "kinect2"]

_SENSOR_NOISE, _CAMERAS, _FUSION = 200, 300, 400
"""What random numbers are drawn for."""

_GOLDEN_ANGLE = (3 - np.sqrt(5)) * np.pi
_STEEPEST = 0.5
"""Tangent of the steepest look downwards."""

_KINECT_BASELINE = 0.075
"""Meters."""
_KINECT_RANGE = (0.4, 8.0)
"""Meters."""
_DISPARITY_STEP = 1 / 8
"""Pixels."""
_NOISE_FLOOR, _NOISE_GROWTH = 0.0012, 0.0019
"""Standard deviation at the nearest depth, meters, and its growth with the square beyond it."""

_KINECT2_RANGE = (0.5, 4.5)
"""Meters, of a Kinect v2."""
_KINECT2_NOISE = (0.0015, -0.0005, 0.0003)
"""Standard deviation of its depth in meters: a polynomial of the depth in meters."""
_KINECT2_SIZE, _KINECT2_FOCAL = (512, 424), 365.0
"""Pixels."""

KINECT_LAYOUT = ScannedLayout(
    size=(5.4, 4.4, 2.6),
    num_doors=1,
    num_windows=1,
    num_cabinets=1,
    num_tables=2,
    num_boxes=1,
    num_small_boxes=2,
    num_pillars=0,
    num_viewpoints=2,
)
"""An office small enough for the range of a Kinect."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in a scene, upright; its view is by default as wide as a Kinect's.

    Its axes are x to the right, y down, z forwards; the middle of the first pixel is at (0, 0), the
    optical axis in the middle of the picture.

    Args:
        frame: Position and axes in the world.
        width: Pixels in a row.
        height: Pixels in a column.
        focal: Focal length in pixels.

    Example:
        >>> camera = Camera.looking((1, 1, 1.5), (4, 1, 1.5))
        >>> camera.pose[:3, 2].tolist()
        [1.0, 0.0, 0.0]
    """

    frame: Frame
    width: int = 640
    height: int = 480
    focal: float = 525.0

    @classmethod
    def looking(
        cls, position: ArrayLike, target: ArrayLike, *, width: int = 640, height: int = 480
    ) -> "Camera":
        """Return a camera that looks at a place, not straight up or down."""
        origin = np.asarray(position, dtype=np.float64)
        forwards = unit(np.asarray(target, dtype=np.float64) - origin)
        right = unit(np.cross(forwards, np.array([0, 0, 1.0])))
        frame = Frame(origin, np.stack([right, np.cross(forwards, right), forwards]))
        return cls(frame, width, height, 525 * width / 640)

    @property
    def intrinsics(self) -> Tensor:
        """Matrix from camera coordinates to pixels, shape ``(3, 3)``, float64."""
        cx, cy = (self.width - 1) / 2, (self.height - 1) / 2
        rows = [[self.focal, 0, cx], [0, self.focal, cy], [0, 0, 1]]
        return torch.tensor(rows, dtype=torch.float64)

    @property
    def pose(self) -> Tensor:
        """Matrix from camera to world coordinates, shape ``(4, 4)``, float64."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.frame.axes.T, self.frame.origin
        return torch.from_numpy(pose)

    def rays(self) -> Doubles:
        """Return what each pixel sees, in camera coordinates with depth 1, ``(H, W, 3)``."""
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0] = (np.arange(self.width) - (self.width - 1) / 2) / self.focal
        rays[..., 1] = ((np.arange(self.height) - (self.height - 1) / 2) / self.focal)[:, None]
        return rays


def cameras_around(
    model: ScannedModel, num_cameras: int, *, seed: int = 0, width: int = 640, height: int = 480
) -> list[Camera]:
    """Return cameras at the viewpoints of a scene, as of someone who turns around and looks down.

    They take turns at the viewpoints, in directions apart by the golden angle; the seed is that of
    the first direction and of how far down they look.
    """
    rng = np.random.default_rng([seed, _CAMERAS])
    headings = rng.random() * 2 * np.pi + _GOLDEN_ANGLE * np.arange(num_cameras)
    drops = rng.random(num_cameras) * _STEEPEST
    cameras = []
    for number, (heading, drop) in enumerate(zip(headings, drops, strict=True)):
        position = model.viewpoints[number % len(model.viewpoints)]
        target = position + np.array([np.cos(heading), np.sin(heading), -drop])
        cameras.append(Camera.looking(position, target, width=width, height=height))
    return cameras


class DepthFrame(NamedTuple):
    """A depth image with its exact truth.

    Attributes:
        depth: Distance along the optical axis in meters, shape ``(H, W)``, float32; 0 where there
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
    model: ScannedModel, camera: Camera | None = None, *, sensor: Sensor = "exact", seed: int = 0
) -> DepthFrame:
    """Render what a depth camera sees, by exact ray casting.

    The Kinect's noise is the axial one of [1]: a standard deviation of
    ``0.0012 + 0.0019 (z - 0.4)^2`` meters along the optical axis; then the disparity, for a
    baseline of 7.5 cm, is rounded to an eighth of a pixel, and depth outside of 0.4 to 8 m is
    dropped. A Kinect v2 measures the time of flight, without such steps: its noise is the axial one
    of [2] for surfaces that face it, ``0.0015 - 0.0005 z + 0.0003 z^2``, from 0.5 to 4.5 m.

    The camera is by default the first of :func:`cameras_around`, of the same seed as the noise.

    References:
        [1] C. V. Nguyen, S. Izadi, D. Lovell. Modeling Kinect sensor noise for improved 3D
        reconstruction and tracking. 3DIMPVT, 2012.
        [2] P. Fankhauser et al. Kinect v2 for mobile robot navigation: evaluation and modeling.
        ICAR, 2015.
    """
    camera = cameras_around(model, 1, seed=seed)[0] if camera is None else camera
    rays = camera.rays()
    steps = camera.frame.vectors_to_world(rays.reshape(-1, 3))
    exact, faces = cast_rays(model, camera.frame.origin, steps.reshape(rays.shape))
    normals = np.zeros_like(steps)
    for face, surface in enumerate(model.surfaces):
        rows = np.flatnonzero(faces == face)
        points = camera.frame.origin + exact.ravel()[rows, None] * steps[rows]
        normals[rows] = camera.frame.vectors_to_local(surface.normals_at(points))
    depth = np.where(faces == UNLABELED, 0, exact)
    rng = np.random.default_rng([seed, _SENSOR_NOISE])
    if sensor == "kinect":
        depth = _as_kinect(depth, camera.focal, rng)
    if sensor == "kinect2":
        depth = _as_kinect2(depth, rng)
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


def _as_kinect(depth: Doubles, focal: float, rng: np.random.Generator) -> Doubles:
    """Return depth with the noise and the steps of a Kinect; 0 where out of its range."""
    nearest, furthest = _KINECT_RANGE
    beyond = depth - nearest
    noisy = depth + (_NOISE_FLOOR + _NOISE_GROWTH * beyond * beyond) * rng.standard_normal(
        depth.shape
    )
    scale = focal * _KINECT_BASELINE / _DISPARITY_STEP
    valid = (depth > 0) & (noisy >= nearest) & (noisy <= furthest)
    steps = np.rint(scale / np.where(valid, noisy, 1))
    return np.where(valid, scale / steps, 0)


def _as_kinect2(depth: Doubles, rng: np.random.Generator) -> Doubles:
    """Return depth with the noise of a Kinect v2; 0 where out of its range."""
    nearest, furthest = _KINECT2_RANGE
    constant, slope, bend = _KINECT2_NOISE
    deviation = constant + slope * depth + bend * depth * depth
    noisy = depth + deviation * rng.standard_normal(depth.shape)
    return np.where((depth > 0) & (noisy >= nearest) & (noisy <= furthest), noisy, 0)


def make_kinect_room(
    num_points: int, seed: int = 0, *, num_frames: int = 16, sensor: Sensor = "kinect"
) -> Scene:
    """Make a cloud of an office from simulated depth frames, placed by their true poses.

    The points are a random subset of the pixels with depth, in random order; normals are those of
    the faces, towards free space.
    """
    model = build_scanned_room(seed, layout=KINECT_LAYOUT)
    frames = [
        render_depth(model, camera, sensor=sensor, seed=seed * num_frames + number)
        for number, camera in enumerate(cameras_around(model, num_frames, seed=seed))
    ]
    return fuse_frames(model, frames, num_points, seed=seed)


def make_mapped_room(
    num_points: int, seed: int = 0, *, num_frames: int = 48, voxel: float = 0.011
) -> Scene:
    """Make the map of an office that a Kinect v2 was carried through: the mean of each voxel.

    A voxel, of a side in meters, has the mean of the points of all frames in it, as RTAB-Map
    exports its maps. The points are a random subset of these, in random order; face and normal are
    of one point in each.
    """
    model, rng = (
        build_scanned_room(seed, layout=KINECT_LAYOUT),
        np.random.default_rng([seed, _FUSION + 2]),
    )
    width, height = _KINECT2_SIZE
    parts = []
    for number, camera in enumerate(
        cameras_around(model, num_frames, seed=seed, width=width, height=height)
    ):
        camera = replace(camera, focal=_KINECT2_FOCAL)
        frame = render_depth(model, camera, sensor="kinect2", seed=seed * num_frames + number)
        pixels = np.flatnonzero(frame.depth.numpy().ravel() > 0)
        rng.standard_normal((2, 3))  # A frame's drift, once; which points are chosen hangs on it.
        parts.append(_to_world(frame, pixels))
    points, normals, faces = map(np.concatenate, zip(*parts, strict=True))
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    sides = cells.max(axis=0) + 1
    _, firsts, rows, counts = np.unique(
        np.ravel_multi_index(cells.T, sides),
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    means = np.stack([np.bincount(rows, column) for column in points.T], axis=1) / counts[:, None]
    kept = rng.permutation(len(firsts))[:num_points]
    chosen = firsts[kept]
    return label_points(
        model,
        means[kept].astype(np.float32),
        faces[chosen],
        normals[chosen].astype(np.float32),
    )


def fuse_frames(
    model: SceneModel, frames: Sequence[DepthFrame], num_points: int, *, seed: int = 0
) -> Scene:
    """Return a random subset of the pixels with depth of frames of one scene, in random order."""
    seen = [np.flatnonzero(frame.depth.numpy().ravel() > 0) for frame in frames]
    counts = [len(pixels) for pixels in seen]
    chosen = np.sort(np.random.default_rng([seed, _FUSION]).permutation(sum(counts))[:num_points])
    ends = np.cumsum([0, *counts])
    rows = [
        pixels[chosen[(chosen >= start) & (chosen < end)] - start]
        for pixels, start, end in zip(seen, ends[:-1], ends[1:], strict=True)
    ]
    fused = [_to_world(frame, pixels) for frame, pixels in zip(frames, rows, strict=True)]
    points, normals, labels = map(np.concatenate, zip(*fused, strict=True))
    order = np.random.default_rng([seed, _FUSION + 1]).permutation(num_points)
    return label_points(
        model,
        points[order].astype(np.float32),
        labels[order],
        normals[order].astype(np.float32),
    )


def _to_world(
    frame: DepthFrame, pixels: NDArray[np.int64]
) -> tuple[Doubles, Doubles, NDArray[np.int64]]:
    """Return points, normals and faces of some pixels of a frame, in the world."""
    depth = frame.depth.numpy().reshape(-1, 1)[pixels].astype(np.float64)
    rays = frame.camera.rays().reshape(-1, 3)[pixels]
    normals = frame.normals.numpy().reshape(-1, 3)[pixels].astype(np.float64)
    place = frame.camera.frame
    return (
        place.to_world(depth * rays),
        place.vectors_to_world(normals),
        frame.labels.numpy().ravel()[pixels],
    )
