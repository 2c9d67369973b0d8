"""Batches of PyG, which is never imported before one of its own objects is here."""

import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

_MADE_BY_BATCHING = ("batch", "ptr", "num_nodes")


def is_separable(sample: Any) -> bool:  # noqa: ANN401
    """Return whether a sample is a PyG ``Batch`` that can be taken apart into its clouds.

    One whose points were taken out by hand cannot; it counts as one sample with ``batch``.
    """
    slices = getattr(sample, "_slice_dict", None)
    if not slices or not callable(getattr(sample, "to_data_list", None)):
        return False
    return all(
        int(ends[-1]) == sample[key].shape[sample.__cat_dim__(key, sample[key]) or 0]
        for key, ends in slices.items()
        # Matrices stacked along a diagonal have two axes of ends, and no row for a point.
        if key in sample and isinstance(sample[key], Tensor) and ends.ndim == 1
    )


def with_each(batch: Any, change: Callable[[Any], Any]) -> Any:  # noqa: ANN401
    """Return a batch of the changed clouds of a batch; the given one is not changed.

    What was added to the batch after it was made stays: rows of points with their clouds, the rest
    as it is. ``follow_batch`` is kept.
    """
    clouds, whole = batch.to_data_list(), {}
    followed = [key for key in batch._slice_dict if f"{key}_ptr" in batch]  # noqa: SLF001
    made = {*_MADE_BY_BATCHING, *(f"{key}_{part}" for key in followed for part in ("batch", "ptr"))}
    for key in set(batch.keys()) - set(batch._slice_dict) - made:  # noqa: SLF001
        value = batch[key]
        if isinstance(value, Tensor) and value.ndim and len(value) == batch.num_nodes:
            for cloud, part in zip(clouds, _parts(value, batch), strict=True):
                cloud[key] = part
        else:
            whole[key] = value
    join = importlib.import_module("torch_geometric.data").Batch.from_data_list
    changed = join([change(cloud) for cloud in clouds], follow_batch=followed)
    for key, value in whole.items():
        changed[key] = value
    return changed


def _parts(values: Tensor, batch: Any) -> list[Tensor]:  # noqa: ANN401
    """Return the rows of each cloud of a batch."""
    counts = torch.bincount(batch.batch, minlength=batch.num_graphs).tolist()
    return list(torch.split(values, counts))
