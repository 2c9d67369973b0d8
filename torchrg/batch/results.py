"""The files of a converted scan: arrays, and the table of planes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.datasets import describe_planes
from torchrg.io import atomic_path
from torchrg.structures import Segmentation


def write_results(
    folder: Path,
    coord: NDArray[np.floating],
    segmentation: Segmentation,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write ``coord``, ``normal``, ``curvature``, ``plane`` as ``.npy``, and ``planes.json``.

    Args:
        folder: Where; it exists.
        coord: Coordinates, shape ``(*, 3)``, in the dtype to be written.
        segmentation: What was found there, of the same leading axes.
        fields: Further arrays by name.
        origin: Where the origin of the segmentation is, in the coordinates of ``coord``.

    Returns:
        Names of the files.

    Raises:
        FormatError: If one cannot be written.
    """
    arrays: dict[str, NDArray[Any]] = {
        "coord": coord,
        "normal": segmentation.normals.numpy(),
        "curvature": segmentation.curvature.numpy(),
        "plane": segmentation.labels.numpy().astype(np.int32),
        **(fields or {}),
    }
    for name, values in arrays.items():
        with atomic_path(folder / f"{name}.npy") as beside:
            np.save(beside, np.ascontiguousarray(values), allow_pickle=False)
    table = describe_planes(segmentation.planes, origin=origin)
    with atomic_path(folder / "planes.json") as beside:
        beside.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return [*(f"{name}.npy" for name in arrays), "planes.json"]
