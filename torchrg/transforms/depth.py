"""Depth images as modules: to clouds, and to planes."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchrg.depth import DepthConfig, depth_to_points, segment_depth
from torchrg.errors import ShapeError
from torchrg.transforms.sample import SampleTransform


class DepthTransform(SampleTransform):
    """Base of the transforms of depth images: reads them one by one.

    Args:
        keys: Other names for some of ``names``.
        world: Whether results are in world coordinates where a sample has a pose; otherwise they
            are in camera coordinates.
    """

    names = (
        *("depth", "intrinsics", "pose", "color", "coord", "pixel", "offset"),
        *("plane", "normal", "curvature", "planes"),
    )

    def __init__(self, *, world: bool = True, keys: Mapping[str, str] | None = None) -> None:
        super().__init__(keys=keys)
        self.world = world

    def read_images(self, sample: Mapping[str, Any]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return depth ``(B, H, W)``, intrinsics ``(B, 3, 3)`` and poses ``(B, 4, 4)`` or None.

        Raises:
            ConfigError: If the sample lacks depth or intrinsics.
            ShapeError: If their shapes are not as in :class:`SegmentDepth`.
        """
        depth, intrinsics = self.read(sample, "depth"), self.read(sample, "intrinsics")
        if depth.ndim not in (2, 3, 4) or (depth.ndim > 2 and depth.shape[-3] != 1):
            raise ShapeError(
                f"{type(self).__name__}: expected depth of shape (H, W), (1, H, W) or "
                f"(B, 1, H, W), got {tuple(depth.shape)}."
            )
        depth = depth.reshape(-1, *depth.shape[-2:])
        has_pose = self.world and sample.get(self.key(sample, "pose")) is not None
        poses = self.read(sample, "pose") if has_pose else None
        return (
            depth,
            self._one_each("intrinsics", intrinsics, (len(depth), 3, 3)),
            None if poses is None else self._one_each("pose", poses, (len(depth), 4, 4)),
        )

    def is_batch(self, sample: Mapping[str, Any]) -> bool:
        """Return whether the depth of a sample is a batch, ``(B, 1, H, W)``."""
        return self.read(sample, "depth").ndim == 4

    def _one_each(self, name: str, values: Tensor, shape: tuple[int, int, int]) -> Tensor:
        """Return a matrix for each image; one of shape ``(n, n)`` serves all."""
        given = values.expand(shape) if values.ndim == 2 and values.shape == shape[1:] else values
        if given.shape != shape:
            raise ShapeError(
                f"{type(self).__name__}: expected {name} of shape {shape[1:]} or {shape}, got "
                f"{tuple(values.shape)}."
            )
        return given


