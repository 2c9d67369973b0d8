"""Colours for plane labels: planes that lie next to each other look clearly different."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.metrics.contingency import check_labels, contingency_table, number_labels
from torchrg.metrics.matching import match_regions
from torchrg.report.grid import CloudGrid, build_grid
from torchrg.report.palette import UNLABELED_GRAY, choose_colors, make_palette
from torchrg.report.touching import touching_planes

_NEIGHBORHOODS = ((60_000, 1.0), (4_000, 0.2))  # cubes of the cloud, and how much they count


def color_planes(
    labels: Tensor | NDArray[Any],
    points: Tensor | NDArray[np.floating] | None = None,
    *,
    reference: Tensor | NDArray[Any] | None = None,
) -> Tensor:
    """Colour the points of each plane.

    Planes get their colours one by one, the largest first: each the colour of a fixed palette that
    is farthest from those of the planes next to it and, less so, from all others. Large planes get
    calm colours, small ones vivid colours.

    Convention:
        The colours do not depend on the order of the points.

    Args:
        labels: Plane of each point, shape ``(*)``, integers; ``UNLABELED`` for none.
        points: Points, shape ``(*, 3)``, which tell what lies next to what. Default: nothing does.
        reference: Other labels of the same points, shape ``(*)``. A plane of ``labels`` and one of
            ``reference`` that are each other's largest overlap get one colour, that of
            ``color_planes(reference, points)``. For pictures side by side.

    Returns:
        Shape ``(*, 3)``, uint8; points of no plane are gray.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> colors = color_planes(torch.tensor([0, 0, 1, -1]))
        >>> colors[3].tolist(), bool((colors[0] == colors[1]).all())
        ([176, 176, 176], True)
    """
    caller = "color_planes"
    tensor = as_tensor(caller, "labels", labels)
    other = None if reference is None else as_tensor(caller, "reference", reference)
    cloud = None if points is None else as_tensor(caller, "points", points)
    check_shapes(caller, labels=(tensor, "*"), points=(cloud, "* 3"), reference=(other, "*"))
    check_floating(caller, points=cloud)
    flat = check_labels(caller, labels=tensor.flatten())[0]
    grid = None if cloud is None else build_grid(cloud.reshape(-1, 3))
    fixed = None
    if other is not None:
        same = check_labels(caller, reference=other.flatten())[0]
        table = contingency_table(flat, same)
        pairs = match_regions(table)
        fixed = torch.full_like(table.region_sizes, -1)
        fixed[table.regions[pairs]] = _choose(same, grid)[1][table.faces[pairs]]
    rows, choices = _choose(flat, grid, fixed)
    gray = torch.full((1, 3), UNLABELED_GRAY, dtype=torch.uint8, device=flat.device)
    colors = torch.cat([make_palette()[0].to(flat.device)[choices], gray])
    return colors[rows].view(*tensor.shape, 3)


def _choose(
    labels: Tensor, grid: CloudGrid | None, fixed: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return each point's row among the labels that occur, and the palette's row of each label."""
    rows = number_labels(labels)[1]
    sizes = torch.bincount(rows[rows >= 0])
    pairs, weights = [sizes.new_zeros((0, 2))], [torch.zeros(0, dtype=torch.float64)]
    for max_cells, weight in _NEIGHBORHOODS:
        if grid is None or not grid.levels:
            break
        pairs.append(touching_planes(grid, rows, max_cells=max_cells))
        weights.append(torch.full((len(pairs[-1]),), weight, dtype=torch.float64))
    choices = choose_colors(
        sizes.cpu(),
        torch.cat(pairs).cpu(),
        torch.cat(weights),
        fixed=None if fixed is None else fixed.cpu(),
    )
    return rows, choices.to(labels.device)
