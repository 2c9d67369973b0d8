"""Superpoints and planes of a scan in the files that networks on superpoints load.

:data:`LAYOUTS` has a function for each family of programs and each data set that they read. It
returns the files of one scan by their paths below the output directory; :func:`write_layout` puts
them there, and :mod:`torchrg.datasets.lists` lists them where a program has lists. Superpoints are
int64 everywhere, as programs that read raw bytes take them for such.
"""

import io
import json
import pickle
import pickletools
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._optional import require
from torchrg.datasets.folder import SceneFiles
from torchrg.datasets.nag import encode_nag, make_nag
from torchrg.datasets.pointcept import write_files, write_pointcept_scene, write_results
from torchrg.datasets.s3dis import CLASS_ORDERS
from torchrg.datasets.scannet import NYU_IDS, read_objects
from torchrg.errors import ConfigError, FormatError
from torchrg.io.colors import narrow_colors
from torchrg.io.files import folded_name
from torchrg.plane_table import describe_planes
from torchrg.structures import UNLABELED, Cloud, Planes, Segmentation, Superpoints

Files = dict[str, NDArray[Any] | bytes]
"""Contents by paths below the output directory: arrays as ``.npy``, or bytes."""
_IGNORED = -100
"""Label that SPFormer and ISBNet pass over."""
_STUFF = 2
"""Classes of ScanNet below this number, wall and floor, are no objects."""
_CENTERED = 127.5
"""Half of the largest colour: what SPFormer and ISBNet divide colours by before they take off 1."""
MODES = {"train": "train", "val": "validation", "test": "test"}
"""Names of splits in Mask3D."""
_MAX_OBJECTS = 999
"""Objects that a scan may have in Mask3D, whose ground truth is the class in thousands and the
number of the object, counted from one."""
_EXACT = 2**24
"""Largest number up to which float32 holds every whole one."""
_S3DIS_FOLDER = "Stanford3dDataset_v1.2_Aligned_Version"
"""Folder in which MMDetection3D looks for the names of the rooms."""
VERSION = 2
"""To be raised when a layout gets other files, so that scans with the old ones are done again."""


@dataclass(frozen=True)
class LayoutScan:
    """One scan as layouts take it.

    Attributes:
        name: What its files are called.
        listed: ``train``, ``val`` or ``test``, or nothing where the data set does not say.
        folder: Where it is in its own data set, which some programs keep.
        dataset: The data set whose classes and objects it has, a key of a row of :data:`LAYOUTS`;
            ``"ScanNet"`` without any.
        coord: Coordinates, shape ``(N, 3)``, float32.
        normal: Unit normals, shape ``(N, 3)``.
        superpoint: Superpoint of each point, shape ``(N,)``.
        plane: Plane of each point, -1 for none, shape ``(N,)``.
        given: What else is known: ``color`` ``(N, 3)`` uint8; ``segment20`` or ``segment``, the
            class of each point, -1 for none, ``category``, its number in NYU40, 0 for none, and
            ``instance``, its object, -1 for none, each ``(N,)``; ``axis_align_matrix`` ``(4, 4)``.
        objects: What :func:`torchrg.datasets.scannet.read_objects` returns; None if unknown.
        coarser: Coarser levels of superpoints, each shape ``(N,)``.
    """

    name: str
    listed: str
    folder: str
    dataset: str
    coord: NDArray[np.float32]
    normal: NDArray[np.floating]
    superpoint: NDArray[np.integer]
    plane: NDArray[np.integer]
    given: Mapping[str, NDArray[Any]]
    objects: Sequence[tuple[Mapping[str, Any], NDArray[np.integer]]] | None = None
    coarser: Sequence[NDArray[np.integer]] = ()

    @property
    def split(self) -> str:
        """One of ``train``, ``val`` and ``test``: those without labels are of the test."""
        return self.listed or ("test" if self.truth is None else "train")

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
        """Number in NYU40 of the class of each point of ScanNet, 0 for none."""
        if "category" in self.given or self.truth is None:
            return self.given.get("category", np.zeros(len(self.coord))).astype(np.int64)
        return np.array([*NYU_IDS, 0])[self.truth[0]]


def split_name(name: str) -> tuple[str, str]:
    """Return the split that the name of a scan begins with, if any, and the name of its files.

    Example:
        >>> split_name("val/scene0011_00"), split_name("Area_1/office_1")
        (('val', 'scene0011_00'), ('', 'Area_1_office_1'))
    """
    head, _, tail = name.rpartition("/")
    return (head, tail) if head in MODES else ("", name.replace("/", "_"))


