"""The smallest of many distances: one sort of numbers that carry their own positions."""

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._take import take

MAX_CANDIDATES = 512
"""What NumPy sorts without a branch (AVX-512)."""

_POSITION = MAX_CANDIDATES - 1


def sq_distances_between(
    queries: NDArray[np.float32], candidates: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return squared distances from ``(C, Q, 3)`` to ``(C, 3, W)``, shape ``(C, Q, W)``."""
    lengths = (candidates * candidates).sum(axis=1, keepdims=True)
    product = torch.baddbmm(
        torch.from_numpy(lengths), torch.from_numpy(queries), torch.from_numpy(candidates), alpha=-2
    )
    result: NDArray[np.float32] = product.numpy()
    result += (queries * queries).sum(axis=2)[:, :, None]
    return result


def select_smallest(
    sq_distances: NDArray[np.float32], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where the smallest values of each row are, and what the others are not below.

    The last bits of a value give way to its position: one sort does for both.
    """
    keys = sq_distances.view(np.int32)
    keys &= ~_POSITION
    keys |= np.arange(keys.shape[1], dtype=np.int32)
    keys.sort(axis=1)
    bound = (keys[:, count] & ~_POSITION).view(np.float32)
    return (keys[:, :count] & _POSITION).astype(np.int64), bound.astype(np.float64)


def sort_by_distance(
    distances: NDArray[np.float64], rows: NDArray[np.int32], k: int
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the k nearest by (distance, row)."""
    num_rows, count = distances.shape
    position = np.int64(2 ** (count - 1).bit_length() - 1)
    keys = distances.view(np.int64) & ~position
    keys |= np.arange(count)
    keys.sort(axis=1)
    order = keys & position
    order += (np.arange(num_rows) * count)[:, None]
    distances, rows = take(distances.reshape(-1), order), take(rows.reshape(-1), order)
    keys &= ~position
    if (keys[:, 1:] == keys[:, :-1]).any():
        tied = np.flatnonzero((keys[:, 1:] == keys[:, :-1]).any(axis=1))
        by_both = np.lexsort((rows[tied], distances[tied]))
        distances[tied] = np.take_along_axis(distances[tied], by_both, axis=1)
        rows[tied] = np.take_along_axis(rows[tied], by_both, axis=1)
    return distances[:, :k], rows[:, :k]
