"""Which entries of a sample have a row for each point, and how points leave all of them at once.

``index_valid_keys`` names them, as Pointcept has it. Where nobody made such a list, what is as long
as the cloud counts too. What is as long as the cloud but not on a list that somebody made, or is in
a cloud of few points under an unknown name, is in doubt, and said to be so.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.structures import Array

Sample = Any
"""A sample: a dict of tensors, NumPy arrays and others, or a PyG ``Data`` or ``Batch``."""
Entries = Mapping[str, Any]
"""Contents of a sample by key."""
SampleDict = dict[str, Any]
"""A sample as data sets give it."""
LISTED = "index_valid_keys"
"""The entry that names those with a row for each point."""
POINTCEPT_KEYS = ("coord", "color", "normal", "superpoint", "strength", "segment", "instance")
"""Entries on the list that Pointcept makes for a sample without one when it takes points out."""
OUR_KEYS = ("plane", "curvature", "residual")
"""Entries that torchrg adds."""
_USUAL_KEYS = {
    *POINTCEPT_KEYS,
    *OUR_KEYS,
    *("grid_coord", "displacement", "index", "intensity", "labels", "front"),
    *("pos", "x", "y", "rgb", "norm", "batch", "plane_index", "superpoint_index"),
}
"""Entries that have a row for each point where they are as long as the cloud; PyG's come last."""
_WHOLE_KEYS = ("offset", "ptr", "origin", "pose", "inverse", "inverse_index", LISTED)
"""Entries that have none, however long they are."""
_EARLIER = "origin_"
"""Begins the names of what Pointcept keeps of the points as they were before any left."""
_HOLDING_ROWS = {
    "edge_index": "before edges are made",
    "face": "to clouds without faces",
    "adj_t": "before edges are made",
    "sampled_index": "to samples whose labelled points are not listed",
    "frame_pcd_offset": "before frames are joined",
}
"""Entries that hold numbers of points: who takes points out would have to renumber them."""
_FEW = 16
"""Most points of a cloud in which names alone tell what has a row for each point: a pose or a box
may have as many rows."""


def entries_of(sample: Sample) -> Entries:
    """Return what a sample holds by key."""
    entries: Entries = sample if isinstance(sample, Mapping) else sample.to_dict()
    return entries


def check_sample(caller: str, sample: Sample, example: str) -> None:
    """Raise if something is no sample, and say by an example what is one."""
    is_data = callable(getattr(sample, "to_dict", None)) and hasattr(sample, "__setitem__")
    if not (isinstance(sample, Mapping) or is_data):
        raise ConfigError(
            f"{caller}: expected a sample that is a dict or a PyG Data, got "
            f"{type(sample).__name__}; pass {example}."
        )


def listed_keys(entries: Entries) -> list[str] | None:
    """Return the list of a sample, None if it has none; whatever kind of collection it is."""
    names = entries.get(LISTED)
    if names is None:
        return None
    return [names] if isinstance(names, str) else list(names)


def recognized_keys(entries: Entries, num_points: int, *, whole: Collection[str] = ()) -> list[str]:
    """Return what belongs on a list besides ours: nothing where somebody made the list."""
    return [] if _has_chosen_list(entries) else _sort_keys(entries, num_points, whole)[0]


def with_listed(entries: Entries, keys: Iterable[str]) -> dict[str, list[str]]:
    """Return the list of a sample with some entries on it, those that are there; never the old one.

    Where there is none, it is what Pointcept would begin, and they.
    """
    listed = listed_keys(entries)
    present = [key for key in keys if isinstance(entries.get(key), Tensor | np.ndarray)]
    if listed is None and not present:
        return {}
    begun = POINTCEPT_KEYS if listed is None else listed
    return {LISTED: list(dict.fromkeys([*begun, *present]))}


def _has_chosen_list(entries: Entries) -> bool:
    """Return whether somebody made the list; of usual names alone, nobody did."""
    return not _USUAL_KEYS.issuperset(listed_keys(entries) or ())