def stem_of(layout: str, name: str, folder: str) -> str:
    """Return what no two scans may have in common in a layout, as their files would be the same.

    ``name`` is that of the scan in its data set, and ``folder`` where it is there.
    """
    if layout == "scannet":
        return folder
    _, stem = split_name(name)
    return _short(stem) if layout == "mask3d" else stem


def check_layout(layout: str, dataset: str, what: str) -> None:
    """Raise if a layout has no form for a data set, called ``what``, or no package to write it."""
    layouts = [name for name, forms in LAYOUTS.items() if dataset in forms]
    if layout not in ("pointcept", *layouts):
        raise ConfigError(
            f"expected --layout to be one of pointcept, {', '.join(layouts)} for {what}, got "
            f"{layout}, whose programs do not know its classes; choose another."
        )
    if layout == "nag":
        require("h5py", extra="nag", purpose="write layout nag")


def check_stems(layout: str, places: Mapping[str, str]) -> None:
    """Raise FormatError if a scan would write into the files of another in a layout.

    ``places`` says where each scan is in its data set, by its name.
    """
    taken: dict[str, str] = {}
    for name, place in places.items() if layout != "pointcept" else ():
        stem = stem_of(layout, name, place)
        other = taken.setdefault(folded_name(stem), name)
        if other != name:
            raise FormatError(
                f"expected files of its own for each scan, got {stem} for {other} and {name} in "
                f"layout {layout}; rename one, or choose layout pointcept."
            )


def note_on_origin(layout: str, cloud: Cloud) -> tuple[str, ...]:
    """Return what a user should know of the coordinates of a cloud in a layout."""
    if layout == "pointcept" or not cloud.origin.any():
        return ()
    place = " ".join(f"{value:.12g}" for value in cloud.origin)
    return (f"coordinates are written about {place}, as they are far from the origin",)


def write_scan(
    layout: str,
    scene: SceneFiles,
    folder: Path,
    cloud: Cloud,
    seg: Segmentation,
    superpoints: Superpoints | None,
    *,
    level: int = 0,
) -> list[str]:
    """Write a scene in a layout, into the folder of its name; return the paths of files from there.

    Every layout but ``"pointcept"`` needs superpoints, of which it takes one ``level``. Colors of
    16 bits are rounded to 8, which is what readers of layouts expect.
    """
    if "color" in cloud.fields:
        color = narrow_colors(cloud.fields["color"])
        cloud = replace(cloud, fields={**cloud.fields, "color": color})
    levels = [] if superpoints is None else [*superpoints.by_level().values()][level:]
    superpoint = levels[0] if levels else None
    if layout == "pointcept" or superpoint is None:
        origin = cloud.origin.tolist()
        if scene.dataset is not None:
            sample = {**cloud.fields, "coord": cloud.coordinates}
            return write_pointcept_scene(folder, sample, seg, superpoint=superpoint, origin=origin)
        fields = {name: cloud.fields[name] for name in cloud.fields.keys() & {"color"}}
        fields |= {} if superpoint is None else {"superpoint": superpoint}
        return write_results(folder, cloud.coordinates, seg, fields=fields, origin=origin)
    split, stem = split_name(scene.name)
    is_known = scene.dataset is not None
    objects = None
    if layout == "scannet" and scene.dataset == "ScanNet" and scene.path.is_file():
        objects = read_objects(scene.path, len(cloud))
    given = {**cloud.fields, **cloud.header} if is_known else cloud.fields
    scan = LayoutScan(
        stem,
        split,
        folder=scene.place or scene.name,
        dataset=scene.dataset if scene.dataset is not None else "ScanNet",
        coord=cloud.points.numpy(),
        normal=seg.normals.numpy(),
        superpoint=superpoint,
        plane=seg.labels.numpy(),
        given={k: np.asarray(v) for k, v in given.items() if is_known or k == "color"},
        objects=objects,
        coarser=levels[1:],
    )
    out = folder.parents[scene.name.count("/")]
    return write_layout(layout, folder, out, scan, seg.planes, cloud.origin)


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
    files = LAYOUTS[layout][scan.dataset](scan)
    contents = {f"{up}{path}": content for path, content in files.items()}
    return write_files(place, contents, describe_planes(planes, origin=origin.tolist()))


