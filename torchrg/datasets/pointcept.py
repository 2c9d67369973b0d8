"""Scene folders in Pointcept's processed layout.

``coord`` float32, ``color`` uint8 and ``normal`` float32 of shape ``(N, 3)``; ``segment`` and
``instance`` int16 of shape ``(N, 1)``, ``(N, 3)`` for ScanNet++; ``segment20``, ``segment200`` and
``instance`` int64 of shape ``(N,)`` for ScanNet. torchrg adds ``plane`` int32 of shape ``(N,)``,
``curvature`` float32 of shape ``(N, 1)`` (like Pointcept's features), ``planes.json``,
``provenance.json``, and optionally ``superpoint`` int32. Pointcept ignores unknown files;
``import torchrg.transforms.pointcept`` makes it load these.
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
from torchrg.datasets import provenance
from torchrg.errors import FormatError
from torchrg.io.columns import narrow_integers
from torchrg.io.files import atomic_path, create_folder, local_path
from torchrg.io.npy import check_rows, map_array, map_folder
from torchrg.io.result import PLANES_FILE, RECORD, describe_planes
from torchrg.structures import Segmentation
from torchrg.structures.colors import narrow_colors, read_colors
from torchrg.structures.points import Array

POINT_ARRAYS = (
    "coord", "color", "normal", "strength", "segment", "segment20", "segment200", "instance",
    "superpoint", "plane", "curvature",
)  # fmt: skip
"""Per-point arrays of a scene folder."""
INPUT_ARRAYS = POINT_ARRAYS[:8]
"""Per-point arrays of the input."""
SOURCE_ARRAYS = tuple(name for name in INPUT_ARRAYS if name != "normal")
"""Input arrays that are copied to results."""
_SCANNET = ("segment20", "segment200")
_LABELS = ("segment", *_SCANNET, "instance", "superpoint", "plane")
_FEATURES = ("strength", "curvature")
"""Scalar arrays that have two axes in files."""


def read_pointcept_scene(folder: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read a scene folder of torchrg or Pointcept.

    Args:
        folder: A folder with ``coord.npy``.

    Returns:
        The existing arrays of :data:`POINT_ARRAYS`; labels as int64 of shape ``(N,)``. The other
        arrays are memory-mapped copy-on-write; ``curvature`` has shape ``(N,)``. For points with
        several labels, the first is returned.

    Raises:
        FormatError: If coordinates are missing, a file is corrupt, or lengths differ.
    """
    arrays = map_folder(local_path(folder), POINT_ARRAYS)
    if arrays["coord"].ndim != 2:
        shape = arrays["coord"].shape
        raise FormatError(f"{Path(folder) / 'coord.npy'}: expected shape (N, 3), got {shape}.")
    sample = {name: as_tensor("scene", name, values) for name, values in arrays.items()}
    if "curvature" in sample:
        sample["curvature"] = sample["curvature"].reshape(-1)
    return {
        name: values.reshape(len(values), -1)[:, 0].long() if name in _LABELS else values
        for name, values in sample.items()
    }


