"""Samples of depth images, one by one or in batches."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from torchrg._checks import as_tensor
from torchrg.errors import ConfigError, ShapeError

DEPTH_KEYS = {
    name: name
    for name in (
        "depth",
        "intrinsics",
        "pose",
        "color",
        "coord",
        "pixel",
        "offset",
        "plane",
        "normal",
        "curvature",
        "planes",
    )
}
"""Names of the keys in a sample of depth images."""


class DepthTransform(nn.Module):
    """Base of the transforms of depth images: names of keys, and images one by one.

    Args:
        keys: Other names for some of :data:`DEPTH_KEYS`.
        world: Whether results are in world coordinates where a sample has a pose; otherwise they
            are in camera coordinates.
    """

    def __init__(self, *, keys: Mapping[str, str] | None, world: bool) -> None:
        super().__init__()
        unknown = set(keys or {}) - set(DEPTH_KEYS)
        if unknown:
            raise ConfigError(
                f"{type(self).__name__}: expected keys to rename {', '.join(DEPTH_KEYS)}, got "
                f"{', '.join(sorted(unknown))}."
            )
        self.keys = {**DEPTH_KEYS, **(keys or {})}
        self.world = world

    def read(self, sample: Mapping[str, Any]) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return depth ``(B, H, W)``, intrinsics ``(B, 3, 3)`` and poses ``(B, 4, 4)`` or None.

        Raises:
            ConfigError: If the sample lacks depth or intrinsics.
            ShapeError: If their shapes are not as in :class:`SegmentDepth`.
        """
        caller = type(self).__name__
        for name in ("depth", "intrinsics"):
            if self.keys[name] not in sample:
                raise ConfigError(
                    f"{caller}: expected a sample with {self.keys[name]!r}, got "
                    f"{', '.join(map(str, sample))}; rename it with keys={{{name!r}: ...}}."
                )
        depth = as_tensor(caller, "depth", sample[self.keys["depth"]])
        if depth.ndim not in (2, 3, 4) or (depth.ndim > 2 and depth.shape[-3] != 1):
            raise ShapeError(
                f"{caller}: expected depth of shape (H, W), (1, H, W) or (B, 1, H, W), got "
                f"{tuple(depth.shape)}."
            )
        depth = depth.reshape(-1, *depth.shape[-2:])
        intrinsics = as_tensor(caller, "intrinsics", sample[self.keys["intrinsics"]])
        pose = sample.get(self.keys["pose"]) if self.world else None
        poses = None if pose is None else as_tensor(caller, "pose", pose)
        return (
            depth,
            _one_each(caller, "intrinsics", intrinsics, (len(depth), 3, 3)),
            None if poses is None else _one_each(caller, "pose", poses, (len(depth), 4, 4)),
        )

    def is_batch(self, sample: Mapping[str, Any]) -> bool:
        """Return whether the depth of a sample is a batch, ``(B, 1, H, W)``."""
        return bool(sample[self.keys["depth"]].ndim == 4)


def _one_each(caller: str, name: str, values: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Return a matrix for each image; one of shape ``(n, n)`` serves all."""
    given = values.expand(shape) if values.ndim == 2 and values.shape == shape[1:] else values
    if given.shape != shape:
        raise ShapeError(
            f"{caller}: expected {name} of shape {shape[1:]} or {shape}, got {tuple(values.shape)}."
        )
    return given
