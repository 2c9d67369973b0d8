"""Multi-threaded kernel passes over image rows."""

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import allowed_threads, map_tasks, split_rows

_CPU = torch.device("cpu")
_MIN_ROWS = 32
"""Minimum number of rows per thread that outweighs its start."""


def has_kernels(image: Tensor) -> bool:
    """Return whether kernels support a float64 image."""
    return image.device.type == "cpu" and kernels.serve()


def pass_over_rows(name: str, num_rows: int, *arguments: Tensor | float | None) -> None:
    """Call a kernel that writes a range of rows of its tensors."""
    # Two tasks per thread balance the load.
    size = max(-(-num_rows // (2 * allowed_threads())), _MIN_ROWS)
    # An even size keeps rows of cells twice as wide in one task.
    rows = split_rows(num_rows, size + size % 2)
    map_tasks(lambda chunk: kernels.call(name, *arguments, chunk.start, chunk.stop), rows, _CPU)
