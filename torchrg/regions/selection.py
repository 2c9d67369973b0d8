"""Selection and ordering of planes by area and class."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from torchrg._checks import check_kinds
from torchrg.config import SelectionConfig, settings_of
from torchrg.errors import CloudWarning, ConfigError, warn
from torchrg.linalg.angles import unit_direction
from torchrg.regions.classes import find_kinds
from torchrg.structures import (
    PLANE_KINDS,
    UNLABELED,
    PlaneAdjacency,
    PlaneKind,
    Planes,
    Segmentation,
)
from torchrg.structures.planes import PLANE_COLUMNS

_MIN_RATIO = 1e-4
"""Ratio of the minimum area to the area of the smallest plane below which it is probably given in
another unit: square meters instead of square millimeters are 1e-6."""


def select_planes(
    seg: Segmentation,
    *,
    min_area: float = 0.0,
    kinds: Sequence[PlaneKind] | str | None = None,
    sort: Literal["points", "area"] = "points",
    up: Sequence[float] | str | None = None,
) -> Segmentation:
    """Select planes by area and class; points of other planes become unlabeled.

    :func:`torchrg.segment_planes` accepts the same parameters. To keep superpoints unchanged,
    compute them first: :func:`torchrg.make_superpoints` uses the boundaries of all planes.

    Args:
        seg: A segmentation of a cloud or a depth image.
        min_area: Minimum area of a plane, in squared coordinate units. Default: 0.
        kinds: Classes to keep, from :data:`torchrg.structures.PLANE_KINDS`, as in ``"floor,wall"``
            or ``("floor", "wall")``. Default: all.
        sort: Order of the planes, descending: number of points or area. Default: ``"points"``.
        up: Upward direction for the classification, three numbers or an axis such as ``"-y"``.
            Default: the classes of the plane table; z if it has none.

    Returns:
        The segmentation with the selected planes. Labels start at 0; the plane table, its polygons
        and its adjacency are updated.

    Raises:
        ConfigError: If a parameter is invalid, or if planes of a depth image have no classes.

    Example:
        >>> from torchrg import segment_planes
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> seg = segment_planes(torch.stack([x, y, 10 * (x > 11)], dim=1))
        >>> seg.planes.area.round().tolist(), len(select_planes(seg, min_area=150).planes)
        ([209.0, 133.0], 1)
    """
    check_kinds("select_planes", "pass a result of segment_planes", seg=(seg, Segmentation))
    values = {"min_area": min_area, "kinds": kinds, "sort": sort}
    settings = settings_of("select_planes", SelectionConfig, None, values)
    if up is not None or (settings.kinds is not None and seg.planes.kind is None):
        direction = unit_direction("select_planes", "z" if up is None else up)
        if seg.points is None:
            raise ConfigError(
                "select_planes: expected points in the segmentation to classify planes, got None. "
                "Pass up to segment_depth."
            )
        kind = find_kinds(seg.planes, seg.points, seg.labels, direction)
        seg = replace(seg, planes=replace(seg.planes, kind=kind))
    return keep_planes(seg, selected_rows(seg.planes, settings))


def selected_rows(planes: Planes, settings: SelectionConfig) -> Tensor:
    """Return the rows of the selected planes in their new order, shape ``(n,)``.

    If ``settings`` contain classes, the table must have them.
    """
    smallest = float(planes.area.amin()) if len(planes) else 0.0
    if 0 < settings.min_area < _MIN_RATIO * smallest:
        warn(
            f"min_area {settings.min_area:g} keeps all planes, the smallest has {smallest:.3g}; "
            "check that it is in squared units of the cloud.",
            CloudWarning,
        )
    is_kept = planes.area >= settings.min_area
    if settings.kinds is not None and planes.kind is not None:
        selected = [PLANE_KINDS.index(name) for name in settings.kinds]
        is_kept &= torch.isin(planes.kind, planes.kind.new_tensor(selected))
    rows = is_kept.nonzero().squeeze(1)
    sizes = planes.area if settings.sort == "area" else planes.count
    return rows[sizes[rows].argsort(descending=True, stable=True)]


def keep_planes(seg: Segmentation, rows: Tensor) -> Segmentation:
    """Return a segmentation with the planes ``rows``, numbered in that order."""
    planes = seg.planes
    columns = {
        name: getattr(planes, name)[rows]
        for name in (*PLANE_COLUMNS, "kind", "object")
        if getattr(planes, name) is not None
    }
    if planes.outline is not None:
        columns["outline"] = tuple(planes.outline[row] for row in rows.tolist())
    if planes.adjacency is not None:
        columns["adjacency"] = _select_pairs(planes.adjacency, rows, len(planes))
    labels = renumber_planes(seg.labels, rows, len(planes))
    return replace(seg, labels=labels, planes=replace(planes, **columns))


def renumber_planes(labels: Tensor, rows: Tensor, num_planes: int) -> Tensor:
    """Map labels to the indices of their planes in ``rows``, -1 if not selected."""
    index_of = labels.new_full((num_planes + 1,), UNLABELED)
    index_of[rows] = torch.arange(len(rows), device=labels.device, dtype=labels.dtype)
    return index_of[labels.long()]


def _select_pairs(adjacency: PlaneAdjacency, rows: Tensor, num_planes: int) -> PlaneAdjacency:
    """Return the pairs of planes that are both in ``rows``, renumbered and sorted."""
    pairs = renumber_planes(adjacency.pairs, rows, num_planes).sort(dim=1).values
    is_kept = pairs[:, 0] >= 0
    order = (pairs[:, 0] * num_planes + pairs[:, 1])[is_kept].argsort()
    return PlaneAdjacency(*(column[is_kept][order] for column in (pairs, *adjacency[1:])))
