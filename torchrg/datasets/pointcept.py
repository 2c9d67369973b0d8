"""Scenes in Pointcept's processed layout: a folder of ``.npy`` files for each scene.

``coord`` float32, ``color`` uint8 and ``normal`` float32 of shape ``(N, 3)``; ``segment`` and
``instance`` int16 of shape ``(N, 1)``, of ScanNet++ ``(N, 3)``; of ScanNet ``segment20``,
``segment200`` and ``instance`` int64 of shape ``(N,)``. Beside them torchrg puts ``plane`` int32 of
shape ``(N,)``, ``curvature`` float32 of shape ``(N, 1)`` as Pointcept has features,
``planes.json``, and ``superpoint`` int32 where it is asked for. Pointcept reads the files it knows
and passes over the others; ``import torchrg.transforms.pointcept`` makes it know these.
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
from torchrg.io.files import DAMAGES, make_folder
from torchrg.io.npy import check_rows, map_array, map_folder
from torchrg.result import PLANES_FILE, describe_planes
from torchrg.structures import Array, Segmentation

POINT_ARRAYS = (
    "coord", "color", "normal", "strength", "segment", "segment20", "segment200", "instance",
    "superpoint", "plane", "curvature",
)  # fmt: skip
"""Arrays of a scene folder that have a row for each point."""
GIVEN_ARRAYS = POINT_ARRAYS[:8]
"""Those that come with the points."""
SOURCE_ARRAYS = tuple(name for name in GIVEN_ARRAYS if name != "normal")
"""Those of a scene that go along with results."""
_SCANNET = ("segment20", "segment200")
_LABELS = ("segment", *_SCANNET, "instance", "superpoint", "plane")
_FEATURES = ("strength", "curvature")
"""Arrays of numbers that have two axes in files, whatever they have elsewhere."""


_kept: ContextVar[Collection[str]] = ContextVar("_kept", default=())
"""Names of files that :func:`write_files` does not remove."""


@contextmanager
def keeping_files(names: Collection[str]) -> Iterator[None]:
    """Keep files of these names where :func:`write_files` would remove them, in this thread.

    A record has fingerprints, and tells so which files a user has changed.
    """
    token = _kept.set(names)
    try:
        yield
    finally:
        _kept.reset(token)


def read_pointcept_scene(folder: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Read a scene folder, whoever wrote it.

    Args:
        folder: A folder with ``coord.npy``.

    Returns:
        Those of :data:`POINT_ARRAYS` that are there; labels as int64 of shape ``(N,)``. The others
        are mapped from the files copy-on-write; ``curvature`` has shape ``(N,)``. Of points with
        several labels the first is taken.

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
    """Write a scene folder, or complete one that Pointcept wrote.

    What is there and was not written by this function is never changed: the arrays must have as
    many rows, and the coordinates must be those of the sample. What it wrote itself, as
    ``planes.json`` says, is replaced or removed. All files are complete before the first appears.

    Args:
        folder: The scene, ``OUT/Area_i/<room>``; it is made.
        sample: ``coord`` ``(N, 3)`` and any of ``color``, ``normal``, ``strength``, ``segment``,
            ``segment20``, ``segment200``, ``instance``, as tensors or arrays. Without ``normal``
            those of the segmentation are written.
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
    inputs = {
        name
        for name in arrays.keys() - {"plane", "curvature", "superpoint"}
        if f"{name}.npy" not in owned and (place / f"{name}.npy").exists()
    }
    _check_kept(place, arrays, inputs)
    new = {name: values for name, values in arrays.items() if name not in inputs}
    return write_arrays(place, new, describe_planes(segmentation.planes, origin=origin))


def write_results(
    folder: Path,
    coord: NDArray[np.floating],
    segmentation: Segmentation,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write ``coord``, ``normal``, ``curvature``, ``plane`` as ``.npy``, and ``planes.json``.

    Into a folder that exists; ``coord`` ``(*, 3)`` in the dtype to be written, the segmentation of
    the same leading axes, further ``fields`` by name. ``origin`` is where the origin of the
    segmentation is, in the coordinates of ``coord``. Returns the names of the files; those of
    others are never replaced, see :func:`torchrg.datasets.pointcept.write_arrays`.
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
    place: Path, arrays: Mapping[str, Array], planes: Mapping[str, object]
) -> list[str]:
    """Write arrays by name as ``.npy`` and the table of planes; see :func:`write_files`."""
    return write_files(place, {f"{name}.npy": values for name, values in arrays.items()}, planes)


