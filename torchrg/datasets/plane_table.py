"""The plane table as ``planes.json``."""

from collections.abc import Sequence
from typing import Any

import torch

from torchrg.structures import PLANE_KINDS, Planes


def describe_planes(planes: Planes, *, origin: Sequence[float] | None = None) -> dict[str, Any]:
    """Return a plane table as JSON can hold it.

    Args:
        planes: The table.
        origin: Where the origin of its coordinates is in those of the data set, shape ``(3,)``.
            Default: they are the same.

    Returns:
        ``planes``: for each plane its ``id``, the value in ``plane.npy``, and ``normal``,
        ``offset`` (``normal . x = offset``), ``centroid``, ``area``, ``count``, ``rms``,
        ``extent``, ``axes``, ``center``, ``curved``; ``kind`` and ``outline`` (rings of points)
        where they are known.
        ``adjacency`` where it is known: ``pair`` of ids, ``boundary_length``, ``dihedral_deg``.

    Example:
        >>> from torchrg.pipeline import segment_planes
        >>> grid = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.ones(1))
        >>> plane = describe_planes(segment_planes(grid).planes, origin=[0, 0, 5])["planes"][0]
        >>> plane["count"], plane["normal"], plane["offset"]
        (81, [0.0, 0.0, 1.0], 6.0)
    """
    shift = torch.as_tensor([0.0] * 3 if origin is None else origin, dtype=torch.float64)
    normal = planes.normal.detach().cpu().double()
    columns: dict[str, Any] = {
        "id": torch.arange(len(normal)),
        "normal": normal,
        "offset": planes.offset.detach().cpu().double() + normal @ shift,
        "centroid": planes.centroid.detach().cpu().double() + shift,
        "area": planes.area,
        "count": planes.count,
        "rms": planes.rms,
        "extent": planes.extent,
        "axes": planes.axes,
        "center": planes.center.detach().cpu().double() + shift,
        "curved": planes.curved,
    }
    lists = {name: values.tolist() for name, values in columns.items()}
    if planes.kind is not None:
        lists["kind"] = [PLANE_KINDS[kind] for kind in planes.kind.tolist()]
    if planes.outline is not None:
        lists["outline"] = [
            [(ring.detach().cpu().double() + shift).tolist() for ring in rings]
            for rings in planes.outline
        ]
    table: dict[str, Any] = {"planes": _rows(lists)}
    if planes.adjacency is not None:
        pairs, lengths, angles = (part.tolist() for part in planes.adjacency)
        table["adjacency"] = _rows(
            {"pair": pairs, "boundary_length": lengths, "dihedral_deg": angles}
        )
    return table


def _rows(columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Turn a table of columns into a list of rows."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
