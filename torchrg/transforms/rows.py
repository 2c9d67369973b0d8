"""Detection and consistent selection of per-point entries of a sample.

``index_valid_keys`` lists the per-point entries, as in Pointcept. Without a user-defined list,
known names and arrays as long as the cloud count too. An entry as long as the cloud is ambiguous
if it is missing from a user-defined list, or unknown in a cloud of few points.
"""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.structures.points import Array

Sample = Any
"""A sample: a dict of tensors, NumPy arrays and other values, or a PyG ``Data`` or ``Batch``."""
Entries = Mapping[str, Any]
"""Sample entries by key."""
SampleDict = dict[str, Any]
"""A sample as returned by data sets."""
LIST_KEY = "index_valid_keys"
"""Key of the list of per-point entries."""
POINTCEPT_KEYS = ("coord", "color", "normal", "superpoint", "strength", "segment", "instance")
"""Entries that Pointcept lists by default when it removes points from a sample."""
TORCHRG_KEYS = ("plane", "curvature", "residual")
"""Per-point entries that torchrg adds."""
_PER_POINT_KEYS = {
    *POINTCEPT_KEYS,
    *TORCHRG_KEYS,
    *("grid_coord", "displacement", "index", "intensity", "labels", "front"),
    *("pos", "x", "y", "rgb", "norm", "batch", "plane_index", "superpoint_index"),
}
"""Entries that are per point if they are as long as the cloud; PyG's come last."""
_NEVER_PER_POINT = ("offset", "ptr", "origin", "pose", "inverse", "inverse_index", LIST_KEY)
"""Entries that are never per point, whatever their length."""
_COPY_PREFIX = "origin_"
"""Prefix of Pointcept's copies of entries from before points were removed."""
_INDEX_KEYS = {
    "edge_index": "before edges are made",
    "face": "to clouds without faces",
    "adj_t": "before edges are made",
    "sampled_index": "to samples whose labeled points are not listed",
    "frame_pcd_offset": "before frames are joined",
}
"""Entries that contain point indices, which removing points would invalidate, and the fix."""
_MAX_AMBIGUOUS_POINTS = 16
"""Maximum number of points of a cloud in which only names identify per-point entries: a pose or a
box may have the same number of rows."""


def get_entries(sample: Sample) -> Entries:
    """Return the entries of a sample by key."""
    entries: Entries = sample if isinstance(sample, Mapping) else sample.to_dict()
    return entries


def check_sample(caller: str, sample: Sample, example: str) -> None:
    """Raise ConfigError unless the argument is a sample; the message shows an example."""
    is_data = callable(getattr(sample, "to_dict", None)) and hasattr(sample, "__setitem__")
    if not (isinstance(sample, Mapping) or is_data):
        raise ConfigError(
            f"{caller}: expected a dict or a PyG Data, got {type(sample).__name__}; pass {example}."
        )


def get_list(entries: Entries) -> list[str] | None:
    """Return the list of per-point entries of any collection type, or None if there is none."""
    names = entries.get(LIST_KEY)
    if names is None:
        return None
    return [names] if isinstance(names, str) else list(names)


def per_point_keys(entries: Entries, num_points: int, *, skip: Collection[str] = ()) -> list[str]:
    """Return further per-point keys to list; none if the list is user-defined."""
    return [] if _has_user_list(entries) else _classify_keys(entries, num_points, skip)[0]


def extend_list(entries: Entries, keys: Iterable[str]) -> dict[str, list[str]]:
    """Return a new list of per-point entries, extended by the ``keys`` that exist.

    Without a list, it starts with Pointcept's default.
    """
    listed = get_list(entries)
    present = [key for key in keys if isinstance(entries.get(key), Tensor | np.ndarray)]
    if listed is None and not present:
        return {}
    start = POINTCEPT_KEYS if listed is None else listed
    return {LIST_KEY: list(dict.fromkeys([*start, *present]))}


def _has_user_list(entries: Entries) -> bool:
    """Return whether the list is user-defined, i.e. contains other than known names."""
    return not _PER_POINT_KEYS.issuperset(get_list(entries) or ())


def _classify_keys(
    entries: Entries, num_points: int, skip: Collection[str]
) -> tuple[list[str], list[str]]:
    """Return the per-point keys, and the keys that may be per point."""
    by_name = _PER_POINT_KEYS.union(get_list(entries) or ())
    by_length = num_points > _MAX_AMBIGUOUS_POINTS and not _has_user_list(entries)
    in_rows: list[str] = []
    ambiguous: list[str] = []
    for key, value in entries.items():
        skipped = key in _NEVER_PER_POINT or key in skip or str(key).startswith(_COPY_PREFIX)
        if skipped or num_points == 0 or not _has_length(value, num_points):
            continue
        is_array = isinstance(value, Tensor | np.ndarray)
        (in_rows if is_array and (by_length or key in by_name) else ambiguous).append(key)
    return in_rows, ambiguous


