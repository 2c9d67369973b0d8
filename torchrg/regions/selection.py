"""Planes that a result keeps, by area and class, and their order."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from torchrg.config import SelectionConfig, settings_of
from torchrg.errors import ConfigError
from torchrg.linalg import unit_direction
from torchrg.regions.classes import classify_planes
from torchrg.structures import (
    PLANE_COLUMNS,
    PLANE_KINDS,
    UNLABELED,
    PlaneAdjacency,
    PlaneKind,
    Planes,
    Segmentation,
)


def select_planes(
    seg: Segmentation,
    *,
    min_area: float = 0.0,
    kinds: Sequence[PlaneKind] | str | None = None,
    sort: Literal["points", "area"] = "points",
    up: Sequence[float] | str | None = None,
) -> Segmentation:
    """Keep planes by area and class; points of other planes get no label.

    :func:`torchrg.segment_planes` takes the same settings. To keep superpoints as they are, make
    them before: :func:`torchrg.make_superpoints` reads the borders of all planes.

    Args:
        seg: A segmentation of a cloud or a depth image.
        min_area: Minimum area of a plane, in squares of the unit of the cloud.
        kinds: Classes to keep, from :data:`torchrg.structures.PLANE_KINDS`, as in ``"floor,wall"``
            or ``("floor", "wall")``. Default: all.
        sort: What planes are numbered by, the largest first: their number of points, or their area.
        up: Upward direction to classify planes by, three numbers or an axis such as ``"-y"``.
            Default: classes are those of the plane table, and z is up where it has none.

    Returns:
        The segmentation with these planes alone. Labels count from 0; the plane table, its outlines
        and its adjacency follow.

    Raises:
        ConfigError: If a setting is wrong, or if planes of a depth image have no classes.

    Example:
        >>> from torchrg import segment_planes
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> seg = segment_planes(torch.stack([x, y, 10 * (x > 11)], dim=1))
        >>> seg.planes.area.round().tolist(), len(select_planes(seg, min_area=150).planes)
        ([209.0, 133.0], 1)
    """
    given = {"min_area": min_area, "kinds": kinds, "sort": sort}
    settings = settings_of("select_planes", SelectionConfig, None, given)
    if up is not None or (settings.kinds is not None and seg.planes.kind is None):
        direction = unit_direction("select_planes", "z" if up is None else up)
        if seg.points is None:
            raise ConfigError(
                "select_planes: expected a segmentation with points to classify planes, got none; "
                "pass up to segment_depth."
            )
        kind = classify_planes(seg.planes, seg.points, seg.labels, direction)
        seg = replace(seg, planes=replace(seg.planes, kind=kind))
    return keep_planes(seg, choose_planes(seg.planes, settings))


def choose_planes(planes: Planes, settings: SelectionConfig) -> Tensor:
    """Return the rows of planes that settings keep, in their new order, shape ``(n,)``.

    Where ``settings`` name classes, the table must have them.
    """
    is_kept = planes.area >= settings.min_area
    if settings.kinds is not None and planes.kind is not None:
        wanted = [PLANE_KINDS.index(name) for name in settings.kinds]
        is_kept &= torch.isin(planes.kind, planes.kind.new_tensor(wanted))
    rows = is_kept.nonzero().squeeze(1)
    sizes = planes.area if settings.sort == "area" else planes.count
    return rows[sizes[rows].argsort(descending=True, stable=True)]


def keep_planes(seg: Segmentation, rows: Tensor) -> Segmentation:
    """Return a segmentation with some of its planes, numbered in the order of ``rows``."""
    planes = seg.planes
    columns = {
        name: getattr(planes, name)[rows]
        for name in (*PLANE_COLUMNS, "kind", "object")
        if getattr(planes, name) is not None
    }
    if planes.outline is not None:
        columns["outline"] = tuple(planes.outline[row] for row in rows.tolist())
    if planes.adjacency is not None:
        columns["adjacency"] = _kept_pairs(planes.adjacency, rows, len(planes))
    labels = renumber_planes(seg.labels, rows, len(planes))
    return replace(seg, labels=labels, planes=replace(planes, **columns))


def renumber_planes(labels: Tensor, rows: Tensor, num_planes: int) -> Tensor:
    """Return labels by the places of their planes in ``rows``, -1 where a plane is not there.

    Example:
        >>> renumber_planes(torch.tensor([0, 1, 2, -1]), torch.tensor([2, 0]), 3).tolist()
        [1, -1, 0, -1]
    """
    places = labels.new_full((num_planes + 1,), UNLABELED)
    places[rows] = torch.arange(len(rows), device=labels.device, dtype=labels.dtype)
    return places[labels.long()]


def _kept_pairs(adjacency: PlaneAdjacency, rows: Tensor, num_planes: int) -> PlaneAdjacency:
    """Return the pairs whose planes are both in ``rows``, in the order of their new numbers."""
    pairs = renumber_planes(adjacency.pairs, rows, num_planes).sort(dim=1).values
    is_kept = pairs[:, 0] >= 0
    order = (pairs[:, 0] * num_planes + pairs[:, 1])[is_kept].argsort()
    return PlaneAdjacency(*(column[is_kept][order] for column in (pairs, *adjacency[1:])))
