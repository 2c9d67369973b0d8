"""Float64 points as float32, the precision of the kernels."""

import numpy as np
import torch
from torch import Tensor

from torchrg.structures import FARTHEST
from torchrg.structures.points import bounding_box, local_origin
from torchrg.structures.precision import is_fine_step


def to_single(points: Tensor) -> Tensor:
    """Return finite float64 points ``(N, 3)`` as float32, if its steps are fine for their spacing.

    Estimators and region growing depend on differences of coordinates alone. The points are
    therefore relative to :func:`torchrg.structures.local_origin`, as those of a cloud are. Other
    points are unchanged: of another dtype or device, or with gradients.
    """
    is_plain = points.device.type == "cpu" and not points.requires_grad
    if points.dtype != torch.float64 or not is_plain or len(points) == 0:
        return points
    coordinates = points.numpy()
    low, high = bounding_box(coordinates)
    origin = local_origin(low, high)
    reach = float(np.abs([low - origin, high - origin]).max())
    if not 1 / FARTHEST < reach < FARTHEST:
        return points
    if not is_fine_step(float(np.spacing(np.float32(reach))), coordinates):
        return points
    return torch.from_numpy((coordinates - origin).astype(np.float32))


def is_single(values: Tensor) -> bool:
    """Return whether values of any dtype are float32 numbers, as those computed by kernels.

    Example:
        >>> is_single(torch.tensor([0.1, torch.nan]).double())
        True
        >>> is_single(torch.tensor([0.1], dtype=torch.float64))
        False
    """
    same = values.float().to(values.dtype) == values
    return bool((same | values.isnan()).all())