def check_lengths(caller: str, entries: Entries, num_points: int) -> None:
    """Raise ConfigError if a per-point entry has a wrong number of rows.

    Checked are listed entries, and names of Pointcept and torchrg, unless the entry is an image.
    """
    listed = get_list(entries) or []
    for key in {**dict.fromkeys(listed), **dict.fromkeys((*POINTCEPT_KEYS, *TORCHRG_KEYS))}:
        value = entries.get(key)
        if not isinstance(value, Tensor | np.ndarray) or value.ndim == 0:
            continue
        is_table = value.ndim == 1 or (value.ndim == 2 and value.shape[1] in (1, 3))
        if len(value) != num_points and (key in listed or is_table):
            raise ConfigError(
                f"{caller}: expected {key} with {num_points} rows, one per point, got "
                f"{len(value)}; name it in {LIST_KEY!r} before points are removed, or remove it."
            )


def select_points(
    caller: str, sample: Sample, rows: Tensor, num_points: int, *, skip: Collection[str] = ()
) -> SampleDict:
    """Return the entries of a sample that change when only ``rows`` (ascending) are kept.

    Entries in ``skip`` are not per point.

    Raises:
        ConfigError: If an entry is ambiguous or contains point indices.
    """
    entries = get_entries(sample)
    for key, repair in _INDEX_KEYS.items():
        if entries.get(key) is not None:
            raise ConfigError(
                f"{caller}: cannot remove points from samples with {key}; apply it {repair}."
            )
    in_rows, ambiguous = _classify_keys(entries, num_points, skip)
    if ambiguous:
        raise ConfigError(
            f"{caller}: cannot decide whether {', '.join(map(str, ambiguous))} of the sample has "
            f"one row per point ({num_points}); make it an array named in {LIST_KEY!r}, or "
            "remove it."
        )
    selected: SampleDict = {key: _select(entries[key], rows) for key in in_rows}
    ends = torch.tensor(_cloud_ends(sample, num_points), device=rows.device)
    ends = torch.searchsorted(rows, ends)
    if entries.get("offset") is not None:
        selected["offset"] = _convert_like(ends, entries["offset"])
    if entries.get("ptr") is not None:
        selected["ptr"] = _convert_like(torch.cat([ends.new_zeros(1), ends]), entries["ptr"])
    if entries.get("num_nodes") is not None:
        selected["num_nodes"] = len(rows)
    return selected


def cloud_rows(sample: Sample, num_points: int) -> list[slice]:
    """Return the rows of each cloud of a sample, from its ``offset`` or ``batch`` if present."""
    return [slice(*ends) for ends in itertools.pairwise([0, *_cloud_ends(sample, num_points)])]


def _cloud_ends(sample: Sample, num_points: int) -> list[int]:
    """Return the end row of each cloud of a sample."""
    entries = get_entries(sample)
    if entries.get("offset") is not None:
        ends: list[int] = torch.as_tensor(entries["offset"]).tolist()
        if sorted(ends) != ends or ends[-1:] != [num_points] or ends[0] < 0:
            raise ConfigError(f"expected offset to ascend to {num_points} points, got {ends}.")
        return ends
    if entries.get("batch") is not None:
        batch = torch.as_tensor(entries["batch"])
        if len(batch) != num_points or bool((batch.diff() < 0).any()):
            raise ConfigError(
                f"expected batch to ascend over {num_points}, got {len(batch)}; sort by cloud."
            )
        min_clouds = 0 if entries.get("ptr") is None else len(entries["ptr"]) - 1
        counts: list[int] = torch.bincount(batch, minlength=min_clouds).cumsum(0).tolist()
        return counts or [0]
    return [num_points]


def _has_length(value: object, num_points: int) -> bool:
    """Return whether a value is, or contains, an array with one row per point.

    Lists of numbers and nested containers count, so that no per-point value is overlooked.
    """
    if isinstance(value, Tensor | np.ndarray):
        return value.ndim > 0 and len(value) == num_points
    if num_points <= _MAX_AMBIGUOUS_POINTS:
        return False
    if isinstance(value, Mapping):
        return any(_has_length(inner, num_points) for inner in value.values())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return len(value) == num_points and isinstance(value[0], int | float | Iterable)
    return False


def _select(values: Tensor | Array, rows: Tensor) -> Tensor | Array:
    """Return rows of a tensor or an array, with its type and dtype."""
    return values[rows.to(values.device) if isinstance(values, Tensor) else rows.numpy(force=True)]


def _convert_like(values: Tensor, like: object) -> Tensor | Array:
    """Convert integers to the type, dtype and device of ``like``."""
    if isinstance(like, Tensor):
        return values.to(like)
    return values.numpy(force=True).astype(like.dtype) if isinstance(like, np.ndarray) else values
