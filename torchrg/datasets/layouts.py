"""Superpoints and planes of a scan in the files that networks on superpoints load.

:data:`LAYOUTS` has a function for each family of programs. It returns the files of one scan by
their paths below the output directory; :func:`write_layout` puts them there. Superpoints are int64
everywhere, as programs that read raw bytes take them for such.
"""

import io
import json
import pickle
import pickletools
import re
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg.datasets.pointcept import write_files
from torchrg.datasets.scannet import NYU_IDS
from torchrg.errors import FormatError
from torchrg.result import describe_planes
from torchrg.structures import Cloud, Planes

Files = dict[str, NDArray[Any] | bytes]
"""Contents by paths below the output directory: arrays as ``.npy``, or bytes."""
_IGNORED = -100
"""Label that SPFormer and ISBNet pass over."""
_STUFF = 2
"""Classes of ScanNet below this number, wall and floor, are no objects."""
_CENTERED = 127.5
"""Half of the largest colour: what SPFormer and ISBNet divide colours by before they take off 1."""
_SPLITS = {"train": "train", "val": "validation", "test": "test"}
"""Names of splits in Mask3D."""


@dataclass(frozen=True)
class LayoutScan:
    """One scan as layouts take it.

    Attributes:
        name: What its files are called.
        split: ``train``, ``val`` or ``test``.
        folder: Where it is in its own data set, which some programs keep.
        coord: Coordinates, shape ``(N, 3)``, float32.
        normal: Unit normals, shape ``(N, 3)``.
        superpoint: Superpoint of each point, shape ``(N,)``.
        plane: Plane of each point, -1 for none, shape ``(N,)``.
        given: What else is known: ``color`` ``(N, 3)`` uint8; ``segment20`` or ``segment``, the
            class of each point, -1 for none, ``category``, its number in NYU40, 0 for none, and
            ``instance``, its object, -1 for none, each ``(N,)``; ``axis_align_matrix`` ``(4, 4)``.
    """

    name: str
    split: str
    folder: str
    coord: NDArray[np.float32]
    normal: NDArray[np.floating]
    superpoint: NDArray[np.integer]
    plane: NDArray[np.integer]
    given: Mapping[str, NDArray[Any]]

    @property
    def color(self) -> NDArray[np.uint8]:
        """Colours, black where there are none."""
        return self.given.get("color", np.zeros(self.coord.shape, np.uint8))

    @property
    def truth(self) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Class and object of each point; None where they are not known."""
        segment = self.given.get("segment20", self.given.get("segment"))
        if segment is None or "instance" not in self.given:
            return None
        segment, instance = (
            labels.reshape(len(labels), -1)[:, 0].astype(np.int64)
            for labels in (segment, self.given["instance"])
        )
        return segment, instance

    @property
    def category(self) -> NDArray[np.int64]:
        """Category of each point, 0 for none; of other data than ScanNet the class and one."""
        known = self.given.get("category")
        if known is None:
            truth = self.truth
            return np.zeros(len(self.coord), np.int64) if truth is None else truth[0] + 1
        return known.astype(np.int64)


def write_layout(
    layout: str, place: Path, out: Path, scan: LayoutScan, planes: Planes, origin: NDArray[Any]
) -> list[str]:
    """Write the files of a scan in a layout, and ``planes.json`` in a folder of the scan.

    Args:
        layout: A key of :data:`LAYOUTS`.
        place: The folder of the scan, below ``out``.
        out: The output directory.
        scan: The scan.
        planes: Its plane table.
        origin: Where the origin of the table is; see :func:`torchrg.result.describe_planes`.

    Returns:
        Names of the files written, as paths from ``place``.

    Raises:
        FormatError: If some points are not finite, which these programs do not expect, or a file
            from elsewhere is in the way.
    """
    num_bad = int(np.count_nonzero(scan.superpoint < 0))
    if num_bad:
        raise FormatError(
            f"{place}: expected finite points for layout {layout}, got {num_bad:,} of "
            f"{len(scan.coord):,} that are not; remove them, or choose layout pointcept."
        )
    up = "../" * len(place.relative_to(out).parts)
    contents = {f"{up}{path}": content for path, content in LAYOUTS[layout](scan).items()}
    return write_files(place, contents, describe_planes(planes, origin=origin.tolist()))


def layout_scan(
    cloud: Cloud,
    name: str,
    folder: str,
    superpoint: NDArray[np.integer],
    labels: NDArray[np.integer],
    normals: NDArray[np.floating],
    given: Mapping[str, NDArray[Any]],
) -> LayoutScan:
    """Return a scan for layouts from a cloud and what was found about it.

    ``name`` is its place in a data set. What comes before the last slash is the split if it is
    called so; else the name is all of it, and the split is ``test`` without ``instance``, or else
    ``train``. ``folder`` is where it was found.
    """
    head, _, tail = name.rpartition("/")
    is_split = head in _SPLITS
    split = head if is_split else ("train" if "instance" in given else "test")
    flat = tail if is_split else name.replace("/", "_")
    points = cloud.points.numpy()
    return LayoutScan(flat, split, folder, points, normals, superpoint, labels, given)


def _scannet(scan: LayoutScan) -> Files:
    """ScanNet's own: superpoints as its Segmentator writes segments."""
    return {
        f"{scan.folder}/{scan.name}_vh_clean_2.0.010000.segs.json": _segments(
            scan, scan.superpoint
        ),
        f"{scan.folder}/{scan.name}_vh_clean_2.planes.segs.json": _segments(scan, scan.plane),
    }


