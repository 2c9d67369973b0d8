"""Sparse contingency table of predicted regions and ground-truth planes."""

from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.structures.points import UNLABELED, short_repr

INTEGERS = (
    *(torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.uint8, torch.uint16, torch.uint32, torch.uint64),
)


@short_repr
class ContingencyTable(NamedTuple):
    """Sparse table of overlaps between regions and ground-truth planes (faces).

    Attributes:
        region_labels: Labels of the regions, ascending, shape ``(R,)``, int64.
        face_labels: Labels of the faces, ascending, shape ``(F,)``, int64.
        region_sizes: Points of each region, with or without a face, shape ``(R,)``, int64.
        face_sizes: Points of each face, with or without a region, shape ``(F,)``, int64.
        regions: Region of each overlap as a row of ``region_labels``, shape ``(E,)``, int64.
        faces: Face of each overlap as a row of ``face_labels``, shape ``(E,)``, int64.
        overlaps: Number of common points, at least 1, shape ``(E,)``, int64.
        num_points: Number of evaluated points, including unlabeled ones.
    """

    region_labels: Tensor
    face_labels: Tensor
    region_sizes: Tensor
    face_sizes: Tensor
    regions: Tensor
    faces: Tensor
    overlaps: Tensor
    num_points: int

    @property
    def iou(self) -> Tensor:
        """Intersection over union of each overlap, in (0, 1], shape ``(E,)``, float64."""
        sizes = self.region_sizes[self.regions] + self.face_sizes[self.faces]
        return self.overlaps.double() / (sizes - self.overlaps)


def contingency_table(
    labels: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    *,
    min_size: int = 1,
    ignore: int | None = None,
) -> ContingencyTable:
    """Count the common points of predicted regions and ground-truth planes.

    Convention:
        Labels are arbitrary integers; ``UNLABELED`` (-1) means no region in ``labels`` and no face
        in ``ground_truth``. Points without a face still count in the size of their region, points
        without a region in that of their face.

    Args:
        labels: Predicted label of each point, shape ``(N,)``, integers.
        ground_truth: Ground-truth label of each point, shape ``(N,)``, integers.
        min_size: Minimum number of points per region, before ``ignore`` is applied; smaller regions
            count as unlabeled. Faces of any size count.
        ignore: Ground-truth label of points to ignore. Default: none.

    Returns:
        The table, in the order of the labels.

    Raises:
        ShapeError: If the labels are not integers, or differ in length or device.
        ConfigError: If ``min_size`` is below 1.

    Example:
        >>> table = contingency_table(torch.tensor([7, 7, 9, -1]), torch.tensor([0, 1, 1, 1]))
        >>> list(zip(table.regions.tolist(), table.faces.tolist(), table.overlaps.tolist()))
        [(0, 0, 1), (0, 1, 1), (1, 1, 1)]
        >>> table.region_sizes.tolist(), table.face_sizes.tolist()
        ([2, 1], [1, 3])
    """
    return count_overlaps("contingency_table", labels, ground_truth, min_size, ignore)


def count_overlaps(
    caller: str,
    labels: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    min_size: int,
    ignore: int | None,
) -> ContingencyTable:
    """Compute the table of :func:`contingency_table`; errors start with the caller."""
    labels, ground_truth = check_labels(caller, labels=labels, ground_truth=ground_truth)
    if min_size < 1:
        raise ConfigError(f"{caller}: expected min_size >= 1, got {min_size!r}.")
    if min_size > 1:
        _, rows, sizes = torch.unique(labels, return_inverse=True, return_counts=True)
        labels = labels.masked_fill((sizes < min_size)[rows], UNLABELED)
    if ignore is not None:
        scored = is_not_ignored(ground_truth, ignore)
        labels, ground_truth = labels[scored], ground_truth[scored]
    region_labels, regions = number_labels(labels)
    face_labels, faces = number_labels(ground_truth)
    both = (regions >= 0) & (faces >= 0)
    width = max(len(face_labels), 1)
    keys, overlaps = torch.unique(regions[both] * width + faces[both], return_counts=True)
    return ContingencyTable(
        region_labels=region_labels,
        face_labels=face_labels,
        region_sizes=torch.bincount(regions[regions >= 0], minlength=len(region_labels)),
        face_sizes=torch.bincount(faces[faces >= 0], minlength=len(face_labels)),
        regions=keys // width,
        faces=keys % width,
        overlaps=overlaps,
        num_points=len(labels),
    )


def number_labels(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the existing labels, ascending, and each point's row there, -1 if unlabeled."""
    distinct, rows = torch.unique(labels, return_inverse=True)
    labeled = distinct != UNLABELED
    return distinct[labeled], (labeled.cumsum(0) - 1).where(labeled, -1)[rows]


def check_labels(caller: str, **arguments: Tensor | NDArray[Any]) -> list[Tensor]:
    """Convert label arrays to int64 tensors; raise ShapeError if lengths or devices differ."""
    tensors = {name: as_tensor(caller, name, values) for name, values in arguments.items()}
    for name, tensor in tensors.items():
        if tensor.dtype not in INTEGERS:
            dtype = str(tensor.dtype).removeprefix("torch.")
            raise ShapeError(f"{caller}: expected integer {name}, got {dtype}; use .long().")
    check_shapes(caller, **{name: (tensor, "N") for name, tensor in tensors.items()})
    return [tensor.long() for tensor in tensors.values()]


def is_not_ignored(ground_truth: Tensor, ignore: int | None) -> Tensor:
    """Return the mask of points without the ignored label; labels beyond int64 never match."""
    if ignore is None or not -(2**63) <= ignore < 2**63:
        return torch.ones_like(ground_truth, dtype=torch.bool)
    return ground_truth != ignore


def is_first(groups: Tensor, *keys: Tensor) -> Tensor:
    """Mark the first row of each group, ordered by the keys, shape ``(E,)``."""
    order = torch.arange(len(groups), device=groups.device)
    for key in (*reversed(keys), groups):
        order = order[key[order].argsort(stable=True)]
    ordered = groups[order]
    begins = torch.ones_like(ordered, dtype=torch.bool)
    begins[1:] = ordered[1:] != ordered[:-1]
    return torch.empty_like(begins).index_put((order,), begins)


def fraction(count: float, whole: float) -> float:
    """Return ``count / whole``, or 0 if ``whole`` is 0."""
    return count / whole if whole else 0.0
