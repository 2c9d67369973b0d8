"""Base classes and basic transforms of samples.

A sample is a dict of arrays, or a PyG ``Data`` or ``Batch``, with one cloud or a ragged batch:
``offset`` ``(B,)``, the row after each cloud (Pointcept), or ``batch`` ``(N,)``, the ascending
cloud index of each point (PyG). Transforms treat each cloud separately. PyG is never imported here.
"""

import copy
import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrg._checks import as_tensor, check_batch, check_shapes, eager_only
from torchrg.errors import ConfigError
from torchrg.neighbors import sample_voxels
from torchrg.neighbors.knn import search_distinct
from torchrg.structures import UNLABELED, Neighbors
from torchrg.transforms.rows import (
    LIST_KEY,
    TORCHRG_KEYS,
    Entries,
    Sample,
    SampleDict,
    check_lengths,
    check_sample,
    cloud_rows,
    extend_list,
    get_entries,
    per_point_keys,
    select_points,
)

KEYS = (
    "coord", "normal", "curvature", "residual", "plane", "inverse", "origin", "color", "superpoint",
    "viewpoint", "front", "neighbors",
)  # fmt: skip
"""Default names of sample entries (Pointcept's, and torchrg's)."""
PYG_KEYS = {"coord": "pos", "inverse": "inverse_index"}
"""Default names in a PyG ``Data``, if they differ. When batching, PyG adds offsets to entries with
``index`` in their name, like ``edge_index``: ``inverse_index`` then holds rows of the batch. Use
``keys={"plane": "plane_index", "superpoint": "superpoint_index"}`` to keep planes and superpoints
of different clouds apart."""
_BATCH_KEYS = ("batch", "ptr", "num_nodes")
"""Entries that PyG creates when it batches clouds."""
_MISSING_ROW = torch.iinfo(torch.int64).min
"""Missing index in entries to which PyG adds offsets. Unlike -1, it remains negative after PyG has
added the row counts of earlier clouds."""


