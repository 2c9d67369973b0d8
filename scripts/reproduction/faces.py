"""What the means over all pairs hide: large and small faces, edges, curved surfaces, objects."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from reproduction.cells import Record
from reproduction.clouds import EvalCloud
from torchrg.metrics import contingency_table, match_regions
from torchrg.structures import UNLABELED, Neighbors

LARGE = 1000
"""Points from which on a face is called large here."""

FOUND = 0.5
"""A face is found if a region has more than this intersection over union with it."""

RIGHT, PART, OTHER, NONE = range(4)
"""What can become of a point: it is in the region of its face, in a second region of its face, in
the region of another face, in no region."""

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
    near = outcomes_of(labels, cloud.labels)[at_edges]
    scores = {
        "f1_large": faces.f1(large),
        "found_large": faces.found(large),
        "found_small": faces.found(~large),
        "right_at_edges": float((near == RIGHT).double().mean()),
        "none_at_edges": float((near == NONE).double().mean()),
    }
    if cloud.curved is not None:
        curved = torch.isin(faces.labels, cloud.curved)
        scores |= {
            "found_curved": faces.found(curved & large),
            "found_flat": faces.found(~curved & large),
        }
    if cloud.objects is not None:
        objects = match_faces(labels, cloud.objects)
        scores["f1_objects"] = objects.f1(torch.ones_like(objects.sizes, dtype=torch.bool))
    return scores


def find_edges(truth: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the points of a face that have one of another among their neighbours, ``(N,)``."""
    crossed = [
        ((truth[some.long()] != own[:, None]) & (truth[some.long()] != UNLABELED)).any(dim=1)
        for some, own in zip(neighbors.indices.split(_CHUNK), truth.split(_CHUNK), strict=True)
    ]
    return torch.cat(crossed) & (truth != UNLABELED)


def outcomes_of(labels: Tensor, truth: Tensor) -> Tensor:
    """Return what became of each point, ``(N,)``: ``RIGHT``, ``PART``, ``OTHER`` or ``NONE``.

    Args:
        labels: Regions, shape ``(N,)``.
        truth: Faces, shape ``(N,)``.
    """
    table = contingency_table(labels, truth)
    pairs = match_regions(table)
    partner = torch.full_like(table.region_labels, UNLABELED - 1)
    partner[table.regions[pairs]] = table.face_labels[table.faces[pairs]]
    # Overlaps by region, the largest first; the first of each region is that with its main face.
    order = np.lexsort((-table.overlaps.numpy(), table.regions.numpy()))
    regions, first = np.unique(table.regions.numpy()[order], return_index=True)
    main = torch.full_like(table.region_labels, UNLABELED - 1)
    main[regions] = table.face_labels[table.faces[order[first]]]
    outcome = torch.full_like(labels, NONE)
    labeled = labels != UNLABELED
    rows = torch.searchsorted(table.region_labels, labels[labeled])
    faces = truth[labeled]
    outcome[labeled] = torch.where(
        partner[rows] == faces, RIGHT, torch.where(main[rows] == faces, PART, OTHER)
    )
    return outcome
