"""Scene folders in Pointcept's processed layout.

``coord`` float32, ``color`` uint8 and ``normal`` float32 of shape ``(N, 3)``; ``segment`` and
``instance`` int16 of shape ``(N, 1)``, ``(N, 3)`` for ScanNet++; ``segment20``, ``segment200`` and
``instance`` int64 of shape ``(N,)`` for ScanNet. torchrg adds ``plane`` int32 of shape ``(N,)``,
``curvature`` float32 of shape ``(N, 1)`` (like Pointcept's features), ``planes.json``, and
optionally ``superpoint`` int32. Pointcept ignores unknown files;
``import torchrg.transforms.pointcept`` makes it load these.
"""

import json
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.colors import narrow_colors, read_colors
from torchrg.io.files import PARSE_ERRORS, create_folder, local_path
from torchrg.io.npy import check_rows, map_array, map_folder
from torchrg.result import PLANES_FILE, describe_planes
from torchrg.structures import Array, Segmentation

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


_protected: ContextVar[Collection[str]] = ContextVar("_protected", default=())
"""Names of files that :func:`write_files` does not remove."""


@contextmanager
def protecting_files(names: Collection[str]) -> Iterator[None]:
    """Prevent :func:`write_files` from removing files with these names, in this thread.

    Callers identify files that a user has changed by fingerprints in records.
    """
    token = _protected.set(names)
    try:
        yield
    finally:
        _protected.reset(token)


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
    ``planes.json``, are replaced or removed. All files are complete before the first one appears.

    Args:
        folder: The scene, ``OUT/Area_i/<room>``; created if missing.
        sample: ``coord`` ``(N, 3)`` and any of ``color``, ``normal``, ``strength``, ``segment``,
            ``segment20``, ``segment200``, ``instance``, as tensors or arrays. Default for
            ``normal``: the normals of the segmentation.
        segmentation: Result of :func:`torchrg.segment_planes` for ``coord``.
        superpoint: Superpoint of each point, shape ``(N,)``. Default: not written.
        origin: Origin of ``coord``, for the plane table; see
            :func:`torchrg.result.describe_planes`. Default: ``coord`` is in the coordinates of the
            data set.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If the folder contains another scene, or a ``plane``, ``curvature``,
            ``superpoint`` or ``planes.json`` of another program, or is not writable.
    """
    target = Path(folder)
    arrays = _convert_arrays(target, sample, segmentation, superpoint=superpoint)
    torchrg_files = _torchrg_files(target)
    # The arrays of torchrg are never kept as inputs: such a file of another program is an error.
    inputs = {
        name
        for name in arrays.keys() - {"plane", "curvature", "superpoint"}
        if f"{name}.npy" not in torchrg_files and (target / f"{name}.npy").exists()
    }
    _check_inputs(target, arrays, inputs)
    new = {name: values for name, values in arrays.items() if name not in inputs}
    return write_arrays(target, new, describe_planes(segmentation.planes, origin=origin))


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
    replaced, see :func:`torchrg.datasets.pointcept.write_arrays`.
    """
    arrays: dict[str, NDArray[Any]] = {
        "coord": coord,
        "normal": segmentation.normals.numpy(),
        "curvature": segmentation.curvature.numpy(),
        "plane": segmentation.labels.numpy().astype(np.int32),
        **(fields or {}),
    }
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    return write_arrays(folder, arrays, describe_planes(segmentation.planes, origin=origin))


def write_arrays(
    target: Path, arrays: Mapping[str, Array], planes: Mapping[str, object]
) -> list[str]:
    """Write arrays by name as ``.npy`` files and the plane table; see :func:`write_files`."""
    return write_files(target, {f"{name}.npy": values for name, values in arrays.items()}, planes)


