"""A segmentation as what files hold: fields of the cloud, or the arrays of a result file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.structures import PLANE_KINDS, Cloud, Planes, Segmentation


def with_segmentation(cloud: Cloud, segmentation: Segmentation) -> Cloud:
    """Return a cloud with ``labels``, ``normals`` and ``curvature`` behind its other fields."""
    found = ("labels", "normals", "curvature")
    kept = {name: values for name, values in cloud.fields.items() if name not in found}
    results = {name: _array(getattr(segmentation, name)) for name in found}
    return replace(cloud, fields={**kept, **results})


def result_arrays(cloud: Cloud, segmentation: Segmentation) -> dict[str, NDArray[Any]]:
    """Return the arrays of a result file by name, in the coordinates of the cloud itself.

    What the table of planes does not have is left out. Rings of outlines follow each other in
    ``outline_points``; ``outline_ring_sizes`` and ``outline_ring_planes`` say how long each is and
    to which plane it belongs.
    """
    return {
        "points": cloud.coordinates,
        "labels": _array(segmentation.labels),
        "normals": _array(segmentation.normals),
        "curvature": _array(segmentation.curvature),
        "sharp": _array(segmentation.sharp),
        "valid": _array(segmentation.valid),
        **_plane_arrays(segmentation.planes, cloud.origin),
    }


def _plane_arrays(planes: Planes, origin: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a table of planes whose coordinates are about an origin."""

    def moved(places: Tensor) -> NDArray[np.float64]:
        return _array(places).astype(np.float64) + origin

    table = planes._asdict()
    kind, outline, adjacency = (table.pop(name) for name in ("kind", "outline", "adjacency"))
    arrays = {f"plane_{name}": _array(values) for name, values in table.items()}
    arrays["plane_offset"] = (
        arrays["plane_offset"].astype(np.float64) + arrays["plane_normal"] @ origin
    )
    arrays |= {f"plane_{name}": moved(table[name]) for name in ("centroid", "center")}
    if kind is not None:
        arrays["plane_kind"] = np.array(PLANE_KINDS)[_array(kind)]
    if adjacency is not None:
        names = (f"adjacency_{name}" for name in adjacency._fields)
        arrays |= zip(names, map(_array, adjacency), strict=True)
    if outline is not None:
        rings = [(plane, ring) for plane, own in enumerate(outline) for ring in own]
        arrays["outline_points"] = moved(torch.cat([planes.center[:0], *(r for _, r in rings)]))
        arrays["outline_ring_sizes"] = np.array([len(ring) for _, ring in rings], dtype=np.int64)
        arrays["outline_ring_planes"] = np.array([plane for plane, _ in rings], dtype=np.int64)
    return arrays


def check_segmentation(path: Path, cloud: Cloud, segmentation: Segmentation) -> None:
    """Check that a segmentation has a row for each point of a cloud."""
    if len(segmentation.labels) != len(cloud):
        raise FormatError(
            f"{path}: expected a segmentation of {len(cloud)} points, got "
            f"{len(segmentation.labels)}; pass the cloud that was segmented."
        )


def _array(tensor: Tensor) -> NDArray[Any]:
    """Return the values of a tensor."""
    values: NDArray[Any] = tensor.detach().cpu().numpy()
    return values
