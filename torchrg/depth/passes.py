"""Kernels that pass over the rows of an image, on as many threads as torch may use."""

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import allowed_threads, chunks_of, map_tasks

_CPU = torch.device("cpu")

_MIN_ROWS = 32
"""Rows that are worth a thread's start."""


def serves(image: Tensor) -> bool:
    """Tell whether kernels work on an image of float64."""
    return image.device.type == "cpu" and kernels.serve()


def pass_over_rows(name: str, num_rows: int, *arguments: Tensor | float) -> None:
    """Call a kernel that writes the rows of its tensors from one number to another."""
    # Two tasks a thread: whoever begins first takes more.
    size = max(-(-num_rows // (2 * allowed_threads())), _MIN_ROWS)
    # An even number of them: rows of cells twice as wide belong to one task.
    rows = chunks_of(num_rows, size + size % 2)
    map_tasks(lambda chunk: kernels.call(name, *arguments, chunk.start, chunk.stop), rows, _CPU)
