"""Samples: a dict of tensors or NumPy arrays, or a PyG ``Data`` or ``Batch``, never imported here.

A sample holds one cloud, or a ragged batch: ``offset`` ``(B,)``, the row each cloud ends before
(Pointcept), or ``batch`` ``(N,)``, the cloud of each point in ascending order (PyG). Transforms
treat each cloud by itself.
"""

import copy
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrg._checks import as_tensor, check_shapes, of_clouds
from torchrg.errors import ConfigError
from torchrg.neighbors import sample_voxels, search_knn
from torchrg.structures import UNLABELED, Neighbors
from torchrg.transforms.rows import (
    LISTED,
    OUR_KEYS,
    Entries,
    Sample,
    SampleDict,
    check_in_step,
    check_sample,
    entries_of,
    follow_points,
    recognized_keys,
    rows_of_clouds,
    select_points,
    with_listed,
)

KEYS = (
    "coord", "normal", "curvature", "residual", "plane", "inverse", "origin", "color", "superpoint",
    "viewpoint", "front", "neighbors",
)  # fmt: skip
"""Names of the entries of a sample (Pointcept's, and ours)."""
PYG_KEYS = {"coord": "pos", "inverse": "inverse_index"}
"""Names that a PyG ``Data`` has instead of ours, unless others are given. Of entries with ``index``
in their name PyG counts on when it batches, as it does ``edge_index``: ``inverse_index`` names rows
of the batch, and planes and superpoints of several clouds stay apart with ``keys={"plane":
"plane_index", "superpoint": "superpoint_index"}``."""
_MADE_BY_BATCHING = ("batch", "ptr", "num_nodes")
"""Entries that PyG makes when it joins clouds."""
_NEVER_A_ROW = torch.iinfo(torch.int64).min
"""Stands for none in entries that PyG counts on, where -1 would not: it is still negative when PyG
has added the rows of the clouds before."""


