"""Samples: a dict of tensors or NumPy arrays, or a PyG ``Data``, which is never imported.

A sample holds one cloud, or a ragged batch: ``offset`` ``(B,)``, the row each cloud ends before
(Pointcept), or ``batch`` ``(N,)``, the cloud of each point in ascending order (PyG). Transforms
treat each cloud by itself.
"""

import copy
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrg._checks import as_tensor, check_shapes
from torchrg.errors import ConfigError

KEYS = (
    "coord", "normal", "curvature", "residual", "plane", "inverse", "origin", "color", "superpoint",
)  # fmt: skip
"""Names of the entries of a sample (Pointcept's, and ours)."""
PYG_KEYS = {"coord": "pos"}
"""Names that a PyG ``Data`` has instead of ours, unless others are given."""
NOT_PER_POINT = ("offset", "origin", "pose", "inverse")
"""Entries that have no row for each point that is there, however long they are."""


class SampleTransform(nn.Module):
    """Base of the transforms: reads and writes samples of every kind, never changes one.

    Results are NumPy arrays where the coordinates are. Names of new keys with a row for each point
    are added to ``index_valid_keys`` where a sample has it, so that Pointcept's transforms take
    points out of them too.

    Args:
        keys: Other names for some of :data:`KEYS`, as in ``{"coord": "pos"}``.
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

    def key(self, sample: Any, name: str) -> str:  # noqa: ANN401
        """Return what an entry is called in a sample."""
        usual = name if isinstance(sample, Mapping) else PYG_KEYS.get(name, name)
        return self.renamed.get(name, usual)

    def read(self, sample: Any, name: str) -> Tensor:  # noqa: ANN401
        """Return an entry of a sample as a tensor, or say what is wrong with it."""
        key, caller = self.key(sample, name), type(self).__name__
        entries = _entries_of(sample)
        if key not in entries:
            raise ConfigError(
                f"{caller}: expected a sample with {key!r}, got {', '.join(map(str, entries))}; "
                f"rename it with keys={{{name!r}: ...}}."
            )
        tensor = as_tensor(caller, key, entries[key])
        if name == "coord":
            check_shapes(caller, **{key: (tensor, "N 3")})
        return tensor

    def changed(
        self,
        sample: Any,  # noqa: ANN401
        values: Mapping[str, Tensor],
        *,
        per_point: Sequence[str] = (),
    ) -> Any:  # noqa: ANN401
        """Return a new sample of the same kind with other values by key.

        Those in ``per_point`` have a row for each point.
        """
        entries = _entries_of(sample)
        is_numpy = isinstance(entries.get(self.key(sample, "coord")), np.ndarray)
        new: dict[str, Any] = {
            key: value.numpy() if is_numpy else value for key, value in values.items()
        }
        if "index_valid_keys" in entries:
            known = list(entries["index_valid_keys"])
            new["index_valid_keys"] = known + [key for key in per_point if key not in known]
        if isinstance(sample, Mapping):
            return {**sample, **new}
        other = copy.copy(sample)
        for key, value in new.items():
            other[key] = value
        return other


class CloudTransform(SampleTransform):
    """Base of the transforms that add a row for each point, cloud by cloud."""

    reads: tuple[str, ...] = ("coord",)

    def add(self, cloud: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return new entries of one cloud, from those that are read."""
        raise NotImplementedError

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample with the new entries; the given one is not changed."""
        values = {name: self.read(sample, name) for name in self.reads}
        parts = [
            self.add({name: value[rows] for name, value in values.items()})
            for rows in rows_of_clouds(sample, len(values["coord"]))
        ]
        added = {
            self.key(sample, name): torch.cat([part[name] for part in parts]) for name in parts[0]
        }
        return self.changed(sample, added, per_point=list(added))


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

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
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

    Example:
        >>> sample = {"coord": torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0]]), "name": "a"}
        >>> KeepFinite()(sample)
        {'coord': tensor([[0., 0., 0.]]), 'name': 'a'}
    """

    def forward(self, sample: Any) -> Any:  # noqa: ANN401
        """Return a new sample with the finite points."""
        coord = self.read(sample, "coord")
        rows = coord.isfinite().all(dim=-1).nonzero().squeeze(-1)
        return self.changed(sample, select_points(sample, rows, num_points=len(coord)))


def rows_of_clouds(sample: Any, num_points: int) -> list[slice]:  # noqa: ANN401
    """Return the rows of each cloud of a sample, by its ``offset`` or ``batch`` if it has one."""
    return [slice(*ends) for ends in itertools.pairwise([0, *_cloud_ends(sample, num_points)])]


def select_points(sample: Any, rows: Tensor, *, num_points: int) -> dict[str, Tensor]:  # noqa: ANN401
    """Return the entries of a sample that change when only some rows are kept, given ascending.

    Which entries have a row for each point, ``index_valid_keys`` says as Pointcept does, or else
    their length. ``offset`` is among them where the sample has it. A sample that has edges, or is a
    batch that can be taken apart again, is refused.
    """
    entries = _entries_of(sample)
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
        ends = torch.tensor(_cloud_ends(sample, num_points), device=rows.device)
        chosen["offset"] = torch.searchsorted(rows, ends).to(offset)
    return chosen


def _entries_of(sample: Any) -> Mapping[str, Any]:  # noqa: ANN401
    """Return what a sample holds by key, or say that it is none."""
    if isinstance(sample, Mapping):
        return sample
    if callable(getattr(sample, "to_dict", None)) and hasattr(sample, "__setitem__"):
        entries: dict[str, Any] = sample.to_dict()
        return entries
    raise ConfigError(
        f"expected a sample that is a dict or a PyG Data, got {type(sample).__name__}."
    )


def _cloud_ends(sample: Any, num_points: int) -> list[int]:  # noqa: ANN401
    """Return the row that each cloud of a sample ends before; one cloud ends at the last."""
    entries = _entries_of(sample)
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
        counts: list[int] = torch.bincount(batch).cumsum(0).tolist()
        return counts or [0]
    return [num_points]


def _middle(cloud: Tensor) -> Tensor:
    """Return the middle of the box around the finite points, float64; zero if there is none."""
    finite = cloud[cloud.isfinite().all(dim=-1)].double()
    if len(finite) == 0:
        return torch.zeros(3, dtype=torch.float64, device=cloud.device)
    low, high = finite.amin(dim=0), finite.amax(dim=0)
    return low + (high - low) / 2
