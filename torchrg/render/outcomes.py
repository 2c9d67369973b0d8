"""What became of each point of a segmentation with a known truth: for pictures of errors."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.metrics.contingency import check_labels, contingency_table
from torchrg.metrics.labels import match_regions
from torchrg.structures import UNLABELED

OUTCOMES = {
    "right": ((214, 224, 214), "in the region of their face"),
    "part": ((245, 170, 40), "in a second region of their face"),
    "other": ((205, 45, 60), "in the region of another face"),
    "none": ((50, 95, 190), "in no region"),
}
"""What can become of a point: colour, and what it means."""


def outcomes_of(
    labels: Tensor | NDArray[np.integer], truth: Tensor | NDArray[np.integer]
) -> Tensor:
    """Return what became of each point, as a place in :data:`OUTCOMES`.

    Args:
        labels: Regions, shape ``(N,)``.
        truth: Faces, shape ``(N,)``.

    Returns:
        Shape ``(N,)``, int64: 0 where the region of the point is the partner of its face, 1 where
        it is another one whose largest part is that face, 2 where it is mostly of other faces, 3
        where the point is in no region.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> outcomes_of(torch.tensor([0, 0, 0, 1, 2, -1]), torch.tensor([5, 5, 5, 5, 6, 6]))
        tensor([0, 0, 0, 1, 0, 3])
    """
    regions, faces = check_labels("outcomes_of", labels=labels, truth=truth)
    table = contingency_table(regions, faces)
    pairs = match_regions(table)
    partner = torch.full_like(table.region_labels, UNLABELED - 1)
    partner[table.regions[pairs]] = table.face_labels[table.faces[pairs]]
    # Overlaps by region, the largest first; the first of each region is that with its main face.
    order = np.lexsort((-table.overlaps.numpy(), table.regions.numpy()))
    rows, first = np.unique(table.regions.numpy()[order], return_index=True)
    main = torch.full_like(table.region_labels, UNLABELED - 1)
    main[rows] = table.face_labels[table.faces[order[first]]]
    outcome = torch.full_like(regions, 3)
    labeled = regions != UNLABELED
    places = torch.searchsorted(table.region_labels, regions[labeled])
    own = faces[labeled]
    outcome[labeled] = torch.where(
        partner[places] == own, 0, torch.where(main[places] == own, 1, 2)
    )
    return outcome
