"""The sparse table of overlaps between predicted regions and true faces."""

from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.structures import UNLABELED

INTEGERS = (
    *(torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.uint8, torch.uint16, torch.uint32, torch.uint64),
)


class ContingencyTable(NamedTuple):
    """How many points each region and each face share; pairs that share none are left out.

    Attributes:
        region_labels: Labels of the regions in ascending order, shape ``(R,)``, int64.
        face_labels: Labels of the faces in ascending order, shape ``(F,)``, int64.
        region_sizes: Points of each region, those of no face included, shape ``(R,)``, int64.
        face_sizes: Points of each face, those of no region included, shape ``(F,)``, int64.
        regions: Region of each overlap, a row of ``region_labels``, shape ``(E,)``, int64.
        faces: Face of each overlap, a row of ``face_labels``, shape ``(E,)``, int64.
        overlaps: Points that the two share, at least 1, shape ``(E,)``, int64.
        num_points: Points that were counted, the unlabelled ones included.
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
    truth: Tensor | NDArray[Any],
    *,
    min_size: int = 1,
    ignore: int | None = None,
) -> ContingencyTable:
    """Count the points that each predicted region shares with each true face.

    Convention:
        Labels are integers of any value and order; ``UNLABELED`` (-1) means "of no region" in
        ``labels`` and "of no face" in ``truth``. A point of no face still belongs to its region and
        makes it larger, a point of no region still belongs to its face.

    Args:
        labels: Predicted label of each point, shape ``(N,)``, integers.
        truth: True label of each point, shape ``(N,)``, integers.
        min_size: Regions of fewer points count as unlabelled; their size is taken before
            ``ignore`` is applied. Faces of any size count.
        ignore: Points with this true label are left out of everything. Default: none is.

    Returns:
        The table. Its rows follow the labels, not the order of the points.

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
    return count_overlaps("contingency_table", labels, truth, min_size, ignore)


def count_overlaps(
    caller: str,
    labels: Tensor | NDArray[Any],
    truth: Tensor | NDArray[Any],
    min_size: int,
    ignore: int | None,
) -> ContingencyTable:
    """Return the table of :func:`contingency_table`; errors name the caller."""
    labels, truth = check_labels(caller, labels=labels, truth=truth)
    if min_size < 1:
        raise ConfigError(f"{caller}: expected min_size >= 1, got {min_size!r}.")
    if min_size > 1:
        _, rows, sizes = torch.unique(labels, return_inverse=True, return_counts=True)
        labels = labels.masked_fill((sizes < min_size)[rows], UNLABELED)
    if ignore is not None:
        scored = have_other_label(truth, ignore)
        labels, truth = labels[scored], truth[scored]
    region_labels, regions = number_labels(labels)
    face_labels, faces = number_labels(truth)
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
    """Return the labels that occur, ascending, and each point's row there or -1 if unlabelled."""
    distinct, rows = torch.unique(labels, return_inverse=True)
    labeled = distinct != UNLABELED
    return distinct[labeled], (labeled.cumsum(0) - 1).where(labeled, -1)[rows]


def check_labels(caller: str, **arguments: Tensor | NDArray[Any]) -> list[Tensor]:
    """Return label arrays as int64 tensors; a ShapeError if lengths or devices differ."""
    tensors = {name: as_tensor(caller, name, values) for name, values in arguments.items()}
    for name, tensor in tensors.items():
        if tensor.dtype not in INTEGERS:
            dtype = str(tensor.dtype).removeprefix("torch.")
            raise ShapeError(
                f"{caller}: expected {name} of integers, got {dtype}; convert with .long()."
            )
    check_shapes(caller, **{name: (tensor, "N") for name, tensor in tensors.items()})
    check_one_device(caller, **tensors)
    return [tensor.long() for tensor in tensors.values()]


def have_other_label(truth: Tensor, ignore: int | None) -> Tensor:
    """Return which points do not have the ignored label; no point has one beyond int64.

    Example:
        >>> have_other_label(torch.tensor([0, 1]), 1), have_other_label(torch.tensor([0]), 10**23)
        (tensor([ True, False]), tensor([True]))
    """
    if ignore is None or not -(2**63) <= ignore < 2**63:
        return torch.ones_like(truth, dtype=torch.bool)
    return truth != ignore


def check_one_device(caller: str, **arguments: Tensor) -> None:
    """Raise a ShapeError for tensors on several devices."""
    devices = [str(tensor.device) for tensor in arguments.values()]
    if len(set(devices)) > 1:
        names = " and ".join(arguments)
        raise ShapeError(f"{caller}: expected {names} on one device, got {' and '.join(devices)}.")


def fraction(count: float, whole: float) -> float:
    """Return ``part / whole``, and 0 where the whole is 0."""
    return count / whole if whole else 0.0