def _segments(scan: LayoutScan, labels: NDArray[np.integer]) -> bytes:
    """Return labels as the JSON of segments."""
    content = {"params": {}, "sceneId": scan.name, "segIndices": labels.tolist()}
    return json.dumps(content, separators=(",", ":")).encode()


def _mmdet3d(scan: LayoutScan) -> Files:
    """MMDetection3D: what its ``create_data`` reads, and what its loaders read after that."""
    vertices = np.hstack([scan.coord, scan.color.astype(np.float32)])
    superpoint = scan.superpoint.astype(np.int64)
    first = f"scannet_instance_data/{scan.name}"
    files: Files = {
        f"{first}_vert.npy": vertices,
        f"{first}_sp_label.npy": superpoint,
        f"{first}_plane.npy": scan.plane.astype(np.int64),
        f"points/{scan.name}.bin": vertices.tobytes(),
        f"super_points/{scan.name}.bin": superpoint.tobytes(),
    }
    if scan.truth is None:
        return files
    # Objects are counted from one there.
    category, instance = scan.category, scan.truth[1] + 1
    matrix = scan.given.get("axis_align_matrix", np.eye(4))
    files |= {
        f"{first}_sem_label.npy": category,
        f"{first}_ins_label.npy": instance,
        f"{first}_axis_align_matrix.npy": matrix,
        f"{first}_unaligned_bbox.npy": _boxes(scan.coord, category, instance),
        f"{first}_aligned_bbox.npy": _boxes(
            scan.coord @ matrix[:3, :3].T + matrix[:3, 3], category, instance
        ),
        f"semantic_mask/{scan.name}.bin": category.tobytes(),
        f"instance_mask/{scan.name}.bin": instance.tobytes(),
    }
    return files