class DepthToCloud(DepthTransform):
    """Turn depth images into the cloud of their pixels; see :func:`depth_to_points`.

    Reads ``depth`` and ``intrinsics``, and ``pose`` and ``color`` if there; the shapes are those of
    :class:`SegmentDepth`, colours ``(3, H, W)`` or ``(B, 3, H, W)`` of any size. Adds

    * ``coord`` ``(N, 3)``: the pixels with depth, in the dtype of the depth or that of the pose;
    * ``pixel`` ``(N,)``, int64: row-major place of each in its image, so that
      ``image.flatten()[pixel] = labels`` takes labels back;
    * ``offset`` ``(B,)``, int64, for a batch: where the points of each image end;

    and replaces ``color`` by that of the points, ``(N, 3)``, of the nearest pixel.

    Args:
        world: See :class:`SegmentDepth`.
        keys: Other names for the keys.

    Example:
        >>> depth = torch.tensor([[[2.0, 0.0], [2.0, 2.0]]])
        >>> cloud = DepthToCloud()({"depth": depth, "intrinsics": torch.eye(3)})
        >>> cloud["coord"].tolist(), cloud["pixel"].tolist()
        ([[0.0, 0.0, 2.0], [0.0, 2.0, 2.0], [2.0, 2.0, 2.0]], [0, 2, 3])
    """

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a new sample with the cloud."""
        depth, intrinsics, poses = self.read_images(sample)
        images = depth_to_points(depth, intrinsics)
        if poses is not None:
            poses = poses.to(depth.device)
            turned = images.to(poses.dtype) @ poses[:, None, :3, :3].mT
            images = turned + poses[:, None, None, :3, 3]
        seen = images[..., 2].isfinite()
        pixel = torch.arange(depth[0].numel(), device=depth.device).view(depth.shape[1:])
        result = {
            **sample,
            self.key(sample, "coord"): images[seen],
            self.key(sample, "pixel"): pixel.expand_as(seen)[seen],
        }
        if self.is_batch(sample):
            result[self.key(sample, "offset")] = seen.flatten(1).sum(dim=1).cumsum(dim=0)
        color = self.key(sample, "color")
        if color in sample:
            result[color] = _colors(self.read(sample, "color"), seen)
        return result


def _colors(color: Tensor, seen: Tensor) -> Tensor:
    """Return the colours of some pixels, shape ``(N, 3)``, from images of any size."""
    images = color.reshape(-1, *color.shape[-3:])
    if images.shape[:2] != (len(seen), 3):
        raise ShapeError(
            f"DepthToCloud: expected color of shape (3, H, W) or (B, 3, H, W), got "
            f"{tuple(color.shape)} for {len(seen)} depth images."
        )
    (height, width), (tall, wide) = seen.shape[1:], images.shape[2:]
    rows = torch.arange(height, device=color.device) * tall // height
    columns = torch.arange(width, device=color.device) * wide // width
    return images[:, :, rows[:, None], columns].permute(0, 2, 3, 1)[seen]


class SegmentDepth(DepthTransform):
    """Add plane labels, normals and curvature to depth images; see :func:`segment_depth`.

    Reads ``depth``, of shape ``(H, W)``, ``(1, H, W)`` or ``(B, 1, H, W)``, ``intrinsics``
    ``(3, 3)`` or ``(B, 3, 3)``, and ``pose`` ``(4, 4)`` or ``(B, 4, 4)`` if there. Adds images,
    with ``B`` in front for a batch:

    * ``plane`` ``(H, W)``, int64: 0 to M-1 by descending size in each image, -1 for none;
    * ``normal`` ``(H, W, 3)``: unit normals towards the camera, 0 where there is no depth;
    * ``curvature`` ``(H, W)``;

    and with ``planes=True`` also ``planes``, the table of planes
    (:class:`torchrg.structures.Planes`; a list of them for a batch).

    Args:
        config: Settings.
        world: Whether normals and planes are in world coordinates where a sample has a pose;
            otherwise they are in camera coordinates.
        planes: Whether to add the table.
        keys: Other names for the keys.

    Example:
        >>> intrinsics = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
        >>> sample = {"depth": torch.full((1, 30, 40), 2.0), "intrinsics": intrinsics}
        >>> found = SegmentDepth()(sample)
        >>> found["plane"].unique(), found["normal"][15, 20, 2]
        (tensor([0]), tensor(-1.))
    """

    def __init__(
        self,
        config: DepthConfig | None = None,
        *,
        world: bool = True,
        planes: bool = False,
        keys: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(keys=keys, world=world)
        self.config = config or DepthConfig()
        self.planes = planes

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return a new sample with labels, normals and curvature as images."""
        depth, intrinsics, poses = self.read_images(sample)
        found = [
            segment_depth(image, camera, self.config, pose=None if poses is None else poses[i])
            for i, (image, camera) in enumerate(zip(depth, intrinsics, strict=True))
        ]
        batch, added = self.is_batch(sample), dict[str, Any](sample)
        for name, part in (("plane", "labels"), ("normal", "normals"), ("curvature", "curvature")):
            images = [getattr(seg, part) for seg in found]
            added[self.key(sample, name)] = torch.stack(images) if batch else images[0]
        if self.planes:
            tables = [seg.planes for seg in found]
            added[self.key(sample, "planes")] = tables if batch else tables[0]
        return added

    def extra_repr(self) -> str:
        """Return the settings."""
        return repr(self.config)