def write_files(
    place: Path, contents: Mapping[str, Array | bytes], planes: Mapping[str, object]
) -> list[str]:
    """Write files and the table of planes of a scene, beside what others have there.

    What an earlier call wrote, as ``planes.json`` says, is replaced, and arrays that it wrote and
    this one does not are removed; nothing else is. All files are complete before the first appears.

    Args:
        place: Folder of the scene; it is made.
        contents: Bytes, or arrays to be written as ``.npy``, by their paths from there.
        planes: The table.

    Returns:
        Names of the files written.

    Raises:
        FormatError: If a file from elsewhere is in the way, or a folder cannot be written.
    """
    paths = {name: Path(os.path.normpath(place / name)) for name in contents}
    owned = _owned(place, contents)
    # Those of another layout stay, and are known again when it is asked for.
    others = [name for name in _written(place) if "/" in name and name not in contents]
    for name, path in paths.items():
        if name not in owned and os.path.lexists(path):
            raise FormatError(
                f"{path}: was not written by torchrg for this scan; move it away, or choose "
                "another directory."
            )
    for folder in {place, *(path.parent for path in paths.values())}:
        make_folder(folder)
    for name in owned - set(contents) - set(_kept.get()):
        (place / name).unlink(missing_ok=True)
    with ExitStack() as stack:
        # Files take their places in reverse: the claim on them first, the coordinates last.
        for name, content in contents.items():
            beside = stack.enter_context(atomic_path(paths[name], within=place))
            with beside.open("wb") as stream:
                if isinstance(content, bytes):
                    stream.write(content)
                else:
                    npy_format.write_array(stream, content, allow_pickle=False)
        claim = stack.enter_context(atomic_path(place / PLANES_FILE))
        written = [name.removesuffix(".npy") if "/" not in name else name for name in contents]
        written += others
        claim.write_text(json.dumps({"written": written, **planes}, indent=1), encoding="utf-8")
    return [*contents, PLANES_FILE]


def _arrays_of(
    place: Path,
    sample: Mapping[str, object],
    segmentation: Segmentation,
    *,
    superpoint: Tensor | NDArray[np.integer] | None,
) -> dict[str, Array]:
    """Return the arrays of a scene in Pointcept's types."""
    entries: dict[str, object] = {"normal": segmentation.normals}
    entries |= {name: sample[name] for name in GIVEN_ARRAYS if name in sample}
    entries |= {"plane": segmentation.labels, "curvature": segmentation.curvature}
    if superpoint is not None:
        entries["superpoint"] = superpoint
    dtypes = {"plane": np.int32, "superpoint": np.int32}
    arrays: dict[str, Array] = {}
    for name in (name for name in POINT_ARRAYS if name in entries):
        values = as_tensor("write_pointcept_scene", name, entries[name]).detach().cpu().numpy()
        check_rows(place / f"{name}.npy", values, segmentation.labels.shape)
        if name in _SCANNET or (name == "instance" and not entries.keys().isdisjoint(_SCANNET)):
            arrays[name] = values.astype(np.int64)
        elif name in ("segment", "instance"):
            arrays[name] = _short(values).reshape(len(values), -1)
        elif name == "color":
            arrays[name] = narrow_colors(read_colors(place / "color.npy", values)[0])
        elif name in _FEATURES:
            arrays[name] = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
        else:
            arrays[name] = np.ascontiguousarray(values, dtypes.get(name, np.float32))
    return arrays


def _short(labels: Array) -> Array:
    """Return labels as int16, or as int32 where they do not fit."""
    limits = np.iinfo(np.int16)
    fit = labels.size == 0 or (labels.min() >= limits.min and labels.max() <= limits.max)
    return labels.astype(np.int16 if fit else np.int32)


def written_files(place: Path) -> list[str]:
    """Return the files that torchrg wrote for a scene, as paths from its folder.

    Raises:
        FormatError: If ``planes.json`` is of another program.
    """
    names = _written(place)
    return [name if "/" in name else f"{name}.npy" for name in names] + [PLANES_FILE] * bool(names)


def _owned(place: Path, others: Collection[str] = ()) -> set[str]:
    """Return the files that torchrg wrote here: arrays, and those of others that it names."""
    names = {name if name in others else f"{name}.npy" for name in _written(place)}
    return names & {*(f"{name}.npy" for name in POINT_ARRAYS), *others}


def _written(place: Path) -> list[str]:
    """Return what ``planes.json`` says that torchrg wrote."""
    try:
        written = json.loads((place / PLANES_FILE).read_text(encoding="utf-8"))["written"]
        return sorted(map(str, set(written)))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except (OSError, *DAMAGES) as error:
        raise FormatError(
            f"{place / PLANES_FILE}: expected a table of planes that torchrg wrote, got another "
            "file; move it away."
        ) from error


def _check_kept(place: Path, arrays: Mapping[str, Array], inputs: set[str]) -> None:
    """Check that what stays in a folder belongs to the points that are written."""
    for name in sorted(inputs):
        path = place / f"{name}.npy"
        values = map_array(path)
        check_rows(path, values, arrays[name].shape[:1])
        if name == "coord" and not np.array_equal(values.astype(np.float32), arrays[name]):
            raise FormatError(
                f"{path}: expected the points of this scene, got others; write to another folder."
            )
