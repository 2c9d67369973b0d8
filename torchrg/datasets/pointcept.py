"""Scenes in Pointcept's processed layout: a folder of ``.npy`` files for each scene.

``coord`` float32, ``color`` uint8 and ``normal`` float32 of shape ``(N, 3)``; ``segment`` and
``instance`` int16 of shape ``(N, 1)``. Beside them torchrg puts ``plane`` int32 of shape ``(N,)``,
``curvature`` float32 of shape ``(N, 1)`` as Pointcept has features, ``planes.json``, and
``superpoint`` where it is asked for. Pointcept reads the files it knows and passes over the others;
``import torchrg.transforms.pointcept`` makes it know these.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import make_folder
from torchrg.io.npy import check_rows, map_array, map_folder
from torchrg.result import PLANES_FILE, describe_planes
from torchrg.structures import Segmentation

POINT_ARRAYS = (
    "coord", "color", "normal", "strength", "segment", "instance",
    "superpoint", "plane", "curvature",
)  # fmt: skip
"""Arrays of a scene folder that have a row for each point."""
_LABELS = ("segment", "instance", "superpoint", "plane")
_FEATURES = ("strength", "curvature")
"""Arrays of numbers that have two axes in files, whatever they have elsewhere."""


def read_pointcept_scene(folder: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read a scene folder, whoever wrote it.

    Args:
        folder: A folder with ``coord.npy``.

    Returns:
        Those of :data:`POINT_ARRAYS` that are there; labels as int64 of shape ``(N,)``. The others
        are mapped from the files copy-on-write; ``curvature`` has shape ``(N,)``.

    Raises:
        FormatError: If there are no coordinates, a file is damaged, or lengths differ.
    """
    arrays = map_folder(Path(folder), POINT_ARRAYS)
    if arrays["coord"].ndim != 2:
        shape = arrays["coord"].shape
        raise FormatError(f"{Path(folder) / 'coord.npy'}: expected shape (N, 3), got {shape}.")
    sample = {name: as_tensor("scene", name, values) for name, values in arrays.items()}
    if "curvature" in sample:
        sample["curvature"] = sample["curvature"].reshape(-1)
    return {
        name: values.reshape(-1).long() if name in _LABELS else values
        for name, values in sample.items()
    }


