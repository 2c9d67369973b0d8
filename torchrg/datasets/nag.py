"""Superpoint levels in Superpoint Transformer's nested format (NAG)."""

import importlib
import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg._optional import require
from torchrg.errors import MissingDependencyError, ShapeError
from torchrg.structures import AnyCloud, Superpoints
from torchrg.structures.points import Array


class Cluster(NamedTuple):
    """Child nodes of each node in compressed rows: ``points[pointers[i]:pointers[i + 1]]``.

    Attributes:
        pointers: Shape ``(M + 1,)``, int64, from 0 to the number of child nodes.
        points: Child nodes, shape ``(N,)``, int64, each once.
    """

    pointers: Tensor
    points: Tensor


def make_nag(
    points: AnyCloud,
    superpoints: Superpoints,
    *,
    data: Callable[..., Any] | None = None,
    cluster: Callable[[Tensor, Tensor], object] = Cluster,
    **values: Tensor | Array,
) -> list[Any]:
    """Convert superpoints to a list of levels for Superpoint Transformer [1], points first.

    In each level, ``super_index`` is the parent node, and ``sub`` holds the child nodes.
    ``NAG(make_nag(points, parts, data=Data, cluster=Cluster))``, with ``Data`` and ``Cluster`` of
    its ``src.data``, is a hierarchy that replaces cut pursuit's.

    Args:
        points: Points, shape ``(N, 3)``.
        superpoints: Result of :func:`torchrg.make_superpoints` for the points.
        data: Creates a level from entries by name. Default: PyG's ``Data``.
        cluster: Creates ``sub`` from pointers and points.
        values: Further per-point entries of N rows: ``rgb``, ``normal``, ``y``.

    Returns:
        Level 0 has ``pos``, the values, and ``super_index``, ``(N,)``, int64. Each higher level has
        ``pos`` (mean of its points), ``node_size`` (their number), ``sub``, and, except for the
        last level, ``super_index``. Class counts ``y``, ``(N, C)``, are summed in higher levels.

    Raises:
        ShapeError: If some points have no superpoint (because they are not finite), superpoint IDs
            have gaps, or a superpoint is in two of the next level.
        MissingDependencyError: If PyG is not installed and ``data`` is not passed.

    References:
        [1] D. Robert, H. Raguet, L. Landrieu. Efficient 3D semantic segmentation with superpoint
        transformer. ICCV, 2023.

    Example:
        >>> fine, coarse = torch.tensor([0, 1, 1, 2]), torch.tensor([0, 0, 0, 1])
        >>> parts = Superpoints(fine, torch.zeros(3), (coarse,))
        >>> below, middle, above = make_nag(torch.eye(4, 3), parts, data=dict)
        >>> middle["super_index"].tolist(), above["sub"].points.tolist()
        ([0, 0, 1], [0, 1, 2])
        >>> above["node_size"].tolist()
        [3, 1]
    """
    pos = as_tensor("make_nag", "points", points)
    superpoints = superpoints.to(pos.device)
    check_shapes("make_nag", points=(pos, "N 3"), labels=(superpoints.labels, "N"))
    without = int((superpoints.labels < 0).sum())
    if without:
        raise ShapeError(
            f"make_nag: expected a superpoint for every point, got {without:,} points without one; "
            "remove non-finite points first."
        )
    if data is None:
        try:
            data = importlib.import_module("torch_geometric.data").Data
        except ImportError as error:
            raise MissingDependencyError(
                "make_nag: torch_geometric is missing; pip install it, or pass data."
            ) from error
    entries: dict[str, Any] = {"pos": pos, **values}
    below = torch.arange(len(pos), device=pos.device)
    levels = []
    for level, labels in enumerate((superpoints.labels, *superpoints.levels)):
        check_shapes("make_nag", points=(pos, "N 3"), labels=(labels, "N"))
        count = int(labels.max()) + 1 if len(labels) else 0
        # All points of a child node belong to the same node here.
        super_index = labels.new_empty(len(entries["pos"])).index_copy(0, below, labels)
        _check_level(level, labels, count, below, super_index)
        levels.append(data(**entries, super_index=super_index))
        order = super_index.argsort(stable=True)
        pointers = torch.bincount(super_index, minlength=count).cumsum(0)
        sizes = torch.bincount(labels, minlength=count)
        sums = torch.zeros(count, 3, dtype=torch.float64, device=pos.device)
        mean = sums.index_add(0, labels, pos.double()) / sizes[:, None]
        sub = cluster(torch.nn.functional.pad(pointers, (1, 0)), order)
        entries, below = {"pos": mean.to(pos.dtype), "node_size": sizes, "sub": sub}, labels
        counts = values.get("y")
        if counts is not None and counts.ndim == 2:
            counts = as_tensor("make_nag", "y", counts)
            entries["y"] = counts.new_zeros(count, counts.shape[1]).index_add(0, labels, counts)
    return [*levels, data(**entries)]


def _check_level(
    level: int, labels: Tensor, count: int, below: Tensor, super_index: Tensor
) -> None:
    """Raise ShapeError if node IDs have gaps, or a child node is split.

    ``labels`` and ``below`` are the nodes of the points here and in the level below,
    ``super_index`` the parent of each node below.
    """
    sizes = torch.bincount(labels.clamp(min=0), minlength=count)
    if len(empty := (sizes == 0).nonzero()) or int((labels < 0).sum()):
        number = int(empty[0]) if len(empty) else int(labels.min())
        raise ShapeError(
            f"make_nag: expected consecutive superpoint IDs from 0 in level {level}, got "
            f"{number} {'for no point' if len(empty) else 'for a point'}; renumber them with "
            "torch.unique(labels, return_inverse=True)[1]."
        )
    if len(cut := (super_index[below] != labels).nonzero()):
        raise ShapeError(
            f"make_nag: expected each superpoint in one of level {level}, got {int(below[cut[0]])} "
            "in two; merge finer levels to make coarser ones."
        )


def encode_nag(levels: Iterable[Mapping[str, Any]]) -> bytes:
    """Encode levels of :func:`make_nag`, as dicts, as an HDF5 file for ``NAG.load``.

    Raises:
        MissingDependencyError: If h5py is not installed.
    """
    h5py = require("h5py", extra="nag", purpose="write files of Superpoint Transformer")
    with io.BytesIO() as stream:
        with h5py.File(stream, "w") as file:
            file.attrs["start_i_level"] = 0
            for number, level in enumerate(levels):
                for path, values in _entries(level):
                    file[f"level_{number}/{path}"] = np.asarray(values)
        return stream.getvalue()


def _entries(level: Mapping[str, Any]) -> Iterator[tuple[str, Tensor | Array]]:
    """Yield the arrays of a level by path; clusters and counts are in compressed rows."""
    for name, values in level.items():
        if isinstance(values, Cluster):
            yield f"_cluster_/{name}/pointers", values.pointers
            yield f"_cluster_/{name}/value_0", values.points
            yield f"_cluster_/{name}/is_index_value", np.ones(1, np.uint8)
        elif name == "y":
            rows, columns = np.nonzero(np.asarray(values))
            yield "_csr_/y/pointers", np.searchsorted(rows, np.arange(len(values) + 1))
            yield "_csr_/y/columns", columns
            yield "_csr_/y/values", values[rows, columns]
            yield "_csr_/y/shape", np.array(values.shape)
        else:
            yield name, values
