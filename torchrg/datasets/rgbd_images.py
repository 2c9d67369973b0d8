"""Depth and colour images from files."""

import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import ConfigError, FormatError

DEPTH_SUFFIXES = (".png", ".npy")
"""Suffixes of depth images."""


def read_depth(
    path: str | os.PathLike[str], *, depth_scale: float, no_depth: int | None = None
) -> Tensor:
    """Read a depth image.

    Args:
        path: A gray PNG of 16 bits, or a ``.npy`` of shape ``(H, W)`` with numbers.
        depth_scale: Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres. It
            is not in the files, and never guessed.
        no_depth: Stored value that means "no depth" beside 0 (65535 in 7-Scenes).

    Returns:
        Depth in metres, shape ``(H, W)``, float32; 0 where there is none (0, negative, not finite).

    Raises:
        FormatError: If the file is missing, damaged, or not a depth image.
        ConfigError: If ``depth_scale`` is not positive.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "depth.npy"
        >>> np.save(path, np.array([[1500, 0]], dtype=np.uint16))
        >>> read_depth(path, depth_scale=1000)
        tensor([[1.5000, 0.0000]])
    """
    if not 0 < depth_scale < float("inf"):
        raise ConfigError(f"read_depth: expected depth_scale > 0, got {depth_scale}.")
    source = Path(path)
    if source.suffix.lower() not in DEPTH_SUFFIXES:
        known = " ".join(DEPTH_SUFFIXES)
        raise FormatError(
            f"{source}: expected a depth image that ends in one of {known}, got {source.suffix!r}."
        )
    stored = _read_npy(source) if source.suffix.lower() == ".npy" else _read_png16(source)
    depth = stored.astype(np.float64)
    with np.errstate(invalid="ignore"):
        bad = ~(np.isfinite(depth) & (depth > 0))
    if no_depth is not None:
        bad |= stored == no_depth
    return torch.from_numpy((np.where(bad, 0, depth) / depth_scale).astype(np.float32))


def read_color(path: str | os.PathLike[str]) -> Tensor:
    """Read a colour image.

    Args:
        path: PNG or JPEG of 8 bits a channel.

    Returns:
        Red, green and blue, shape ``(3, H, W)``, uint8; a gray image has three equal channels.

    Raises:
        FormatError: If the file is missing, damaged, or not such an image.

    Example:
        >>> read_color("missing.png")
        Traceback (most recent call last):
            ...
        torchrg.errors.FormatError: missing.png: cannot be read: No such file or directory.
    """
    from kornia_rs import io

    source = _existing(Path(path))
    try:
        image = np.asarray(io.read_image(str(source)))
    except Exception as error:
        raise FormatError(f"{source}: expected a PNG or JPEG image, got {error}.") from error
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise FormatError(
            f"{source}: expected a colour image of 8 bits a channel, got shape {image.shape} and "
            f"{image.dtype}."
        )
    channels = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    return torch.from_numpy(np.ascontiguousarray(channels.transpose(2, 0, 1)))


def _read_png16(source: Path) -> NDArray[np.uint16]:
    """Return the values of a gray PNG of 16 bits, shape ``(H, W)``."""
    from kornia_rs import io

    _existing(source)
    try:
        # Without a mode, the library says how many bits and channels there are.
        image = np.asarray(io.read_image(str(source)))
    except Exception as error:
        raise FormatError(f"{source}: expected a PNG image, got {error}.") from error
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 1:
        raise FormatError(
            f"{source}: expected a gray PNG of 16 bits, got shape {image.shape} and {image.dtype}; "
            "depth does not fit into 8 bits or colours."
        )
    values: NDArray[np.uint16] = image[..., 0]
    return values


def _read_npy(source: Path) -> NDArray[np.number]:
    """Return the values of a ``.npy`` file, shape ``(H, W)``."""
    _existing(source)
    try:
        values: NDArray[np.number] = np.load(source, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise FormatError(f"{source}: expected an array of numbers, got {error}.") from error
    if values.ndim != 2 or values.dtype.kind not in "fiu" or values.size == 0:
        raise FormatError(
            f"{source}: expected depth of shape (H, W), got {values.shape} and {values.dtype}."
        )
    return values


def _existing(source: Path) -> Path:
    """Return a path to a file that can be opened.

    Raises:
        FormatError: If it cannot.
    """
    try:
        with source.open("rb"):
            return source
    except OSError as error:
        raise FormatError(f"{source}: cannot be read: {error.strerror}.") from error
