"""Rooms as a hand-held Kinect gives them: noisy depth frames fused into one cloud."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import ConfigError
from torchrg.scenes.cameras import cameras_around
from torchrg.scenes.depth import DepthFrame, Sensor, render_depth
from torchrg.scenes.frames import Array
from torchrg.scenes.labeling import label_points
from torchrg.scenes.layout import RoomLayout
from torchrg.scenes.rooms import build_room
from torchrg.scenes.scene import Scene, SceneModel
from torchrg.scenes.streams import random_stream

KINECT_LAYOUT = RoomLayout(
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

_FUSING_STREAM = 400


def make_kinect_room(
    num_points: int = 968_520,
    seed: int = 0,
    *,
    layout: RoomLayout | None = None,
    num_frames: int = 16,
    sensor: Sensor = "kinect",
) -> Scene:
    """Make a cloud of a room from simulated depth frames, placed by their true poses.

    Convention:
        As for :func:`make_room`; normals are those of the faces, towards free space.

    Args:
        num_points: Number of points, a random subset of the pixels with depth.
        seed: Two calls with equal arguments give equal clouds, on every platform.
        layout: What is in the room. Default: ``KINECT_LAYOUT``.
        num_frames: Frames of 640 x 480 pixels, taken around the viewpoints of the room.
        sensor: See :func:`render_depth`.

    Returns:
        The cloud and its truth, in random order.

    Raises:
        ConfigError: If a setting is not allowed, or the frames have too few pixels with depth.

    Example:
        >>> make_kinect_room(1000, num_frames=1).points.shape
        torch.Size([1000, 3])
    """
    model = build_room(seed, layout=layout or KINECT_LAYOUT)
    frames = [
        render_depth(model, camera, sensor=sensor, seed=seed * num_frames + number)
        for number, camera in enumerate(cameras_around(model, num_frames, seed=seed))
    ]
    return fuse_frames(model, frames, num_points, seed=seed)


def fuse_frames(
    model: SceneModel, frames: Sequence[DepthFrame], num_points: int, *, seed: int = 0
) -> Scene:
    """Return depth frames of one scene as one cloud.

    Args:
        model: The scene.
        frames: The frames.
        num_points: Number of points, a random subset of the pixels with depth.
        seed: Of the choice and the order.

    Returns:
        The cloud and its truth, in random order.

    Raises:
        ConfigError: If the frames have too few pixels with depth.

    Example:
        >>> model = build_room()
        >>> frame = render_depth(model, cameras_around(model, 1, width=64, height=48)[0])
        >>> fuse_frames(model, [frame], 500).normals.shape
        torch.Size([500, 3])
    """
    seen = [np.flatnonzero(frame.depth.numpy().ravel() > 0) for frame in frames]
    counts = [len(pixels) for pixels in seen]
    if not 0 < num_points <= sum(counts):
        raise ConfigError(
            f"fuse_frames: expected num_points in [1, {sum(counts)}], the pixels with depth, "
            f"got {num_points}; take fewer points or more frames."
        )
    chosen = np.sort(random_stream(seed, _FUSING_STREAM).permutation(sum(counts))[:num_points])
    ends = np.cumsum([0, *counts])
    rows = [
        pixels[chosen[(chosen >= start) & (chosen < end)] - start]
        for pixels, start, end in zip(seen, ends[:-1], ends[1:], strict=True)
    ]
    fused = [_to_world(frame, pixels) for frame, pixels in zip(frames, rows, strict=True)]
    points = np.concatenate([places for places, _, _ in fused])
    normals = np.concatenate([outwards for _, outwards, _ in fused])
    labels = np.concatenate([faces for _, _, faces in fused])
    order = random_stream(seed, _FUSING_STREAM + 1).permutation(num_points)
    return label_points(
        model,
        points[order].astype(np.float32),
        labels[order],
        normals[order].astype(np.float32),
        None,
    )


def _to_world(
    frame: DepthFrame, pixels: NDArray[np.int64]
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return points, normals and faces of some pixels of a frame, in the world."""
    depth = frame.depth.numpy().reshape(-1, 1)[pixels].astype(np.float64)
    rays = frame.camera.rays().reshape(-1, 3)[pixels]
    normals = frame.normals.numpy().reshape(-1, 3)[pixels].astype(np.float64)
    place = frame.camera.frame
    return (
        place.to_world(depth * rays),
        place.turned(normals),
        frame.labels.numpy().ravel()[pixels],
    )