def _boxes(
    coord: NDArray[np.floating], category: NDArray[np.int64], instance: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return middle, sides and category of each object of the benchmark, shape ``(K, 7)``."""
    rows = []
    for number in np.unique(instance[np.isin(category, NYU_IDS[_STUFF:]) & (instance > 0)]):
        inside = instance == number
        low, high = coord[inside].min(axis=0), coord[inside].max(axis=0)
        kinds, counts = np.unique(category[inside], return_counts=True)
        rows.append([*(low + high) / 2, *(high - low), kinds[counts.argmax()]])
    boxes = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return boxes[np.isin(boxes[:, 6], NYU_IDS[_STUFF:])]


def _spformer(scan: LayoutScan) -> Files:
    """SPFormer: a tuple with the superpoints in the middle."""
    coord, color, *truth = _centered(scan)
    content = (coord, color, scan.superpoint.astype(np.int64), *truth)
    return {
        f"{scan.split}/{scan.name}_inst_nostuff.pth": _pickled(content),
        f"planes/{scan.name}.pth": _pickled(scan.plane.astype(np.int64)),
    }


def _isbnet(scan: LayoutScan) -> Files:
    """ISBNet and those after it: a tuple, and the superpoints in a file of their own."""
    return {
        f"{scan.split}/{scan.name}_inst_nostuff.pth": _pickled(_centered(scan)),
        f"superpoints/{scan.name}.pth": _pickled(scan.superpoint.astype(np.int64)),
        f"planes/{scan.name}.pth": _pickled(scan.plane.astype(np.int64)),
    }


def _centered(scan: LayoutScan) -> tuple[NDArray[Any], ...]:
    """Return coordinates about their mean, colours in [-1, 1], and classes and objects if known."""
    mean = scan.coord.mean(axis=0, dtype=np.float64)
    coord = (scan.coord - mean).astype(np.float32)
    color = (scan.color / _CENTERED - 1).astype(np.float32)
    if scan.truth is None:
        return coord, color
    segment, instance = scan.truth
    is_object = (instance >= 0) & ((segment < 0) | (segment >= _STUFF))
    objects = np.full(len(segment), _IGNORED, dtype=np.float64)
    objects[is_object] = np.unique(instance[is_object], return_inverse=True)[1].reshape(-1)
    return coord, color, np.where(segment < 0, _IGNORED, segment).astype(np.float64), objects


def _mask3d(scan: LayoutScan) -> Files:
    """Mask3D: one array of all columns; superpoints are the tenth."""
    split, match = _SPLITS[scan.split], re.fullmatch(r"scene(\d{4}_\d{2})", scan.name)
    name = match[1] if match else scan.name
    columns: list[NDArray[Any]] = [scan.coord, scan.color, scan.normal, scan.superpoint[:, None]]
    files: Files = {f"planes/{scan.name}.npy": scan.plane.astype(np.int64)}
    if scan.truth is not None:
        category, instance = scan.category, scan.truth[1]
        columns += [category[:, None], instance[:, None]]
        lines = "".join(f"{number}\n" for number in category * 1000 + instance + 1)
        files[f"instance_gt/{split}/{scan.name}.txt"] = lines.encode()
    return {f"{split}/{name}.npy": np.hstack([c.astype(np.float32) for c in columns]), **files}


def _npy(scan: LayoutScan) -> Files:
    """A folder of bare arrays, as GrowSP and others keep superpoints."""
    return {
        f"superpoints/{scan.name}.npy": scan.superpoint.astype(np.int64),
        f"planes/{scan.name}.npy": scan.plane.astype(np.int64),
    }


LAYOUTS: dict[str, Callable[[LayoutScan], Files]] = {
    "scannet": _scannet,
    "mmdet3d": _mmdet3d,
    "spformer": _spformer,
    "isbnet": _isbnet,
    "mask3d": _mask3d,
    "npy": _npy,
}
"""What returns the files of a scan, by the name of the layout."""


def _pickled(content: Any) -> bytes:  # noqa: ANN401
    """Return what ``torch.save`` writes, as NumPy 1 can read it too."""
    with io.BytesIO() as stream:
        torch.save(content, stream, pickle_module=_OLD_PICKLE)
        return stream.getvalue()


class _OldPickler(pickle.Pickler):
    """Writes the name that the module of arrays had before NumPy 2, and has there still."""

    def __init__(self, file: io.BytesIO, protocol: int) -> None:
        self._file, self._memory = file, io.BytesIO()
        super().__init__(self._memory, protocol)

    def dump(self, obj: Any) -> None:  # noqa: ANN401
        """Write an object."""
        super().dump(obj)
        self._file.write(_with_old_names(self._memory.getvalue()))


_OLD_PICKLE = types.ModuleType("pickle")
_OLD_PICKLE.Pickler = _OldPickler  # type: ignore[attr-defined]


def _with_old_names(pickled: bytes) -> bytes:
    r"""Return a pickle of protocol 2 with the names of NumPy's modules before version 2.

    Example:
        >>> _with_old_names(b"cnumpy._core.multiarray\n_reconstruct\n.")
        b'cnumpy.core.multiarray\n_reconstruct\n.'
    """
    parts, start, new = [], 0, b"numpy._core."
    for opcode, argument, place in pickletools.genops(pickled):
        if opcode.name == "GLOBAL" and str(argument).startswith(new.decode()) and place is not None:
            parts += [pickled[start : place + 1], b"numpy.core."]
            start = place + 1 + len(new)
    return b"".join([*parts, pickled[start:]])