def _sort_keys(
    entries: Entries, num_points: int, whole: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the entries with a row for each point, and those that may have one."""
    by_name = _USUAL_KEYS.union(listed_keys(entries) or ())
    by_length = num_points > _FEW and not _has_chosen_list(entries)
    in_rows: list[str] = []
    ambiguous: list[str] = []
    for key, value in entries.items():
        is_whole = key in _WHOLE_KEYS or key in whole or str(key).startswith(_EARLIER)
        if is_whole or num_points == 0 or not _is_as_long(value, num_points):
            continue
        is_array = isinstance(value, Tensor | np.ndarray)
        (in_rows if is_array and (by_length or key in by_name) else ambiguous).append(key)
    return in_rows, ambiguous


def check_in_step(caller: str, entries: Entries, num_points: int) -> None:
    """Raise if an entry that must have a row for each point has another number of rows.

    Which must, the list says; besides, the names that Pointcept and torchrg use, unless the entry
    has the shape of an image.
    """
    listed = listed_keys(entries) or []
    for key in {**dict.fromkeys(listed), **dict.fromkeys((*POINTCEPT_KEYS, *OUR_KEYS))}:
        value = entries.get(key)
        if not isinstance(value, Tensor | np.ndarray) or value.ndim == 0:
            continue
        is_table = value.ndim == 1 or (value.ndim == 2 and value.shape[1] in (1, 3))
        if len(value) != num_points and (key in listed or is_table):
            raise ConfigError(
                f"{caller}: expected {key} with a row for each of {num_points} points, got "
                f"{len(value)} rows; name it in {LISTED!r} before points are taken out, or leave "
                "it out."
            )


def select_points(
    caller: str,
    sample: Sample,
    rows: Tensor,
    num_points: int,
    *,
    whole: Collection[str] = (),
) -> SampleDict:
    """Return the entries of a sample that change when only some rows are kept, given ascending.

    Entries in ``whole`` have no row for each point.

    Raises:
        ConfigError: If it cannot be told what changes, or an entry holds numbers of points.
    """
    entries = entries_of(sample)
    for key, repair in _HOLDING_ROWS.items():
        if entries.get(key) is not None:
            raise ConfigError(
                f"{caller}: expected a sample without {key} to take points out of, got one; apply "
                f"the transform {repair}."
            )
    in_rows, ambiguous = _sort_keys(entries, num_points, whole)
    if ambiguous:
        raise ConfigError(
            f"{caller}: cannot tell whether {', '.join(map(str, ambiguous))} of the sample has a "
            f"row for each of {num_points} points; make it an array and name it in "
            f"{LISTED!r}, or leave it out."
        )
    chosen: SampleDict = {key: _take(entries[key], rows) for key in in_rows}
    ends = torch.tensor(_cloud_ends(sample, num_points), device=rows.device)
    ends = torch.searchsorted(rows, ends)
    if entries.get("offset") is not None:
        chosen["offset"] = _alike(ends, entries["offset"])
    if entries.get("ptr") is not None:
        chosen["ptr"] = _alike(torch.cat([ends.new_zeros(1), ends]), entries["ptr"])
    if entries.get("num_nodes") is not None:
        chosen["num_nodes"] = len(rows)
    return chosen


def follow_points(caller: str, inverse: Tensor, place: Tensor) -> Tensor:
    """Return where the points of ``inverse`` are after rows moved to ``place``, negative for none.

    Raises:
        ConfigError: If ``inverse`` names rows that are not there.
    """
    if len(inverse) and int(inverse.max()) >= len(place):
        raise ConfigError(
            f"{caller}: expected inverse to name rows of {len(place)} points, got row "
            f"{int(inverse.max())}; points were taken out after it was made, so leave it out."
        )
    is_there = inverse >= 0
    moved = inverse.long().clone()
    moved[is_there] = place.to(inverse.device)[moved[is_there]]
    return moved


def rows_of_clouds(sample: Sample, num_points: int) -> list[slice]:
    """Return the rows of each cloud of a sample, by its ``offset`` or ``batch`` if it has one."""
    return [slice(*ends) for ends in itertools.pairwise([0, *_cloud_ends(sample, num_points)])]


def _cloud_ends(sample: Sample, num_points: int) -> list[int]:
    """Return the row that each cloud of a sample ends before; one cloud ends at the last."""
    entries = entries_of(sample)
    if entries.get("offset") is not None:
        ends: list[int] = torch.as_tensor(entries["offset"]).tolist()
        if sorted(ends) != ends or ends[-1:] != [num_points] or ends[0] < 0:
            raise ConfigError(
                f"expected offset to ascend to the number of points ({num_points}), got {ends}."
            )
        return ends
    if entries.get("batch") is not None:
        batch = torch.as_tensor(entries["batch"])
        if len(batch) != num_points or bool((batch.diff() < 0).any()):
            raise ConfigError(
                f"expected batch to ascend over {num_points} points, got {len(batch)} numbers; "
                "sort the points by cloud."
            )
        least = 0 if entries.get("ptr") is None else len(entries["ptr"]) - 1
        counts: list[int] = torch.bincount(batch, minlength=least).cumsum(0).tolist()
        return counts or [0]
    return [num_points]


def _is_as_long(value: object, num_points: int) -> bool:
    """Return whether a value is, or holds, as many rows as there are points.

    Lists count if they hold numbers, and what is nested counts: neither is left behind unseen.
    """
    if isinstance(value, Tensor | np.ndarray):
        return value.ndim > 0 and len(value) == num_points
    if num_points <= _FEW:
        return False
    if isinstance(value, Mapping):
        return any(_is_as_long(inner, num_points) for inner in value.values())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return len(value) == num_points and isinstance(value[0], int | float | Iterable)
    return False


def _take(values: Tensor | Array, rows: Tensor) -> Tensor | Array:
    """Return rows of a tensor or an array, in its own kind and dtype."""
    return values[rows.to(values.device) if isinstance(values, Tensor) else rows.numpy(force=True)]


def _alike(values: Tensor, like: object) -> Tensor | Array:
    """Return whole numbers in the kind, dtype and device of others."""
    if isinstance(like, Tensor):
        return values.to(like)
    return values.numpy(force=True).astype(like.dtype) if isinstance(like, np.ndarray) else values
