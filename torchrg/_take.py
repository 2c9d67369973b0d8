"""Gathering, fast and without holding up other threads."""

from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Scalar = TypeVar("Scalar", bound=np.generic)


def take(values: NDArray[Scalar], places: NDArray[np.integer]) -> NDArray[Scalar]:
    """Return ``values[places]``, rows of ``values`` at places of any shape.

    NumPy's indexing and ``take`` hold the interpreter's lock, and keep other threads waiting.

    Example:
        >>> take(np.array([5, 6, 7]), np.array([[2, 0]])).tolist()
        [[7, 5]]
    """
    rows = torch.from_numpy(values).index_select(0, torch.from_numpy(places.reshape(-1)))
    return rows.numpy().reshape(places.shape + values.shape[1:])


def places_of(mask: Tensor) -> Tensor:
    """Return where a mask is True, counted along all its elements, shape ``(n,)``, int64.

    Example:
        >>> places_of(torch.tensor([[True, False], [False, True]]))
        tensor([0, 3])
    """
    if mask.device.type == "cpu":
        # Ten times faster than torch's, and than selecting by the mask.
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.reshape(-1).nonzero().squeeze(1)
