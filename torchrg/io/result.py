"""A segmentation as what files hold: fields of the cloud, or the arrays of a result file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.structures import Cloud, Segmentation


def with_segmentation(cloud: Cloud, segmentation: Segmentation) -> Cloud:
    """Return a cloud with ``labels``, ``normals`` and ``curvature`` of a segmentation.

    Args:
        cloud: The cloud that was segmented; its other fields stay, in front.
        segmentation: Its segmentation.

    Returns:
        A new cloud.
    """
    found = ("labels", "normals", "curvature")
    kept = {name: values for name, values in cloud.fields.items() if name not in found}
    results = {name: _array(getattr(segmentation, name)) for name in found}
    return replace(cloud, fields={**kept, **results})


def result_arrays(cloud: Cloud, segmentation: Segmentation) -> dict[str, NDArray[Any]]:
    """Return the arrays of a result file.

    Args:
        cloud: The cloud that was segmented.
        segmentation: Its segmentation, about the cloud's origin.

    Returns:
        The arrays by name. Coordinates, offsets and centroids of planes are the input's own.
    """
    planes = segmentation.planes
    normal, origin = _array(planes.normal), cloud.origin
    return {
        "points": cloud.coordinates,
        "labels": _array(segmentation.labels),
        "normals": _array(segmentation.normals),
        "curvature": _array(segmentation.curvature),
        "sharp": _array(segmentation.sharp),
        "valid": _array(segmentation.valid),
        "plane_normal": normal,
        "plane_offset": _array(planes.offset).astype(np.float64) + normal @ origin,
        "plane_centroid": _array(planes.centroid).astype(np.float64) + origin,
        "plane_area": _array(planes.area),
        "plane_count": _array(planes.count),
        "plane_rms": _array(planes.rms),
    }


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