def _scannet(scan: LayoutScan) -> Files:
    """ScanNet's own: superpoints as its Segmentator writes segments, and its objects by them."""
    first = f"{scan.folder}/{scan.name}_vh_clean_2"
    if scan.dataset == "ScanNet++":
        first = f"{scan.folder}/mesh_aligned_0.05"
    files: Files = {f"{first}.planes.segs.json": _segments(scan, scan.plane)}
    parts = scan.superpoint
    if scan.objects is not None:
        # The release numbers segments by vertices. Beyond these, a file of the one beside a file of
        # the other has no objects, and not wrong ones.
        parts = len(scan.coord) + _cut(scan.superpoint, [rows for _, rows in scan.objects])
        content = {
            "sceneId": f"scannet.{scan.name}",
            "appId": "torchrg",
            "segGroups": [
                {**entry, "segments": np.unique(parts[rows]).tolist()}
                for entry, rows in scan.objects
            ],
            "segmentsFile": f"scannet.{scan.name}_vh_clean_2.0.010000.segs.json",
        }
        files[f"{scan.folder}/{scan.name}.aggregation.json"] = _json(content)
    return {f"{first}.0.010000.segs.json": _segments(scan, parts), **files}


def _cut(
    superpoint: NDArray[np.integer], objects: Sequence[NDArray[np.integer]]
) -> NDArray[np.int64]:
    """Return superpoints of which each is in an object as a whole, or not at all.

    Objects may overlap, as the release has segments that two of them name.

    Example:
        >>> _cut(np.array([0, 0, 0, 1, 1]), [np.array([0, 1]), np.array([1, 3])]).tolist()
        [2, 4, 0, 3, 1]
    """
    parts = superpoint.astype(np.int64)
    for rows in objects:
        parts[rows] = parts.max(initial=0) + 1 + np.unique(parts[rows], return_inverse=True)[1]
    return np.unique(parts, return_inverse=True)[1].reshape(-1)


def _segments(scan: LayoutScan, labels: NDArray[np.integer]) -> bytes:
    """Return labels as the JSON of segments."""
    return _json({"params": {}, "sceneId": scan.name, "segIndices": labels.tolist()})


def _json(content: Any) -> bytes:  # noqa: ANN401
    """Return an object as JSON without blanks."""
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
    if scan.truth is not None or scan.split == "test":
        files[f"meta_data/scannetv2_{scan.split}/{scan.name}.json"] = _json({"name": scan.name})
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


def _mmdet3d_s3dis(scan: LayoutScan) -> Files:
    """MMDetection3D: S3DIS about the corner of its room, classes and objects of all points."""
    low = scan.coord.min(axis=0).astype(np.float64)
    points = np.hstack([scan.coord - low, scan.color]).astype(np.float32)
    superpoint = scan.superpoint.astype(np.int64)
    segment, instance = _labels(scan)
    instance += 1
    first = f"s3dis_data/{scan.name}"
    return {
        f"{first}_point.npy": points,
        f"{first}_sem_label.npy": segment,
        f"{first}_ins_label.npy": instance,
        f"{_S3DIS_FOLDER}/{scan.folder}/plane.npy": scan.plane.astype(np.int64),
        f"points/{scan.name}.bin": points.tobytes(),
        f"super_points/{scan.name}.bin": superpoint.tobytes(),
        f"semantic_mask/{scan.name}.bin": segment.tobytes(),
        f"instance_mask/{scan.name}.bin": instance.tobytes(),
    }


