"""Transforms of depth images: conversion to clouds, segmentation, and fusion."""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from torchrg._checks import as_tensor, check_choices, eager_only
from torchrg.config import DepthConfig, settings_of
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import expand_to_points, sample_voxels
from torchrg.neighbors.voxels import warn_about_voxel
from torchrg.normals import Orientation
from torchrg.structures import UNLABELED, Planes
from torchrg.structures.points import short_repr
from torchrg.transforms.rows import Entries, SampleDict, check_sample
from torchrg.transforms.sample import SampleTransform

if TYPE_CHECKING:
    from torchrg.depth.values import DepthKind


class DepthTransform(SampleTransform):
    """Base class of depth image transforms.

    Results are in world coordinates if a sample has a pose, else in camera coordinates.

    Args:
        depth_scale: Depth units per meter, 1000 for millimeters. Default: 1, meters.
        depth_kind: "z" for depth, "ray" for distances from the camera center. Default: "z".
        keys: Other names for some entries.
    """

    names = (
        *("depth", "intrinsics", "pose", "color", "coord", "pixel", "offset"),
        *("plane", "normal", "curvature", "planes"),
    )

    def __init__(
        self,
        *,
        depth_scale: float = 1.0,
        depth_kind: "DepthKind" = "z",
        keys: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(keys=keys)
        # Loaded here, because other transforms do not need it.
        from torchrg.depth.values import check_conversion

        check_conversion(type(self).__name__, depth_scale, depth_kind)
        self.depth_scale, self.depth_kind = depth_scale, depth_kind

    def read_images(self, sample: Entries) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return depth ``(B, H, W)``, intrinsics ``(B, 3, 3)`` and poses ``(B, 4, 4)`` or None."""
        from torchrg.depth.camera import read_intrinsics

        example = "{'depth': depth, 'intrinsics': matrix}"
        check_sample(type(self).__name__, sample, example)
        key, depth = self.key(sample, "intrinsics"), self.read(sample, "depth")
        if key in sample:
            sample = {**sample, key: read_intrinsics(type(self).__name__, sample[key], depth)}
        intrinsics = self.read(sample, "intrinsics")
        if (
            depth.ndim not in (2, 3, 4)
            or (depth.ndim > 2 and depth.shape[-3] != 1)
            or (depth.ndim == 4 and not len(depth))
        ):
            raise ShapeError(
                f"{type(self).__name__}: expected depth of shape (H, W), (1, H, W) or "
                f"(B, 1, H, W) of at least one image, got {tuple(depth.shape)}."
            )
        depth = depth.reshape(math.prod(depth.shape[:-2]), *depth.shape[-2:])
        has_pose = sample.get(self.key(sample, "pose")) is not None
        poses = self.read(sample, "pose") if has_pose else None
        return (
            depth,
            self._expand("intrinsics", intrinsics, (len(depth), 3, 3)),
            None if poses is None else self._expand("pose", poses, (len(depth), 4, 4)),
        )

    def _expand(self, name: str, values: Tensor, shape: tuple[int, int, int]) -> Tensor:
        """Return one matrix per image; a single matrix applies to all images."""
        expanded = values.expand(shape) if values.shape == shape[1:] else values
        if expanded.shape != shape:
            raise ShapeError(
                f"{type(self).__name__}: expected {name} of shape {shape[1:]} or {shape}, got "
                f"{tuple(values.shape)}."
            )
        return expanded


class DepthToCloud(DepthTransform):
    """Convert depth images to the cloud of their pixels; see :func:`depth_to_points`.

    Reads ``depth`` and ``intrinsics``, and ``pose`` and ``color`` if present, with the shapes of
    :class:`SegmentDepth`; colors are ``(3, H, W)`` or ``(B, 3, H, W)`` of any size. Adds

    * ``coord`` ``(N, 3)``: the pixels with depth, in the dtype of the depth or of the pose;
    * ``pixel`` ``(N,)``, int64: row-major pixel index in the image, so that
      ``image.flatten()[pixel] = labels`` maps labels back;
    * ``offset`` ``(B,)``, int64, for a batch: end row of each image's points;

    and replaces ``color`` by the color of the nearest pixel of each point, ``(N, 3)``.

    Example:
        >>> depth = torch.tensor([[[2.0, 0.0], [2.0, 2.0]]])
        >>> cloud = DepthToCloud()({"depth": depth, "intrinsics": torch.eye(3)})
        >>> cloud["coord"].tolist(), cloud["pixel"].tolist()
        ([[0.0, 0.0, 2.0], [0.0, 2.0, 2.0], [2.0, 2.0, 2.0]], [0, 2, 3])
    """

    @eager_only
    def forward(self, sample: Entries) -> SampleDict:
        """Return a new sample with the cloud."""
        from torchrg.depth.camera import depth_to_points
        from torchrg.depth.values import convert_depth

        depth, intrinsics, poses = self.read_images(sample)
        options = (self.depth_scale, self.depth_kind)
        depth = convert_depth("DepthToCloud", depth, intrinsics, *options)
        images = depth_to_points(depth, intrinsics, poses)
        seen = images[..., 2].isfinite()
        pixel = torch.arange(depth[0].numel(), device=depth.device).view(depth.shape[1:])
        result = {
            **sample,
            self.key(sample, "coord"): images[seen],
            self.key(sample, "pixel"): pixel.expand_as(seen)[seen],
        }
        if self.read(sample, "depth").ndim == 4:  # A batch.
            result[self.key(sample, "offset")] = seen.flatten(1).sum(dim=1).cumsum(dim=0)
        color = self.key(sample, "color")
        if color in sample:
            result[color] = _colors(self.read(sample, "color"), seen)
        return result


def _colors(color: Tensor, seen: Tensor) -> Tensor:
    """Return the colors of the ``seen`` pixels, shape ``(N, 3)``, from images of any size."""
    images = color.reshape(math.prod(color.shape[:-3]), *color.shape[-3:])
    if images.shape[:2] != (len(seen), 3) or (seen.numel() and not images.numel()):
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

    Reads ``depth``, of shape ``(H, W)``, ``(1, H, W)`` or ``(B, 1, H, W)``; ``intrinsics``
    ``(3, 3)`` or ``(B, 3, 3)``, 4 x 4 or a kornia ``PinholeCamera``; and, if present, ``pose``
    ``(4, 4)`` or ``(B, 4, 4)``. With a pose, normals and planes are in world coordinates, else in
    camera coordinates. Adds images, preceded by ``B`` for a batch:

    * ``plane`` ``(H, W)``, int64: 0 to M-1 by descending size in each image, -1 for none;
    * ``normal`` ``(H, W, 3)``: unit normals, 0 for pixels without depth;
    * ``curvature`` ``(H, W)``;

    and with ``planes=True`` also ``planes``, the plane table (:class:`torchrg.structures.Planes`;
    a list of tables for a batch).

    Args:
        config: Configuration, as an object or a dictionary.
        orient: Orientation of normals. Default: towards the camera.
        planes: Whether to add the plane table.
        **changes: Single parameters, as in ``max_depth=4.0``.

    Example:
        >>> intrinsics = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
        >>> sample = {"depth": torch.full((1, 30, 40), 2.0), "intrinsics": intrinsics}
        >>> found = SegmentDepth()(sample)
        >>> found["plane"].unique(), found["normal"][15, 20, 2]
        (tensor([0]), tensor(-1.))
    """

    def __init__(
        self,
        config: DepthConfig | Mapping[str, Any] | None = None,
        *,
        orient: Orientation = "auto",
        planes: bool = False,
        depth_scale: float = 1.0,
        depth_kind: "DepthKind" = "z",
        keys: Mapping[str, str] | None = None,
        **changes: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(depth_scale=depth_scale, depth_kind=depth_kind, keys=keys)
        check_choices("SegmentDepth", orient=(orient, Orientation))
        self.config = settings_of("SegmentDepth", DepthConfig, config, changes)
        self.orient, self.planes = orient, planes

    @eager_only
    def forward(self, sample: Entries) -> SampleDict:
        """Return a new sample with labels, normals and curvature as images."""
        from torchrg.depth import segment_depth

        depth, intrinsics, poses = self.read_images(sample)
        names = ("config", "orient", "depth_scale", "depth_kind")
        options: dict[str, Any] = {name: getattr(self, name) for name in names}
        segmentations = [
            segment_depth(image, camera, pose=None if poses is None else poses[i], **options)
            for i, (image, camera) in enumerate(zip(depth, intrinsics, strict=True))
        ]
        batch, added = self.read(sample, "depth").ndim == 4, SampleDict(sample)
        for name, field in (("plane", "labels"), ("normal", "normals"), ("curvature", "curvature")):
            images = [getattr(seg, field) for seg in segmentations]
            added[self.key(sample, name)] = torch.stack(images) if batch else images[0]
        if self.planes:
            tables = [seg.planes for seg in segmentations]
            added[self.key(sample, "planes")] = tables if batch else tables[0]
        return added


# torch's default_collate gives a list of plane tables, like SegmentDepth for a batch.
default_collate_fn_map[Planes] = lambda tables, **_: list(tables)


@short_repr
class FusedFrames(NamedTuple):
    """Cloud fused from several depth frames.

    Attributes:
        coord: Points in world coordinates, shape ``(N, 3)``, float64: pixels with depth, or voxels.
        color: Colors, shape ``(N, 3)``, uint8; None if any frame has no color.
        frame: Frame index of each point, shape ``(N,)``, int64.
        pixel: Row-major pixel index of each point in its frame, shape ``(N,)``, int64.
        inverse: Index of the point that represents each pixel with depth, frame by frame,
            row-major, shape ``(P,)``, int64.
        seen: Mask of the pixels with depth, per frame, shape ``(H, W)``, bool.
    """

    coord: Tensor
    color: Tensor | None
    frame: Tensor
    pixel: Tensor
    inverse: Tensor
    seen: tuple[Tensor, ...]

    def to_frames(self, values: Tensor, *, fill: int = UNLABELED) -> list[Tensor]:
        """Map per-point values, such as labels, to images of the frames.

        Args:
            values: One row per point, shape ``(N, ...)``.
            fill: Value of pixels without depth; use 0 for normals.

        Returns:
            An image of shape ``(H, W, ...)`` per frame.

        Raises:
            ShapeError: If ``values`` does not have one row per point.
        """
        if len(values) != len(self.coord):
            raise ShapeError(f"to_frames: expected {len(self.coord)} values, got {len(values)}.")
        each = expand_to_points(values, self.inverse)
        images = [values.new_full((*seen.shape, *values.shape[1:]), fill) for seen in self.seen]
        parts = torch.split(each, [int(seen.sum()) for seen in self.seen])
        for image, seen, pixels in zip(images, self.seen, parts, strict=True):
            image[seen] = pixels
        return images


def fuse_depth(samples: Iterable[Entries], *, voxel_size: float | None = None) -> FusedFrames:
    """Fuse depth frames with poses into one cloud.

    Args:
        samples: Samples, or a data set, of :class:`torchrg.datasets.RGBDFrames`: ``depth``
            ``(1, H, W)`` or ``(H, W)``, ``intrinsics`` ``(3, 3)``, ``pose`` ``(4, 4)``, and
            optionally ``color``. Frames may differ in size.
        voxel_size: Keep only the point nearest to the center of each voxel of this size; see
            :func:`torchrg.transforms.sample_voxels`. Default: keep all points.

    Returns:
        The cloud; :meth:`FusedFrames.to_frames` maps its labels back to every frame.

    Raises:
        ConfigError: If there is no sample, one lacks a pose, or ``voxel_size`` is not positive.
        ShapeError: If a shape is not as above.

    Example:
        >>> sample = {"depth": torch.tensor([[1.0, 0.0]]), "intrinsics": torch.eye(3)}
        >>> poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        >>> poses[1, 2, 3] = 5.0
        >>> fused = fuse_depth([{**sample, "pose": pose} for pose in poses])
        >>> fused.coord.tolist(), fused.frame.tolist()
        ([[0.0, 0.0, 1.0], [0.0, 0.0, 6.0]], [0, 1])
        >>> [image.tolist() for image in fused.to_frames(torch.tensor([7, 8]))]
        [[[7, -1]], [[8, -1]]]
    """
    if not samples:
        raise ConfigError("fuse_depth: expected at least one sample, got none.")
    clouds, seen = [], []
    for number, sample in enumerate(samples):
        if "pose" not in sample:
            raise ConfigError(f"fuse_depth: expected a pose in sample {number}, got none.")
        depth = as_tensor("fuse_depth", "depth", sample["depth"])
        pose = as_tensor("fuse_depth", "pose", sample["pose"]).double()
        if depth.ndim == 4:
            raise ShapeError(
                f"fuse_depth: expected depth of shape (1, H, W), got {tuple(depth.shape)}; pass "
                "the frames of a batch one by one."
            )
        cloud = DepthToCloud()({**sample, "pose": pose})
        clouds.append(cloud)
        mask = torch.zeros(depth.shape[-2:], dtype=torch.bool, device=depth.device)
        mask.view(-1)[cloud["pixel"]] = True
        seen.append(mask)
    coord, pixel = (torch.cat([cloud[key] for cloud in clouds]) for key in ("coord", "pixel"))
    counts = torch.tensor([len(cloud["coord"]) for cloud in clouds], device=coord.device)
    frame = torch.arange(len(clouds), device=coord.device).repeat_interleave(counts)
    has_color = all("color" in cloud for cloud in clouds)
    color = torch.cat([cloud["color"] for cloud in clouds]) if has_color else None
    inverse = torch.arange(len(coord), device=coord.device)
    if voxel_size is not None:
        rows, inverse = sample_voxels(coord, voxel_size)
        warn_about_voxel("fuse_depth", voxel_size, len(rows), len(coord))
        coord, frame, pixel = coord[rows], frame[rows], pixel[rows]
        color = None if color is None else color[rows]
    return FusedFrames(coord, color, frame, pixel, inverse, tuple(seen))
