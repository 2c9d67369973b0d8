"""Collation of clouds into ragged batches."""

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import default_collate

from torchrg._checks import as_tensor, default_device_cpu
from torchrg.errors import ShapeError
from torchrg.transforms.rows import LIST_KEY, Entries, SampleDict, get_list
from torchrg.transforms.sample import NeighborSearch


@default_device_cpu()
def collate_offset(
    samples: Sequence[Entries],
    *,
    coord: str = "coord",
    unique: Sequence[str] = (),
) -> SampleDict:
    """Collate samples as Pointcept does: concatenated arrays, and ``offset``, each cloud's end row.

    Convention:
        Labels are per cloud: plane 0 of the first cloud and plane 0 of the second are different
        planes. Labels named in ``unique`` are offset instead; negative ones (none) are unchanged.

    Args:
        samples: Samples with the same keys. Tensors and arrays are concatenated along their first
            axis, scalars stacked, other values collected in a list; ``inverse`` then has rows of
            the batch. Cached neighbors are dropped.
        coord: Key whose length is the number of points of a sample.
        unique: Keys of labels to make distinct across clouds, as in ``("plane", "superpoint")``,
            so that a network can pool over them.

    Returns:
        The batch, with ``offset`` ``(B,)`` int64. Samples that have an ``offset`` are batches and
        are merged into one. ``index_valid_keys`` is one list.

    Raises:
        ShapeError: If there are no samples, their keys differ, or a key in ``unique`` is missing.

    Example:
        >>> samples = [{"coord": torch.zeros(2, 3)}, {"coord": torch.ones(3, 3)}]
        >>> batch = collate_offset(samples)
        >>> batch["coord"].shape, batch["offset"]
        (torch.Size([5, 3]), tensor([2, 5]))
        >>> for sample in samples:
        ...     sample["plane"] = torch.arange(len(sample["coord"])) - 1
        >>> collate_offset(samples, unique=["plane"])["plane"]
        tensor([-1,  0, -1,  1,  2])
    """
    samples = [{k: v for k, v in s.items() if not isinstance(v, NeighborSearch)} for s in samples]
    keys = list(samples[0]) if samples else []
    for i, sample in enumerate(samples):
        if set(sample) != set(keys):
            different = ", ".join(sorted(set(sample) ^ set(keys)))
            raise ShapeError(
                f"collate_offset: expected samples with the same keys, got {different} in only one "
                f"of samples 0 and {i}; remove it, or add it to all samples with a transform."
            )
    for key in (coord, *unique):
        if key not in keys:
            raise ShapeError(f"collate_offset: expected {key!r}, got {', '.join(keys) or 'none'}.")
    ends = [torch.as_tensor(s.get("offset", [len(s[coord])])) for s in samples]
    counts = [end.diff(prepend=end.new_zeros(1)).to(ends[0].device) for end in ends]
    batch = {key: _join(key, [s[key] for s in samples]) for key in keys if key != "offset"}
    for key in dict.fromkeys([*["inverse"] * ("inverse" in batch), *unique]):
        numbers = [as_tensor("collate_offset", key, s[key]) for s in samples]
        sizes = [
            len(s[coord]) if key == "inverse" else (int(ids.max()) + 1 if len(ids) else 0)
            for s, ids in zip(samples, numbers, strict=True)
        ]
        pairs = zip(numbers, itertools.accumulate(sizes, initial=0), strict=False)
        batch[key] = torch.cat([torch.where(ids >= 0, ids + start, ids) for ids, start in pairs])
    if LIST_KEY in batch:
        names = itertools.chain.from_iterable(get_list(s) or () for s in samples)
        batch[LIST_KEY] = list(dict.fromkeys(names))
    return {**batch, "offset": torch.cat(counts).cumsum(0)}


def _join(key: str, values: Sequence[object]) -> object:
    """Collate the values of one key."""
    first = values[0]
    if isinstance(first, Tensor | np.ndarray) and first.ndim > 0:
        return torch.cat([as_tensor("collate_offset", key, value) for value in values])
    if isinstance(first, Tensor | np.ndarray | int | float):
        return default_collate(list(values))
    return list(values)