def write_pointcept_scene(
    folder: str | os.PathLike[str],
    sample: Mapping[str, object],
    segmentation: Segmentation,
    *,
    superpoint: Tensor | NDArray[np.integer] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write a scene folder, or add results to a folder that Pointcept wrote.

    Files not written by this function are never changed: their arrays must have the same number of
    rows, and coordinates must equal the sample's. Files of an earlier call, as listed in
    ``provenance.json``, are replaced or removed. All files are complete before the first appears.

    Args:
        folder: The scene, ``OUT/Area_i/<room>``; created if missing.
        sample: ``coord`` ``(N, 3)`` and any of ``color``, ``normal``, ``strength``, ``segment``,
            ``segment20``, ``segment200``, ``instance``, as tensors or arrays. Default for
            ``normal``: the normals of the segmentation.
        segmentation: Result of :func:`torchrg.segment_planes` for ``coord``.
        superpoint: Superpoint of each point, shape ``(N,)``. Default: not written.
        origin: Origin of ``coord``, for the plane table. Default: that of the data set.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If the folder contains another scene, or a ``plane``, ``curvature``,
            ``superpoint`` or ``planes.json`` of another program, or is not writable.
    """
    target = Path(folder)
    arrays = _convert_arrays(target, sample, segmentation, superpoint=superpoint)
    torchrg_files = provenance.owned_files(provenance.read_record(target, strict=True))
    # The arrays of torchrg are never kept as inputs: such a file of another program is an error.
    inputs = {
        name
        for name in arrays.keys() - {"plane", "curvature", "superpoint"}
        if f"{name}.npy" not in torchrg_files and (target / f"{name}.npy").exists()
    }
    _check_inputs(target, arrays, inputs)
    new = {f"{name}.npy": values for name, values in arrays.items() if name not in inputs}
    return write_files(target, new, describe_planes(segmentation.planes, origin=origin))


def write_results(
    folder: Path,
    coord: NDArray[np.floating],
    segmentation: Segmentation,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write ``coord``, ``normal``, ``curvature``, ``plane`` as ``.npy``, and ``planes.json``.

    The folder must exist. ``coord`` ``(*, 3)`` is in the dtype to write and has the leading axes of
    the segmentation; ``fields`` are written by name. ``origin`` is the origin of the segmentation
    in the coordinates of ``coord``. Returns the names of the files; files of other origin are never
    replaced, see :func:`torchrg.datasets.pointcept.write_files`.
    """
    arrays: dict[str, NDArray[Any]] = {
        "coord": coord,
        "normal": segmentation.normals.numpy(),
        "curvature": segmentation.curvature.numpy(),
        "plane": segmentation.labels.numpy().astype(np.int32),
        **(fields or {}),
    }
    files = {f"{name}.npy": np.ascontiguousarray(values) for name, values in arrays.items()}
    return write_files(folder, files, describe_planes(segmentation.planes, origin=origin))


def write_files(
    target: Path,
    contents: Mapping[str, Array | bytes],
    planes: Mapping[str, object],
) -> list[str]:
    """Write files and the plane table of a scene, and return their names.

    ``contents`` has bytes, or arrays to write as ``.npy``, by path relative to the folder of the
    scene. Files of an earlier call, as listed in ``provenance.json``, are replaced, or removed if
    this call does not write them; files of other origin raise FormatError. A claim on the files
    precedes them, when all of them are complete.
    """
    contents = {**contents, PLANES_FILE: json.dumps(planes, indent=1).encode()}
    earlier = provenance.read_record(target, strict=True)
    provenance.check_owned(target, [*contents, RECORD], earlier)
    create_folder(target)
    with ExitStack() as stack:
        # Files are renamed in reverse order: the plane table first, the coordinates last.
        for name, content in contents.items():
            path = Path(os.path.normpath(target / name))
            create_folder(path.parent)
            temporary = stack.enter_context(atomic_path(path, within=target))
            with temporary.open("wb") as stream:
                if isinstance(content, bytes):
                    stream.write(content)
                else:
                    npy_format.write_array(stream, content, allow_pickle=False)
        provenance.write_record(target, provenance.claim_files(earlier or {}, contents))
    provenance.remove_unwritten(target, target, earlier, contents)
    return [*contents]


def _convert_arrays(
    target: Path,
    sample: Mapping[str, object],
    segmentation: Segmentation,
    *,
    superpoint: Tensor | NDArray[np.integer] | None,
) -> dict[str, Array]:
    """Return the arrays of a scene in Pointcept's types."""
    entries: dict[str, object] = {"normal": segmentation.normals}
    entries |= {name: sample[name] for name in INPUT_ARRAYS if name in sample}
    entries |= {"plane": segmentation.labels, "curvature": segmentation.curvature}
    if superpoint is not None:
        entries["superpoint"] = superpoint
    dtypes = {"plane": np.int32, "superpoint": np.int32}
    arrays: dict[str, Array] = {}
    for name in (name for name in POINT_ARRAYS if name in entries):
        values = as_tensor("write_pointcept_scene", name, entries[name]).detach().cpu().numpy()
        check_rows(target / f"{name}.npy", values, segmentation.labels.shape)
        if name in _SCANNET or (name == "instance" and not entries.keys().isdisjoint(_SCANNET)):
            arrays[name] = values.astype(np.int64)
        elif name in ("segment", "instance"):
            integers = narrow_integers(values.astype(np.int64), ("i2", "i4"))
            arrays[name] = integers.reshape(len(values), -1)
        elif name == "color":
            arrays[name] = narrow_colors(read_colors(target / "color.npy", values)[0])
        elif name in _FEATURES:
            arrays[name] = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
        else:
            arrays[name] = np.ascontiguousarray(values, dtypes.get(name, np.float32))
    return arrays


def _check_inputs(target: Path, arrays: Mapping[str, Array], inputs: set[str]) -> None:
    """Check that existing input files match the points to write."""
    for name in sorted(inputs):
        path = target / f"{name}.npy"
        values = map_array(path)
        check_rows(path, values, arrays[name].shape[:1])
        if name == "coord" and not np.array_equal(values.astype(np.float32), arrays[name]):
            raise FormatError(f"{path}: expected the same points, got others; use another folder.")
