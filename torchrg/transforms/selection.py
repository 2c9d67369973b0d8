"""Some of the points of a sample, in every entry that has a row for each."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import ConfigError
from torchrg.transforms.sample import cloud_ends, entries_of

NOT_PER_POINT = ("offset", "origin", "pose", "inverse")
"""Entries that have no row for each point that is there, however long they are."""


def select_points(
    sample: Any,  # noqa: ANN401
    rows: Tensor,
    *,
    num_points: int,
) -> dict[str, Tensor]:
    """Return the entries of a sample that change when it is reduced to some of its points.

    Args:
        sample: The sample. Which entries have a row for each point, ``index_valid_keys`` says as
            Pointcept does, or else their length.
        rows: The points to keep, ascending, shape ``(n,)``.
        num_points: Number of points of the sample.

    Returns:
        The changed entries, ``offset`` among them where the sample has it.

    Raises:
        ConfigError: If the sample has edges, or is a batch that can be taken apart again.
    """
    entries = entries_of(sample)
    for key, repair in (("edge_index", "before edges are made"), ("ptr", "before batching")):
        if key in entries:
            raise ConfigError(
                f"expected a sample without {key} to take points out of, got one; apply the "
                f"transform {repair}."
            )
    named = entries.get("index_valid_keys")
    chosen = {}
    for key, value in entries.items():
        if not isinstance(value, Tensor | np.ndarray) or key in NOT_PER_POINT:
            continue
        if value.ndim and len(value) == num_points and (named is None or key in named):
            tensor = as_tensor("select_points", key, value)
            chosen[key] = tensor[rows.to(tensor.device)]
    if "offset" in entries:
        offset = torch.as_tensor(entries["offset"])
        ends = torch.tensor(cloud_ends(sample, num_points), device=rows.device)
        chosen["offset"] = torch.searchsorted(rows, ends).to(offset)
    return chosen