class SampleTransform(nn.Module):
    """Base class of transforms, which return a new sample of the input's type.

    Results are NumPy arrays if the coordinates are. New entries are appended to the list of
    per-point entries, Pointcept's ``index_valid_keys``, if present. A PyG ``Batch`` is returned as
    a ``Batch`` that can be split again.

    Args:
        keys: Other names for some of :data:`KEYS`, as in ``{"coord": "pos"}``.

    Raises:
        ConfigError: On a call, if a per-point entry has a wrong number of rows.
    """

    names: Sequence[str] = KEYS
    config: Any = None

    def __init__(self, *, keys: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self.keys = dict(keys or {})
        unknown = self.keys.keys() - set(self.names)
        if unknown:
            raise ConfigError(
                f"{type(self).__name__}: expected keys to rename {', '.join(self.names)}, got "
                f"{', '.join(sorted(unknown))}."
            )

    def extra_repr(self) -> str:
        """Return the configuration, and each argument that differs from its default.

        PyG compares the text to decide whether processed data are up to date.
        """
        shown = [] if self.config is None else [repr(self.config)]
        for name, parameter in inspect.signature(type(self)).parameters.items():
            value = getattr(self, name, parameter.default)
            if name not in ("config", "changes") and value not in (parameter.default, {}):
                shown.append(f"{name}={value!r}")
        return ", ".join(shown)

    @eager_only
    def forward(self, sample: Sample) -> Sample:
        """Return a new sample; the input is not changed."""
        check_sample(type(self).__name__, sample, "{'coord': points}")
        if can_split(sample):
            return map_clouds(sample, self.forward)
        num_points = len(self.read(sample, "coord"))
        check_lengths(type(self).__name__, get_entries(sample), num_points)
        return self.transform(sample)

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample from one whose per-point entries have been checked."""
        raise NotImplementedError

    def key(self, sample: Sample, name: str) -> str:
        """Return the key of an entry in a sample."""
        default = name if isinstance(sample, Mapping) else PYG_KEYS.get(name, name)
        return self.keys.get(name, default)

    def read(self, sample: Sample, name: str) -> Tensor:
        """Return an entry of a sample as a tensor, or raise ConfigError."""
        key, caller = self.key(sample, name), type(self).__name__
        entries = get_entries(sample)
        if key not in entries:
            raise ConfigError(
                f"{caller}: expected a sample with {key!r}, got {', '.join(map(str, entries))}; "
                f"rename it with keys={{{name!r}: ...}}."
            )
        tensor = as_tensor(caller, key, entries[key])
        if name == "coord":
            repair = f"pass {key}.flatten(0, 1), and the end row of each cloud as 'offset'"
            check_batch(caller, key, tensor, repair)
            check_shapes(caller, **{key: (tensor, "N 3")})
        if "index" in key and not isinstance(sample, Mapping):
            tensor = tensor.clamp(min=UNLABELED)
        # Pointcept stores scalars per point with two axes.
        return tensor.squeeze(-1) if name in TORCHRG_KEYS and tensor.ndim == 2 else tensor

    def replace(self, sample: Sample, values: Entries, *, per_point: Sequence[str] = ()) -> Sample:
        """Return a new sample of the same type with other values by key.

        The keys in ``per_point`` are added to the list of per-point entries.
        """
        if not isinstance(sample, Mapping):
            other = copy.copy(sample)
            for key, value in values.items():
                is_offset = "index" in key and isinstance(value, Tensor)
                other[key] = value.where(value >= 0, _MISSING_ROW) if is_offset else value
            return other
        is_numpy = isinstance(sample.get(self.key(sample, "coord")), np.ndarray)
        new = {
            key: value.numpy(force=True) if is_numpy and isinstance(value, Tensor) else value
            for key, value in values.items()
        }
        changed = {**sample, **new}
        coord = self.key(sample, "coord")
        if LIST_KEY in sample:
            num_points, skip = len(changed[coord]), self._skipped_keys(sample)
            further = per_point_keys(changed, num_points, skip=skip)
            changed |= extend_list(changed, [*TORCHRG_KEYS, *per_point, *further])
        return changed

    def select_rows(self, sample: Sample, rows: Tensor, num_points: int) -> SampleDict:
        """Return the entries that change when only ``rows`` (ascending) are kept."""
        skip = self._skipped_keys(sample)
        return select_points(type(self).__name__, sample, rows, num_points, skip=skip)

    def update_inverse(self, sample: Sample, new_rows: Tensor) -> dict[str, Tensor]:
        """Return ``inverse`` for rows that moved to ``new_rows``, negative for removed points."""
        key = self.key(sample, "inverse")
        if get_entries(sample).get(key) is None:
            return {}
        inverse = self.read(sample, "inverse").long().clone()
        if len(inverse) and int(inverse.max()) >= len(new_rows):
            raise ConfigError(
                f"{type(self).__name__}: expected inverse to contain rows of {len(new_rows)} "
                f"points, got row {int(inverse.max())}; points were removed after it was made, so "
                "remove it too."
            )
        exists = inverse >= 0
        inverse[exists] = new_rows.to(inverse.device)[inverse[exists]]
        return {key: inverse}

    def _skipped_keys(self, sample: Sample) -> list[str]:
        """Return the keys of entries that are never per point."""
        return [self.key(sample, name) for name in ("inverse", "origin")]


class NeighborSearch:
    """Neighbor search with a cache for subsequent transforms.

    A sample contains it after a transform with ``keep_neighbors``. The searched points are stored:
    if points were moved, removed or added since, neighbors are searched again. The next transform
    may use fewer neighbors, not more. It cannot be collated:
    :func:`torchrg.datasets.collate_offset` drops it, torch's collate function raises.

    Args:
        known: Distinct finite points of clouds in canonical order, and their neighbors.
    """

    def __init__(self, known: Sequence[tuple[Tensor, Neighbors]] = ()) -> None:
        self.known = known
        self.used: list[tuple[Tensor, Neighbors]] = []

    def __call__(self, points: Tensor, k: int) -> Neighbors:
        """Return the ``k`` nearest neighbors of distinct points in canonical order."""
        k = min(k, len(points))
        neighbors = self.recall(points, k)
        if neighbors is None:
            neighbors = search_distinct(points, k)
            self.remember(points, neighbors)
        return Neighbors(neighbors.indices[:, : max(k, 1)])

    def recall(self, points: Tensor, k: int = 1) -> Neighbors | None:
        """Return cached neighbors of distinct points in canonical order; None if fewer than k."""
        for cached, neighbors in self.known:
            is_same = cached.dtype == points.dtype and cached.device == points.device
            if is_same and neighbors.indices.shape[1] >= k and torch.equal(cached, points):
                self.remember(points, neighbors)
                return neighbors
        return None

    def remember(self, points: Tensor, neighbors: Neighbors) -> None:
        """Cache the neighbors of distinct points in canonical order."""
        self.used.append((points.detach(), neighbors))


class CloudTransform(SampleTransform):
    """Base class of transforms that add per-point entries, cloud by cloud.

    Args:
        keep_neighbors: Whether to store the neighbors in the sample as ``neighbors``, so that the
            next transform can reuse them; see :class:`NeighborSearch`. They take 4 bytes per point
            and neighbor.
    """

    reads: tuple[str, ...] = ("coord",)
    optional_reads: tuple[str, ...] = ()

    def __init__(
        self, *, keep_neighbors: bool = False, keys: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(keys=keys)
        self.keep_neighbors = keep_neighbors

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return the new entries of one cloud from the entries that are read."""
        raise NotImplementedError

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with the new entries."""
        entries = get_entries(sample)
        present = [name for name in self.optional_reads if self.key(sample, name) in entries]
        values = {name: self.read(sample, name) for name in (*self.reads, *present)}
        key = self.key(sample, "neighbors")
        carried = entries.get(key)
        search = NeighborSearch(carried.known if isinstance(carried, NeighborSearch) else ())
        parts = [
            self.add({name: value[rows] for name, value in values.items()}, search)
            for rows in cloud_rows(sample, len(values["coord"]))
        ]
        joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        added = {self.key(sample, name): value for name, value in joined.items()}
        changed = self.replace(sample, added, per_point=list(added))
        if self.keep_neighbors:
            changed[key] = NeighborSearch(search.used or search.known)
        elif isinstance(carried, NeighborSearch):
            del changed[key]
        return changed


class CenterCloud(SampleTransform):
    """Shift each cloud so that the center of its bounding box is the origin.

    Reads ``coord`` ``(N, 3)``; changes it, and adds ``origin`` ``(B, 3)``, float64, the new origin
    in the old coordinates, so that ``coord + origin`` restores them. An existing ``origin`` is
    added to it. Non-finite points are ignored.

    Example:
        >>> corner = torch.tensor([[5.0, 5.0, 5.0], [7.0, 5.0, 5.0]])
        >>> sample = CenterCloud()({"coord": corner})
        >>> sample["coord"].tolist(), sample["origin"].tolist()
        ([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[6.0, 5.0, 5.0]])
    """

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with shifted coordinates."""
        coord = self.read(sample, "coord")
        clouds = [coord[rows] for rows in cloud_rows(sample, len(coord))]
        centers = torch.stack([*map(_center, clouds)])
        pairs = zip(clouds, centers, strict=True)
        shifted = [(cloud.double() - center).to(cloud.dtype) for cloud, center in pairs]
        key = self.key(sample, "origin")
        if key in sample:
            centers = centers + self.read(sample, "origin").reshape(-1, 3)
        return self.replace(sample, {self.key(sample, "coord"): torch.cat(shifted), key: centers})


class KeepFinite(SampleTransform):
    """Remove points with non-finite coordinates from every per-point entry.

    An existing ``inverse`` is updated to index the same points; removed points become -1.

    Example:
        >>> sample = {"coord": torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0]]), "name": "a"}
        >>> KeepFinite()(sample)
        {'coord': tensor([[0., 0., 0.]]), 'name': 'a'}
    """

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with the finite points."""
        coord = self.read(sample, "coord")
        is_finite = coord.isfinite().all(dim=-1)
        rows = is_finite.nonzero().squeeze(-1)
        new_rows = torch.where(is_finite, is_finite.cumsum(dim=0) - 1, UNLABELED)
        selected = self.select_rows(sample, rows, len(coord))
        return self.replace(sample, selected | self.update_inverse(sample, new_rows))


def _center(cloud: Tensor) -> Tensor:
    """Return the center of the bounding box of finite points, float64; zero without points."""
    finite = cloud[cloud.isfinite().all(dim=-1)].double()
    if len(finite) == 0:
        return torch.zeros(3, dtype=torch.float64, device=cloud.device)
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    return low + (high - low) / 2


class SampleVoxels(SampleTransform):
    """Keep one point per voxel, and store the voxel of every point.

    Reads ``coord`` ``(N, 3)``; reduces every per-point entry to ``(V, ...)``, and adds ``inverse``
    ``(N,)``, int64, negative for none: ``expand_to_points`` copies voxel labels to all points. It
    contains rows of the complete sample, also in a batch; in a PyG ``Data`` it is
    ``inverse_index``, which PyG offsets when batching. An existing ``inverse`` is composed with
    it. Voxels never contain points of several clouds of a batch. See ``sample_voxels``.

    Args:
        size: Side length of a voxel, in coordinate units.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0.04, 0, 0], [0.11, 0, 0]])
        >>> sample = SampleVoxels(0.1)({"coord": points})
        >>> len(sample["coord"]), sample["inverse"].tolist()
        (2, [0, 0, 1])
    """

    def __init__(self, size: float, *, keys: Mapping[str, str] | None = None) -> None:
        super().__init__(keys=keys)
        if not 0 < size < float("inf"):
            raise ConfigError(f"SampleVoxels: expected size > 0, got {size!r}.")
        self.size = size

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample of voxels."""
        coord = self.read(sample, "coord")
        rows, inverse, num_voxels = [], [], 0
        for cloud in cloud_rows(sample, len(coord)):
            voxels = sample_voxels(coord[cloud], self.size)
            rows.append(voxels.rows + cloud.start)
            inverse.append(torch.where(voxels.inverse >= 0, voxels.inverse + num_voxels, UNLABELED))
            num_voxels += len(voxels.rows)
        voxel_index = torch.cat(inverse)
        added = {self.key(sample, "inverse"): voxel_index}
        added |= self.update_inverse(sample, voxel_index)
        selected = self.select_rows(sample, torch.cat(rows), len(coord))
        return self.replace(sample, selected | added)


