"""Work on rows a block at a time, blocks shared among threads."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchrg._chunks import fair_chunks, run_chunks


def each_block(
    work: Callable[[slice], None], num_rows: int, block_size: int, device: torch.device
) -> None:
    """Call ``work`` on slices that together cover all rows; it writes its own rows only.

    Example:
        >>> seen = []
        >>> each_block(seen.append, 5, 3, torch.device("cpu"))
        >>> sorted(seen, key=lambda block: block.start)
        [slice(0, 3, None), slice(3, 5, None)]
    """
    run_chunks(work, fair_chunks(num_rows, block_size), device)


def each_block_of(work: Callable[[Tensor], None], chosen: Tensor, block_size: int) -> None:
    """Call ``work`` on blocks of the row numbers of the chosen points.

    Example:
        >>> seen = []
        >>> each_block_of(seen.append, torch.tensor([True, False, True]), 5)
        >>> seen
        [tensor([0, 2])]
    """
    rows = chosen.nonzero().squeeze(-1)
    each_block(lambda block: work(rows[block]), len(rows), block_size, rows.device)