class SampleTransform(nn.Module):
    """Base of the transforms: reads and writes samples of every kind, never changes one.

    Results are NumPy arrays where the coordinates are. New entries join the list of those that have
    a row for each point, Pointcept's ``index_valid_keys``, where there is one. A PyG ``Batch``
    leaves as one that can be taken apart again.

    Args:
        keys: Other names for some of :data:`KEYS`, as in ``{"coord": "pos"}``.

    Raises:
        ConfigError: On a call, if an entry that must have a row for each point has not.
    """

    names: Sequence[str] = KEYS
    config: Any = None

    def __init__(self, *, keys: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self.renamed = dict(keys or {})
        unknown = self.renamed.keys() - set(self.names)
        if unknown:
            raise ConfigError(
                f"{type(self).__name__}: expected keys to rename {', '.join(self.names)}, got "
                f"{', '.join(sorted(unknown))}."
            )

    def extra_repr(self) -> str:
        """Return the settings."""
        return "" if self.config is None else repr(self.config)

    @of_clouds
    def forward(self, sample: Sample) -> Sample:
        """Return a new sample; the given one is not changed."""
        check_sample(type(self).__name__, sample, "{'coord': points}")
        if is_separable(sample):
            return with_each(sample, self.forward)
        num_points = len(self.read(sample, "coord"))
        check_in_step(type(self).__name__, entries_of(sample), num_points)
        return self.transform(sample)

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample, of one whose entries are in step."""
        raise NotImplementedError

    def key(self, sample: Sample, name: str) -> str:
        """Return what an entry is called in a sample."""
        usual = name if isinstance(sample, Mapping) else PYG_KEYS.get(name, name)
        return self.renamed.get(name, usual)

    def read(self, sample: Sample, name: str) -> Tensor:
        """Return an entry of a sample as a tensor, or say what is wrong with it."""
        key, caller = self.key(sample, name), type(self).__name__
        entries = entries_of(sample)
        if key not in entries:
            raise ConfigError(
                f"{caller}: expected a sample with {key!r}, got {', '.join(map(str, entries))}; "
                f"rename it with keys={{{name!r}: ...}}."
            )
        tensor = as_tensor(caller, key, entries[key])
        if name == "coord":
            check_shapes(caller, **{key: (tensor, "N 3")})
        if "index" in key and not isinstance(sample, Mapping):
            tensor = tensor.clamp(min=UNLABELED)
        # Pointcept keeps one number a point with two axes.
        return tensor.squeeze(-1) if name in OUR_KEYS and tensor.ndim == 2 else tensor

    def changed(
        self,
        sample: Sample,
        values: Entries,
        *,
        per_point: Sequence[str] = (),
    ) -> Sample:
        """Return a new sample of the same kind with other values by key.

        Those in ``per_point`` have a row for each point.
        """
        if not isinstance(sample, Mapping):
            other = copy.copy(sample)
            for key, value in values.items():
                is_counted_on = "index" in key and isinstance(value, Tensor)
                other[key] = value.where(value >= 0, _NEVER_A_ROW) if is_counted_on else value
            return other
        is_numpy = isinstance(sample.get(self.key(sample, "coord")), np.ndarray)
        new = {
            key: value.numpy(force=True) if is_numpy and isinstance(value, Tensor) else value
            for key, value in values.items()
        }
        changed = {**sample, **new}
        coord = self.key(sample, "coord")
        if LISTED in sample:
            num_points, whole = len(changed[coord]), self._whole_keys(sample)
            others = recognized_keys(changed, num_points, whole=whole)
            changed |= with_listed(changed, [*OUR_KEYS, *per_point, *others])
        return changed

    def selected(self, sample: Sample, rows: Tensor, num_points: int) -> SampleDict:
        """Return the entries that change when only some rows are kept, given ascending."""
        whole = self._whole_keys(sample)
        return select_points(type(self).__name__, sample, rows, num_points, whole=whole)

    def moved_inverse(self, sample: Sample, place: Tensor) -> dict[str, Tensor]:
        """Return the ``inverse`` of a sample after rows moved to ``place``, if it has one."""
        key = self.key(sample, "inverse")
        if entries_of(sample).get(key) is None:
            return {}
        inverse = self.read(sample, "inverse")
        return {key: follow_points(type(self).__name__, inverse, place)}

    def _whole_keys(self, sample: Sample) -> list[str]:
        """Return what the entries are called that have no row for each point."""
        return [self.key(sample, name) for name in ("inverse", "origin")]


class NeighborSearch:
    """Searches the neighbours of clouds, and remembers them for the transforms that follow.

    A sample carries it where a transform was asked to by ``keep_neighbors``. It holds the points
    that were searched: where some were moved, taken out or put in since, neighbours are searched
    again. The next transform may use fewer neighbours, not more. No collate function joins it:
    :func:`torchrg.datasets.collate_offset` leaves it out, torch's refuses it.

    Args:
        known: Distinct finite points of clouds in canonical order, and their neighbours.
    """

    def __init__(self, known: Sequence[tuple[Tensor, Neighbors]] = ()) -> None:
        self.known = known
        self.used: list[tuple[Tensor, Neighbors]] = []

    def __call__(self, points: Tensor, k: int) -> Neighbors:
        """Return the ``k`` nearest neighbours of distinct points in canonical order."""
        k = min(k, len(points))
        neighbors = self.recall(points, k)
        if neighbors is None:
            none = Neighbors(torch.empty(0, 1, dtype=torch.int32, device=points.device))
            neighbors = search_knn(points, k, canonical=True) if k else none
            self.remember(points, neighbors)
        return Neighbors(neighbors.indices[:, : max(k, 1)])

    def recall(self, points: Tensor, k: int = 1) -> Neighbors | None:
        """Return what is known of distinct points in canonical order; None of fewer than ``k``."""
        for others, neighbors in self.known:
            is_same = others.dtype == points.dtype and others.device == points.device
            if is_same and neighbors.indices.shape[1] >= k and torch.equal(others, points):
                self.remember(points, neighbors)
                return neighbors
        return None

    def remember(self, points: Tensor, neighbors: Neighbors) -> None:
        """Keep the neighbours of distinct points in canonical order."""
        self.used.append((points.detach(), neighbors))


class CloudTransform(SampleTransform):
    """Base of the transforms that add a row for each point, cloud by cloud.

    Args:
        keep_neighbors: Whether the sample carries the neighbours on, as ``neighbors``, so that the
            next transform need not search them; see :class:`NeighborSearch`. They take 4 bytes for
            each neighbour of a point.
    """

    reads: tuple[str, ...] = ("coord",)
    reads_if_there: tuple[str, ...] = ()

    def __init__(
        self, *, keep_neighbors: bool = False, keys: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(keys=keys)
        self.keep_neighbors = keep_neighbors

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return new entries of one cloud, from those that are read."""
        raise NotImplementedError

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with the new entries."""
        entries = entries_of(sample)
        there = [name for name in self.reads_if_there if self.key(sample, name) in entries]
        values = {name: self.read(sample, name) for name in (*self.reads, *there)}
        key = self.key(sample, "neighbors")
        carried = entries.get(key)
        search = NeighborSearch(carried.known if isinstance(carried, NeighborSearch) else ())
        parts = [
            self.add({name: value[rows] for name, value in values.items()}, search)
            for rows in rows_of_clouds(sample, len(values["coord"]))
        ]
        added = {
            self.key(sample, name): torch.cat([part[name] for part in parts]) for name in parts[0]
        }
        changed = self.changed(sample, added, per_point=list(added))
        if self.keep_neighbors:
            changed[key] = NeighborSearch(search.used or search.known)
        elif isinstance(carried, NeighborSearch):
            del changed[key]
        return changed


class CenterCloud(SampleTransform):
    """Move each cloud so that the middle of its bounding box is the origin.

    Reads ``coord`` ``(N, 3)``; changes it, and adds ``origin`` ``(B, 3)``, float64, where the
    origin of the new coordinates is in the old ones (an ``origin`` that is there is added up), so
    that ``coord + origin`` is what it was. Points that are not finite do not count.

    Example:
        >>> corner = torch.tensor([[5.0, 5.0, 5.0], [7.0, 5.0, 5.0]])
        >>> sample = CenterCloud()({"coord": corner})
        >>> sample["coord"].tolist(), sample["origin"].tolist()
        ([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[6.0, 5.0, 5.0]])
    """

    def transform(self, sample: Sample) -> Sample:
        """Return a new sample with moved coordinates."""
        coord = self.read(sample, "coord")
        clouds = [coord[rows] for rows in rows_of_clouds(sample, len(coord))]
        middles = torch.stack([_middle(cloud) for cloud in clouds])
        moved = [
            (cloud.double() - middle).to(cloud.dtype)
            for cloud, middle in zip(clouds, middles, strict=True)
        ]
        key = self.key(sample, "origin")
        if key in sample:
            middles = middles + self.read(sample, "origin").reshape(-1, 3)
        return self.changed(sample, {self.key(sample, "coord"): torch.cat(moved), key: middles})


class KeepFinite(SampleTransform):
    """Leave out points whose coordinates are not finite, from every entry with a row a point.

    Changes ``inverse``, if it is there, so that it still names the same points, -1 for those left
    out.

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
        place = torch.where(is_finite, is_finite.cumsum(dim=0) - 1, UNLABELED)
        selected = self.selected(sample, rows, len(coord))
        return self.changed(sample, selected | self.moved_inverse(sample, place))


def _middle(cloud: Tensor) -> Tensor:
    """Return the middle of the box around the finite points, float64; zero if there is none."""
    finite = cloud[cloud.isfinite().all(dim=-1)].double()
    if len(finite) == 0:
        return torch.zeros(3, dtype=torch.float64, device=cloud.device)
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    return low + (high - low) / 2


class SampleVoxels(SampleTransform):
    """Keep one point of each voxel, and remember the voxel of every point.

    Reads ``coord`` ``(N, 3)``; reduces every entry with a row for each point to ``(V, ...)``, and
    adds ``inverse`` ``(N,)``, int64, negative for none: ``restore_points`` takes labels of the
    voxels back to all points. It names rows of the whole sample, in a batch too; in a PyG ``Data``
    it is ``inverse_index``, which PyG keeps so when it batches. Where ``inverse`` is there already,
    it goes on from its points. No voxel crosses the clouds of a batch. See ``sample_voxels``.

    Args:
        size: Side of a voxel, in the unit of the cloud.

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
        for cloud in rows_of_clouds(sample, len(coord)):
            voxels = sample_voxels(coord[cloud], self.size)
            rows.append(voxels.rows + cloud.start)
            inverse.append(torch.where(voxels.inverse >= 0, voxels.inverse + num_voxels, UNLABELED))
            num_voxels += len(voxels.rows)
        voxel_of = torch.cat(inverse)
        selected = self.selected(sample, torch.cat(rows), len(coord))
        found = {self.key(sample, "inverse"): voxel_of} | self.moved_inverse(sample, voxel_of)
        return self.changed(sample, selected | found)

    def extra_repr(self) -> str:
        """Return the settings."""
        return f"size={self.size}"


def is_separable(sample: Sample) -> bool:
    """Return whether a sample is a PyG ``Batch`` that can be taken apart into its clouds.

    One whose points were taken out by hand cannot; it counts as one sample with ``batch``.
    """
    row_slices = getattr(sample, "_slice_dict", None)
    if not row_slices or not callable(getattr(sample, "to_data_list", None)):
        return False
    return all(
        int(ends[-1]) == sample[key].shape[sample.__cat_dim__(key, sample[key]) or 0]
        for key, ends in row_slices.items()
        # Matrices stacked along a diagonal have two axes of ends, and no row for a point.
        if key in sample and isinstance(sample[key], Tensor) and ends.ndim == 1
    )


def with_each(batch: Sample, change: Callable[[Sample], Sample]) -> Sample:
    """Return a batch of the changed clouds of a batch; the given one is not changed.

    What was added to the batch after it was made stays: rows of points with their clouds, the rest
    as it is. ``follow_batch`` is kept.
    """
    clouds, whole = batch.to_data_list(), {}
    followed = [key for key in batch._slice_dict if f"{key}_ptr" in batch]  # noqa: SLF001
    made = {*_MADE_BY_BATCHING, *(f"{key}_{end}" for key in followed for end in ("batch", "ptr"))}
    for key in set(batch.keys()) - set(batch._slice_dict) - made:  # noqa: SLF001
        value = batch[key]
        if isinstance(value, Tensor) and value.ndim and len(value) == batch.num_nodes:
            counts = torch.bincount(batch.batch, minlength=batch.num_graphs).tolist()
            for cloud, rows in zip(clouds, torch.split(value, counts), strict=True):
                cloud[key] = rows
        else:
            whole[key] = value
    join = importlib.import_module("torch_geometric.data").Batch.from_data_list
    changed = join([change(cloud) for cloud in clouds], follow_batch=followed)
    for key, value in whole.items():
        changed[key] = value
    return changed