def can_split(sample: Sample) -> bool:
    """Return whether a sample is a PyG ``Batch`` that can be split into its clouds.

    A batch from which points were removed cannot; it is treated as one sample with ``batch``.
    """
    slices = getattr(sample, "_slice_dict", None)
    if not slices or not callable(getattr(sample, "to_data_list", None)):
        return False
    return all(
        int(ends[-1]) == sample[key].shape[sample.__cat_dim__(key, sample[key]) or 0]
        for key, ends in slices.items()
        # Matrices stacked along a diagonal have two-axis slices, and are not per point.
        if key in sample and isinstance(sample[key], Tensor) and ends.ndim == 1
    )


def map_clouds(batch: Sample, change: Callable[[Sample], Sample]) -> Sample:
    """Apply ``change`` to each cloud of a batch, and return a new batch.

    Entries added after batching are kept: per-point rows with their clouds, other entries
    unchanged. ``follow_batch`` is kept.
    """
    clouds, unsplit = batch.to_data_list(), {}
    followed = [key for key in batch._slice_dict if f"{key}_ptr" in batch]  # noqa: SLF001
    created = {*_BATCH_KEYS, *(f"{key}_{end}" for key in followed for end in ("batch", "ptr"))}
    for key in set(batch.keys()) - set(batch._slice_dict) - created:  # noqa: SLF001
        value = batch[key]
        if isinstance(value, Tensor) and value.ndim and len(value) == batch.num_nodes:
            counts = torch.bincount(batch.batch, minlength=batch.num_graphs).tolist()
            for cloud, rows in zip(clouds, torch.split(value, counts), strict=True):
                cloud[key] = rows
        else:
            unsplit[key] = value
    join = importlib.import_module("torch_geometric.data").Batch.from_data_list
    changed = join([change(cloud) for cloud in clouds], follow_batch=followed)
    for key, value in unsplit.items():
        changed[key] = value
    return changed
