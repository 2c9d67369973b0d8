"""PNG files, through the image library that kornia brings."""

import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import ShapeError
from torchrg.io.files import atomic_path
from torchrg.metrics.contingency import INTEGERS


def write_png(path: str | os.PathLike[str], image: Tensor | NDArray[Any]) -> None:
    """Write a picture, or an image of labels, as a PNG file.

    Args:
        path: Where; the file appears whole or not at all.
        image: A picture of shape ``(H, W, 3)``, uint8, for 8 bits a channel; or whole numbers from
            0 to 65535 of shape ``(H, W)``, for 16 bits of gray.

    Raises:
        ShapeError: If the image is neither.
        FormatError: If the file cannot be written.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_png(f"{folder}/black.png", torch.zeros(4, 6, 3, dtype=torch.uint8))
        >>> sorted(os.listdir(folder))
        ['black.png']
    """
    tensor = as_tensor("write_png", "image", image).detach().cpu()
    is_picture = tensor.ndim == 3 and tensor.shape[2] == 3 and tensor.dtype == torch.uint8
    is_gray = tensor.ndim == 2 and tensor.dtype in INTEGERS
    if not (is_picture or is_gray) or tensor.numel() == 0:
        dtype = str(tensor.dtype).removeprefix("torch.")
        raise ShapeError(
            "write_png: expected image of shape (H, W, 3) and uint8, or (H, W) and integers, got "
            f"{tuple(tensor.shape)} and {dtype}."
        )
    values = tensor.numpy()
    if is_gray and not (values.min() >= 0 and values.max() <= 65535):
        raise ShapeError(
            f"write_png: expected image of values from 0 to 65535, got {values.min()} to "
            f"{values.max()}; add 1 to labels, so that UNLABELED becomes 0."
        )
    from kornia_rs import io

    with atomic_path(path) as beside:
        if is_picture:
            io.write_image_png_u8(str(beside), np.ascontiguousarray(values), "rgb")
        else:
            io.write_image_png_u16(str(beside), values.astype(np.uint16)[..., None], "mono")