def write_pointcept_scene(
    folder: str | os.PathLike[str],
    sample: Mapping[str, Any],
    segmentation: Segmentation,
    *,
    superpoint: Tensor | NDArray[np.integer] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write a scene folder, or complete one that Pointcept wrote.

    What is there and was not written by this function is never changed: the arrays must have as
    many rows, and the coordinates must be those of the sample. What it wrote itself, as
    ``planes.json`` says, is replaced or removed. All files are complete before the first appears.

    Args:
        folder: The scene, ``OUT/Area_i/<room>``; it is made.
        sample: ``coord`` ``(N, 3)`` and any of ``color``, ``normal``, ``strength``, ``segment``,
            ``instance``, as tensors or arrays. Without ``normal`` those of the segmentation are
            written.
        segmentation: What :func:`torchrg.segment_planes` said about ``coord``.
        superpoint: Superpoint of each point, shape ``(N,)``, to be written as ``superpoint`` too,
            which ScanNet's data sets have. Default: none are.
        origin: Where the origin of ``coord`` is, for the plane table; see
            :func:`torchrg.result.describe_planes`. Default: ``coord`` is in the coordinates of the
            data set.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If the folder holds another scene, or a ``plane``, ``curvature``,
            ``superpoint`` or ``planes.json`` from elsewhere, or cannot be written.
    """
    place = Path(folder)
    arrays = _arrays_of(place, sample, segmentation, superpoint=superpoint)
    owned = _owned(place)
    # What only torchrg makes is never kept: one from elsewhere is in the way.
    kept = {
        name
        for name in arrays.keys() - {"plane", "curvature", "superpoint"} - owned
        if (place / f"{name}.npy").exists()
    }
    _check_kept(place, arrays, kept)
    new = {name: values for name, values in arrays.items() if name not in kept}
    return write_arrays(place, new, describe_planes(segmentation.planes, origin=origin))


def write_arrays(
    place: Path, arrays: Mapping[str, NDArray[Any]], planes: Mapping[str, Any]
) -> list[str]:
    """Write arrays by name as ``.npy`` and the table of planes, beside what others have there.

    What an earlier call wrote, as ``planes.json`` says, is replaced or removed; nothing else is.
    All files are complete before the first appears.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If a file from elsewhere is in the way, or the folder cannot be written.
    """
    owned = _owned(place)
    for name in arrays:
        path = place / f"{name}.npy"
        if name not in owned and os.path.lexists(path):
            raise FormatError(f"{path}: was not written by torchrg; move it away to have another.")
    make_folder(place)
    for name in owned - set(arrays):
        (place / f"{name}.npy").unlink(missing_ok=True)
    with ExitStack() as stack:
        # Files take their places in reverse: the claim on them first, the coordinates last.
        for name, values in arrays.items():
            beside = stack.enter_context(atomic_path(place / f"{name}.npy"))
            with beside.open("wb") as stream:
                npy_format.write_array(stream, values, allow_pickle=False)
        claim = stack.enter_context(atomic_path(place / PLANES_FILE))
        claim.write_text(json.dumps({"written": [*arrays], **planes}, indent=1), encoding="utf-8")
    return [*(f"{name}.npy" for name in arrays), PLANES_FILE]


def _arrays_of(
    place: Path,
    sample: Mapping[str, Any],
    segmentation: Segmentation,
    *,
    superpoint: Tensor | NDArray[np.integer] | None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a scene in Pointcept's types."""
    found: dict[str, Any] = {"normal": segmentation.normals}
    found |= {name: sample[name] for name in POINT_ARRAYS[:6] if name in sample}
    found |= {"plane": segmentation.labels, "curvature": segmentation.curvature}
    if superpoint is not None:
        found["superpoint"] = superpoint
    dtypes = {"color": np.uint8, "plane": np.int32, "superpoint": np.int32}
    arrays = {}
    for name in (name for name in POINT_ARRAYS if name in found):
        values = as_tensor("write_pointcept_scene", name, found[name]).detach().cpu().numpy()
        check_rows(place / f"{name}.npy", values, segmentation.labels.shape)
        if name in ("segment", "instance"):
            arrays[name] = _short(values).reshape(-1, 1)
        elif name in _FEATURES:
            arrays[name] = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
        else:
            arrays[name] = np.ascontiguousarray(values, dtypes.get(name, np.float32))
    return arrays


def _short(labels: NDArray[Any]) -> NDArray[Any]:
    """Return labels as int16, or as int32 where they do not fit."""
    limits = np.iinfo(np.int16)
    fit = labels.size == 0 or (labels.min() >= limits.min and labels.max() <= limits.max)
    return labels.astype(np.int16 if fit else np.int32)


def _owned(place: Path) -> set[str]:
    """Return the names of the arrays that torchrg wrote here."""
    try:
        written = json.loads((place / PLANES_FILE).read_text(encoding="utf-8"))["written"]
        return set(written) & set(POINT_ARRAYS)
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise FormatError(
            f"{place / PLANES_FILE}: expected a table of planes that torchrg wrote, got another "
            "file; move it away."
        ) from error


def _check_kept(place: Path, arrays: Mapping[str, NDArray[Any]], kept: set[str]) -> None:
    """Check that what stays in a folder belongs to the points that are written."""
    for name in sorted(kept):
        path = place / f"{name}.npy"
        values = map_array(path)
        check_rows(path, values, arrays[name].shape[:1])
        if name == "coord" and not np.array_equal(values.astype(np.float32), arrays[name]):
            raise FormatError(
                f"{path}: expected the points of this scene, got others; write to another folder."
            )
