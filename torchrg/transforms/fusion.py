"""Several depth frames as one cloud that remembers where its points come from."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import restore_points, sample_voxels
from torchrg.structures import UNLABELED
from torchrg.transforms.depth import DepthToCloud


class FusedFrames(NamedTuple):
    """A cloud of several depth frames.

    Attributes:
        coord: Points in world coordinates, shape ``(N, 3)``, float64: the pixels with depth, or one
            of each voxel.
        color: Their colours, shape ``(N, 3)``, uint8; None where a frame has none.
        frame: Number of the frame that each point is from, shape ``(N,)``, int64.
        pixel: Row-major place of each point in its frame, shape ``(N,)``, int64.
        inverse: The point that stands for each pixel with depth, frame after frame, row-major,
            shape ``(P,)``, int64.
        seen: Pixels with depth of each frame, of shape ``(H, W)``, bool.
    """

    coord: Tensor
    color: Tensor | None
    frame: Tensor
    pixel: Tensor
    inverse: Tensor
    seen: tuple[Tensor, ...]

    def to_frames(self, values: Tensor, *, fill: int = UNLABELED) -> list[Tensor]:
        """Return values of the points, labels for example, as images of the frames.

        Args:
            values: A row for each point, shape ``(N, ...)``.
            fill: Value of the pixels without depth; for normals 0.

        Returns:
            An image of shape ``(H, W, ...)`` for each frame.

        Raises:
            ShapeError: If there is not a row for each point.
        """
        if len(values) != len(self.coord):
            raise ShapeError(
                f"to_frames: expected values of {len(self.coord)} points, got {len(values)}."
            )
        each = restore_points(values, self.inverse)
        images = [values.new_full((*seen.shape, *values.shape[1:]), fill) for seen in self.seen]
        parts = torch.split(each, [int(seen.sum()) for seen in self.seen])
        for image, seen, part in zip(images, self.seen, parts, strict=True):
            image[seen] = part
        return images


def fuse_depth(
    samples: Sequence[Mapping[str, Any]], *, voxel_size: float | None = None
) -> FusedFrames:
    """Fuse depth frames with poses into one cloud.

    Args:
        samples: Samples as :class:`torchrg.datasets.RGBDFrames` gives them: ``depth``
            ``(1, H, W)`` or ``(H, W)``, ``intrinsics`` ``(3, 3)``, ``pose`` ``(4, 4)``, perhaps
            ``color``. Frames may differ in size.
        voxel_size: Keep one point of each cell of a grid of this size, the one nearest to its
            middle, see :func:`torchrg.transforms.sample_voxels`. Default: all points are kept.

    Returns:
        The cloud; :meth:`FusedFrames.to_frames` takes its labels back into every frame.

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
        coord, frame, pixel = coord[rows], frame[rows], pixel[rows]
        color = None if color is None else color[rows]
    return FusedFrames(coord, color, frame, pixel, inverse, tuple(seen))
