"""The plane table as rows and as JSON."""

import json
from typing import Any

from torch import Tensor

from torchrg.structures import PLANE_KINDS, Planes

_COLUMNS = (
    "normal",
    "offset",
    "centroid",
    "area",
    "count",
    "rms",
    "extent",
    "axes",
    "center",
    "curved",
)


def planes_to_rows(planes: Planes) -> list[dict[str, Any]]:
    """Return the plane table as one mapping for each plane, for ``pandas.DataFrame(rows)``.

    Args:
        planes: The table.

    Returns:
        Rows with the label and plain numbers and lists by the names of :class:`Planes`. ``kind``
        is a word, ``outline`` a list of rings, ``neighbors`` a list of planes that this one meets
        with ``plane``, ``boundary_length`` and ``dihedral_deg``; they are left out where the table
        does not have them.

    Example:
        >>> import torch
        >>> from torchrg.regions.planes import summarize_planes
        >>> points, labels = torch.eye(3), torch.zeros(3, dtype=torch.int64)
        >>> rows = planes_to_rows(summarize_planes(points, torch.eye(3), labels))
        >>> rows[0]["label"], rows[0]["count"], rows[0]["curved"]
        (0, 3, True)
    """
    columns = {name: getattr(planes, name).tolist() for name in _COLUMNS}
    rows = [
        {"label": label, **{name: values[label] for name, values in columns.items()}}
        for label in range(len(planes.offset))
    ]
    for label, row in enumerate(rows):
        if planes.kind is not None:
            row["kind"] = PLANE_KINDS[int(planes.kind[label])]
        if planes.outline is not None:
            row["outline"] = [ring.tolist() for ring in planes.outline[label]]
        if planes.adjacency is not None:
            row["neighbors"] = []
    if planes.adjacency is not None:
        for (a, b), *values in zip(*(_as_list(part) for part in planes.adjacency), strict=True):
            found = dict(zip(("boundary_length", "dihedral_deg"), values, strict=True))
            rows[a]["neighbors"].append({"plane": b, **found})
            rows[b]["neighbors"].append({"plane": a, **found})
    return rows


def planes_to_json(planes: Planes) -> str:
    """Return the plane table as JSON text: ``{"planes": [...]}`` with the rows.

    Args:
        planes: The table.

    Returns:
        The text.

    Example:
        >>> import torch
        >>> from torchrg.regions.planes import summarize_planes
        >>> planes = summarize_planes(torch.eye(3), torch.eye(3), torch.zeros(3).int())
        >>> json.loads(planes_to_json(planes))["planes"][0]["count"]
        3
    """
    return json.dumps({"planes": planes_to_rows(planes)})


def _as_list(values: Tensor) -> list[Any]:
    listed: list[Any] = values.tolist()
    return listed
