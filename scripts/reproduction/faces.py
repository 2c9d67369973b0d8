"""What the means over all pairs hide: large and small faces, edges, curved surfaces, objects."""

from typing import NamedTuple

import torch
from torch import Tensor

from reproduction.cells import Record
from reproduction.clouds import EvalCloud
from torchrg.metrics import contingency_table, match_regions
from torchrg.render.channels import OUTCOMES, point_outcomes
from torchrg.structures import UNLABELED, Neighbors

LARGE = 1000
"""Points from which on a face is called large here."""

FOUND = 0.5
"""A face is found if a region has more than this intersection over union with it."""

_RIGHT, _NONE = (list(OUTCOMES).index(name) for name in ("right", "none"))

_CHUNK = 100_000
"""Points whose neighbours are looked up at a time."""


class Faces(NamedTuple):
    """The true faces of a cloud, and what a method made of them.

    Attributes:
        labels: Of the faces, shape ``(F,)``.
        sizes: Points of each, shape ``(F,)``.
        best_iou: Largest intersection over union with a region, shape ``(F,)``.
        precision: Of the paired region, in percent, shape ``(F,)``; NaN where there is none.
        recall: The same for the recall.
    """

    labels: Tensor
    sizes: Tensor
    best_iou: Tensor
    precision: Tensor
    recall: Tensor

    def f1(self, chosen: Tensor) -> float | None:
        """Return the paper's F1 in percent, of some of the faces; None if none has a region."""
        paired = chosen & ~self.precision.isnan()
        if not paired.any():
            return None
        precision, recall = (float(x[paired].mean()) for x in (self.precision, self.recall))
        return 2 * precision * recall / (precision + recall)

    def f1_of_every(self) -> float | None:
        """Return the paper's F1 if faces without a region had precision and recall 0, as well."""
        paired = [values.nan_to_num(0.0) for values in (self.precision, self.recall)]
        every = torch.ones_like(self.sizes, dtype=torch.bool)
        return self._replace(precision=paired[0], recall=paired[1]).f1(every)

    def found(self, chosen: Tensor) -> float | None:
        """Return the share of some of the faces that a region has; None if there are none."""
        return float((self.best_iou[chosen] > FOUND).double().mean()) if chosen.any() else None


def match_faces(labels: Tensor, truth: Tensor) -> Faces:
    """Return how regions ``(N,)`` and true faces ``(N,)`` meet."""
    table = contingency_table(labels, truth)
    pairs = match_regions(table)
    rows, shared = table.faces[pairs], 100 * table.overlaps[pairs].double()
    nothing = torch.full((len(table.face_labels),), torch.nan, dtype=torch.float64)
    return Faces(
        table.face_labels,
        table.face_sizes,
        torch.zeros_like(nothing).scatter_reduce(0, table.faces, table.iou.double(), "amax"),
        nothing.index_copy(0, rows, shared / table.region_sizes[table.regions[pairs]]),
        nothing.index_copy(0, rows, shared / table.face_sizes[rows]),
    )


def score_faces(labels: Tensor, cloud: EvalCloud, at_edges: Tensor) -> Record:
    """Return the indices of this file.

    Args:
        labels: Regions, shape ``(N,)``.
        cloud: A cloud with truth.
        at_edges: Points of a true face with another one among their neighbours, shape ``(N,)``.
    """
    faces = match_faces(labels, cloud.labels)
    large = faces.sizes >= LARGE
    near = point_outcomes(labels, cloud.labels)[at_edges]
    scores = {
        "f1_large": faces.f1(large),
        "f1_of_every": faces.f1_of_every(),
        "found_large": faces.found(large),
        "found_small": faces.found(~large),
        "right_at_edges": float((near == _RIGHT).double().mean()),
        "none_at_edges": float((near == _NONE).double().mean()),
    }
    if cloud.curved is not None:
        curved = torch.isin(faces.labels, cloud.curved)
        scores |= {
            "found_curved": faces.found(curved & large),
            "found_flat": faces.found(~curved & large),
        }
    if cloud.objects is not None:
        objects = match_faces(labels, cloud.objects)
        every = torch.ones_like(objects.sizes, dtype=torch.bool)
        scores["f1_objects"] = objects.f1(every)
        scores["f1_objects_exact"] = match_faces(cloud.labels, cloud.objects).f1(every)
    return scores


def find_edges(truth: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the points of a face that have one of another among their neighbours, ``(N,)``."""
    crossed = [
        ((truth[some.long()] != own[:, None]) & (truth[some.long()] != UNLABELED)).any(dim=1)
        for some, own in zip(neighbors.indices.split(_CHUNK), truth.split(_CHUNK), strict=True)
    ]
    return torch.cat(crossed) & (truth != UNLABELED)
