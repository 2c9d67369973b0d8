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
import torch
from numpy.lib import format as npy_format
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import make_folder
from torchrg.io.npy import map_array
from torchrg.structures import PLANE_KINDS, Planes, Segmentation

POINT_ARRAYS = (
    "coord", "color", "normal", "strength", "segment", "instance",
    "superpoint", "plane", "curvature",
)  # fmt: skip
"""Arrays of a scene folder that have a row for each point."""
_LABELS = ("segment", "instance", "superpoint", "plane")
_FEATURES = ("strength", "curvature")
"""Arrays of numbers that have two axes in files, whatever they have elsewhere."""
_TABLE = "planes.json"


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
    paths = {name: Path(folder) / f"{name}.npy" for name in POINT_ARRAYS}
    if not paths["coord"].is_file():
        raise FormatError(f"{folder}: expected coord.npy in this folder, got none.")
    arrays = {name: map_array(path) for name, path in paths.items() if path.is_file()}
    if arrays["coord"].ndim != 2 or arrays["coord"].shape[1] != 3:
        raise FormatError(f"{paths['coord']}: expected shape (N, 3), got {arrays['coord'].shape}.")
    for name, values in arrays.items():
        _check_rows(paths[name], values, len(arrays["coord"]))
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
            :func:`describe_planes`. Default: ``coord`` is in the coordinates of the data set.

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
        claim = stack.enter_context(atomic_path(place / _TABLE))
        claim.write_text(json.dumps({"written": [*arrays], **planes}, indent=1), encoding="utf-8")
    return [*(f"{name}.npy" for name in arrays), _TABLE]


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

    def exact(values: Tensor) -> Tensor:
        return values.detach().cpu().double()

    columns = {"id": torch.arange(len(planes.normal)), **planes._asdict()}
    for name in ("kind", "outline", "adjacency"):
        del columns[name]
    columns["offset"] = exact(planes.offset) + exact(planes.normal) @ shift
    columns["centroid"] = exact(planes.centroid) + shift
    columns["center"] = exact(planes.center) + shift
    lists = {name: values.tolist() for name, values in columns.items()}
    if planes.kind is not None:
        lists["kind"] = [PLANE_KINDS[kind] for kind in planes.kind.tolist()]
    if planes.outline is not None:
        lists["outline"] = [
            [(exact(ring) + shift).tolist() for ring in rings] for rings in planes.outline
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
        _check_rows(place / f"{name}.npy", values, len(segmentation.labels))
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
        written = json.loads((place / _TABLE).read_text(encoding="utf-8"))["written"]
        return set(written) & set(POINT_ARRAYS)
    except (FileNotFoundError, NotADirectoryError):
        return set()
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise FormatError(
            f"{place / _TABLE}: expected a table of planes that torchrg wrote, got another file; "
            "move it away."
        ) from error


def _check_kept(place: Path, arrays: Mapping[str, NDArray[Any]], kept: set[str]) -> None:
    """Check that what stays in a folder belongs to the points that are written."""
    for name in sorted(kept):
        path = place / f"{name}.npy"
        values = map_array(path)
        _check_rows(path, values, len(arrays[name]))
        if name == "coord" and not np.array_equal(values.astype(np.float32), arrays[name]):
            raise FormatError(
                f"{path}: expected the points of this scene, got others; write to another folder."
            )


def _check_rows(path: Path, values: NDArray[Any], num_points: int) -> None:
    """Check that an array has a row for each point."""
    if values.shape[:1] != (num_points,):
        raise FormatError(f"{path}: expected {num_points} rows, got shape {values.shape}.")