def write_files(
    target: Path, contents: Mapping[str, Array | bytes], planes: Mapping[str, object]
) -> list[str]:
    """Write files and the plane table of a scene, without changing files of other origin.

    Files of an earlier call, as listed in ``planes.json``, are replaced, and its arrays that this
    call does not write are removed. All files are complete before the first one appears.

    Args:
        target: Folder of the scene; created if missing.
        contents: Bytes, or arrays to write as ``.npy``, by path relative to ``target``.
        planes: The plane table.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If a file of other origin would be overwritten, or a folder is not writable.
    """
    paths = {name: Path(os.path.normpath(target / name)) for name in contents}
    torchrg_files = _torchrg_files(target, contents)
    # Files of another layout are kept and remain listed.
    other_files = [name for name in _read_written(target) if "/" in name and name not in contents]
    for name, path in paths.items():
        if name not in torchrg_files and os.path.lexists(path):
            raise FormatError(
                f"{path}: was not written by torchrg for this scan; move it, or choose another "
                "directory."
            )
    for folder in {target, *(path.parent for path in paths.values())}:
        create_folder(folder)
    for name in torchrg_files - set(contents) - set(_protected.get()):
        (target / name).unlink(missing_ok=True)
    with ExitStack() as stack:
        # Files are renamed in reverse order: the plane table first, the coordinates last.
        for name, content in contents.items():
            temporary = stack.enter_context(atomic_path(paths[name], within=target))
            with temporary.open("wb") as stream:
                if isinstance(content, bytes):
                    stream.write(content)
                else:
                    npy_format.write_array(stream, content, allow_pickle=False)
        claim = stack.enter_context(atomic_path(target / PLANES_FILE))
        written = [name.removesuffix(".npy") if "/" not in name else name for name in contents]
        written += other_files
        claim.write_text(json.dumps({"written": written, **planes}, indent=1), encoding="utf-8")
    return [*contents, PLANES_FILE]


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
            arrays[name] = _to_int16(values).reshape(len(values), -1)
        elif name == "color":
            arrays[name] = narrow_colors(read_colors(target / "color.npy", values)[0])
        elif name in _FEATURES:
            arrays[name] = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
        else:
            arrays[name] = np.ascontiguousarray(values, dtypes.get(name, np.float32))
    return arrays


def _to_int16(labels: Array) -> Array:
    """Convert labels to int16, or to int32 if they do not fit."""
    limits = np.iinfo(np.int16)
    fit = labels.size == 0 or (labels.min() >= limits.min and labels.max() <= limits.max)
    return labels.astype(np.int16 if fit else np.int32)


def written_files(target: Path) -> list[str]:
    """Return the files that torchrg wrote for a scene, relative to its folder.

    Raises:
        FormatError: If ``planes.json`` was written by another program.
    """
    names = _read_written(target)
    return [name if "/" in name else f"{name}.npy" for name in names] + [PLANES_FILE] * bool(names)


def _torchrg_files(target: Path, other_files: Collection[str] = ()) -> set[str]:
    """Return the files that torchrg wrote here: arrays, and the files in ``other_files``."""
    names = {name if name in other_files else f"{name}.npy" for name in _read_written(target)}
    return names & {*(f"{name}.npy" for name in POINT_ARRAYS), *other_files}


def _read_written(target: Path) -> list[str]:
    """Return the names of written files listed in ``planes.json``."""
    try:
        written = json.loads((target / PLANES_FILE).read_text(encoding="utf-8"))["written"]
        return sorted(map(str, set(written)))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except (OSError, *PARSE_ERRORS) as error:
        raise FormatError(
            f"{target / PLANES_FILE}: expected a plane table written by torchrg, got another file; "
            "move it."
        ) from error


def _check_inputs(target: Path, arrays: Mapping[str, Array], inputs: set[str]) -> None:
    """Check that existing input files match the points to write."""
    for name in sorted(inputs):
        path = target / f"{name}.npy"
        values = map_array(path)
        check_rows(path, values, arrays[name].shape[:1])
        if name == "coord" and not np.array_equal(values.astype(np.float32), arrays[name]):
            raise FormatError(
                f"{path}: expected the points of this scene, got others; write to another folder."
            )