def _labels(scan: LayoutScan) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return class and object of each point of S3DIS, in which no point is without."""
    if scan.truth is None:
        raise FormatError(f"{scan.name}: expected classes and objects of S3DIS, got none.")
    segment, instance = scan.truth
    return segment, np.unique(instance, return_inverse=True)[1].reshape(-1)


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


def _isbnet_s3dis(scan: LayoutScan) -> Files:
    """ISBNet's S3DIS: coordinates and colours as they are, and objects of all classes."""
    content = (scan.coord, scan.color.astype(np.float32), *_labels(scan))
    return {
        f"preprocess/{scan.name}_inst_nostuff.pth": _pickled(content),
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
    """Mask3D: a scan of ScanNet, whose classes are categories of NYU40."""
    labels = None if scan.truth is None else (scan.category, scan.truth[1])
    # Mask3D knows a scan by the folder of its mesh.
    entry = {"scene": scan.name, "raw_filepath": f"{scan.name}/{scan.name}_vh_clean_2.ply"}
    places = f"{MODES[scan.split]}/{_short(scan.name)}", f"{MODES[scan.split]}/{scan.name}"
    return _mask3d_files(scan, *places, labels, entry, first_class=0)


def _mask3d_s3dis(scan: LayoutScan) -> Files:
    """Mask3D: a room of S3DIS, whose classes are counted from one in the ground truth."""
    area, room = scan.folder.split("/")
    entry = {"scene": room, "area": area, "raw_filepath": scan.folder}
    return _mask3d_files(scan, scan.folder, scan.folder, _labels(scan), entry, first_class=1)


def _mask3d_files(
    scan: LayoutScan,
    place: str,
    truth_place: str,
    labels: tuple[NDArray[np.int64], NDArray[np.int64]] | None,
    entry: Mapping[str, Any],
    first_class: int,
) -> Files:
    """One array of all columns, superpoints the tenth; the ground truth; the entry of its list."""
    mode, _, name = place.partition("/")
    color = scan.color.astype(np.int64)
    num_values = 255 * max(len(color), 1)
    entry = {
        "filepath": f"{place}.npy",
        "file_len": len(color),
        "color_mean": (color.sum(axis=0) / num_values).tolist(),
        "color_std": ((color**2).sum(axis=0) / (255 * num_values)).tolist(),
        **entry,
    }
    files: Files = {f"planes/{scan.name}.npy": scan.plane.astype(np.int64)}
    _check_numbers(scan, "superpoints", scan.superpoint, 0, _EXACT)
    columns: list[NDArray[Any]] = [scan.coord, scan.color, scan.normal, scan.superpoint[:, None]]
    if labels is not None:
        category, instance = labels
        _check_numbers(scan, "numbers of classes", category, 0, _EXACT)
        _check_numbers(scan, "numbers of objects", instance, -1, _MAX_OBJECTS)
        columns += [category[:, None], instance[:, None]]
        truth = (category + first_class) * 1000 + instance + 1
        entry["instance_gt_filepath"] = path = f"instance_gt/{truth_place}.txt"
        files[path] = "".join(f"{number}\n" for number in truth).encode()
    if labels is not None or mode == "test":
        files[f"{mode}_database/{name}.json"] = _json(entry)
    return {f"{place}.npy": np.hstack([c.astype(np.float32) for c in columns]), **files}


def _check_numbers(
    scan: LayoutScan, what: str, numbers: NDArray[np.integer], least: int, end: int
) -> None:
    """Refuse numbers that Mask3D would read as others."""
    bad = numbers[(numbers < least) | (numbers >= end)]
    if len(bad):
        raise FormatError(
            f"{scan.name}: expected {what} from {least} to {end - 1:,} for layout mask3d, whose "
            f"files hold no others, got {bad[0]:,}; choose another layout."
        )


def _short(name: str) -> str:
    """Return the name of a scan in Mask3D, which leaves out the first word of ScanNet's."""
    return re.sub(r"^scene(?=[0-9]{4}_[0-9]{2}$)", "", name)


def _npy(scan: LayoutScan) -> Files:
    """A folder of bare arrays, as GrowSP and others keep superpoints."""
    return {
        f"superpoints/{scan.name}.npy": scan.superpoint.astype(np.int64),
        f"planes/{scan.name}.npy": scan.plane.astype(np.int64),
    }


def _nag(scan: LayoutScan) -> Files:
    """Superpoint Transformer: the points and all levels above them, with counts of its classes."""
    values: dict[str, Any] = {"rgb": scan.color, "normal": scan.normal}
    numbers = _NAG_CLASSES.get(scan.dataset)
    if scan.truth is not None and numbers is not None:
        # The last column is of points without a class.
        one_hot = np.eye(len(numbers), dtype=np.int64)[numbers]
        values["y"] = one_hot[np.where(scan.truth[0] < 0, len(numbers) - 1, scan.truth[0])]
    fine, *coarse = (torch.from_numpy(level).long() for level in (scan.superpoint, *scan.coarser))
    parts = Superpoints(fine, torch.full((int(fine.max()) + 1,), UNLABELED), tuple(coarse))
    levels = make_nag(scan.coord, parts, data=dict, **values)
    return {f"{scan.listed or 'nag'}/{scan.name}.h5": encode_nag(levels)}


_NAG_CLASSES = {
    "ScanNet": [*range(len(NYU_IDS) + 1)],
    "S3DIS": [*map(CLASS_ORDERS["spt"].index, CLASS_ORDERS["pointcept"]), 13],
}
"""Numbers of classes in Superpoint Transformer, and of none, by those of the data set."""


LAYOUTS: dict[str, dict[str, Callable[[LayoutScan], Files]]] = {
    "scannet": dict.fromkeys(("ScanNet", "ScanNet++", ""), _scannet),
    "mmdet3d": {"ScanNet": _mmdet3d, "S3DIS": _mmdet3d_s3dis},
    "spformer": {"ScanNet": _spformer},
    "isbnet": {"ScanNet": _isbnet, "S3DIS": _isbnet_s3dis},
    "mask3d": {"ScanNet": _mask3d, "S3DIS": _mask3d_s3dis},
    "nag": dict.fromkeys(("ScanNet", "ScanNet++", "S3DIS", ""), _nag),
    "npy": dict.fromkeys(("ScanNet", "ScanNet++", "S3DIS", ""), _npy),
}
"""Functions for the files of a scan, by the layout and the data set. That without a name has
labels whose classes nobody knows. Clouds without labels are written as those of ScanNet."""


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
