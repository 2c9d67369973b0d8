"""File layouts of superpoints and planes for superpoint networks.

:data:`LAYOUTS` has a function for each program family and data set. It returns the files of one
scan by path below the output directory; :func:`write_scan` writes them, and
:mod:`torchrg.datasets.lists` writes index files for programs that need them. Superpoints are int64
in every layout, because programs that read raw bytes expect that.
"""

import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from torchrg.io.files import normalize_file_name
from torchrg.io.plane_table import describe_planes
from torchrg.structures import UNLABELED, Cloud, Segmentation, Superpoints
from torchrg.structures.colors import narrow_colors

Files = dict[str, NDArray[Any] | bytes]
"""File contents by path below the output directory: arrays for ``.npy`` files, or bytes."""
_IGNORED = -100
"""Label that SPFormer and ISBNet ignore."""
_NUM_STUFF = 2
"""Number of leading ScanNet classes (wall, floor) that have no instances."""
_CENTERED = 127.5
"""Half the maximum color: SPFormer and ISBNet divide colors by it and subtract 1."""
SPLIT_NAMES = {"train": "train", "val": "validation", "test": "test"}
"""Mask3D's names of splits."""
_MAX_OBJECTS = 999
"""Maximum objects per scan in Mask3D: ground truth is 1000 times the class plus ID, from one."""
_MAX_EXACT = 2**24
"""Limit up to which float32 represents every integer."""
VERSION = 2
"""Layout version; increment it when files change, so that existing scans are converted again."""


@dataclass(frozen=True)
class LayoutScan:
    """Input of a layout: one scan.

    Attributes:
        name: Stem of its files.
        declared_split: ``train``, ``val`` or ``test``, empty if the data set defines no split.
        folder: Path in its own data set, which some programs keep.
        dataset: The data set of classes and objects, a key in :data:`LAYOUTS`, else ``"ScanNet"``.
        coord: Coordinates, shape ``(N, 3)``, float32.
        normal: Unit normals, shape ``(N, 3)``.
        superpoint: Superpoint of each point, shape ``(N,)``, int64.
        plane: Plane ID of each point, -1 for none, shape ``(N,)``, int64.
        inputs: Optional inputs: ``color`` ``(N, 3)`` uint8; ``segment20`` or ``segment``, the class
            of each point, -1 for none, ``category``, its NYU40 ID, 0 for none, and ``instance``,
            its object, -1 for none, each ``(N,)``; ``axis_align_matrix`` ``(4, 4)``.
        objects: Result of :func:`torchrg.datasets.scannet.read_objects`; None if unknown.
        coarser: Coarser levels of superpoints, each of shape ``(N,)``.
    """

    name: str
    declared_split: str
    folder: str
    dataset: str
    coord: NDArray[np.float32]
    normal: NDArray[np.floating]
    superpoint: NDArray[np.int64]
    plane: NDArray[np.int64]
    inputs: Mapping[str, NDArray[Any]]
    objects: Sequence[tuple[dict[str, Any], NDArray[np.integer]]] | None = None
    coarser: Sequence[NDArray[np.integer]] = ()

    @property
    def split(self) -> str:
        """``train``, ``val`` or ``test``; by default ``test`` for a scan without labels."""
        return self.declared_split or ("test" if self.ground_truth is None else "train")

    @property
    def color(self) -> NDArray[np.uint8]:
        """Colors; black if unknown."""
        return self.inputs.get("color", np.zeros(self.coord.shape, np.uint8))

    @property
    def ground_truth(self) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Class and object of each point; None if unknown."""
        segment = self.inputs.get("segment20", self.inputs.get("segment"))
        if segment is None or "instance" not in self.inputs:
            return None
        segment, instance = (
            labels.reshape(len(labels), -1)[:, 0].astype(np.int64)
            for labels in (segment, self.inputs["instance"])
        )
        return segment, instance

    @property
    def category(self) -> NDArray[np.int64]:
        """NYU40 ID of the class of each ScanNet point, 0 for none."""
        if "category" in self.inputs or self.ground_truth is None:
            return self.inputs.get("category", np.zeros(len(self.coord))).astype(np.int64)
        return np.array([*NYU_IDS, 0])[self.ground_truth[0]]


def split_name(name: str) -> tuple[str, str]:
    """Return the split in the name of a scan, if any, and the stem of its files."""
    head, _, tail = name.rpartition("/")
    return (head, tail) if head in SPLIT_NAMES else ("", name.replace("/", "_"))


def check_layout(layout: str, dataset: str, what: str) -> None:
    """Raise if a layout does not support a data set (``what``), or needs a missing package."""
    layouts = [name for name, forms in LAYOUTS.items() if dataset in forms]
    if layout not in ("pointcept", *layouts):
        raise ConfigError(
            f"expected --layout to be one of pointcept, {', '.join(layouts)} for {what}, got "
            f"{layout}, whose programs do not support its classes; choose another."
        )
    if layout == "nag":
        require("h5py", extra="nag", purpose="write layout nag")


def check_stems(layout: str, paths: Mapping[str, str]) -> None:
    """Raise FormatError if two scans would write the same files in a layout.

    ``paths`` contains the path of each scan in its data set, by name.
    """
    owners: dict[str, str] = {}
    for name, path in paths.items() if layout != "pointcept" else ():
        stem = path if layout == "scannet" else split_name(name)[1]
        stem = _mask3d_name(stem) if layout == "mask3d" else stem
        other = owners.setdefault(normalize_file_name(stem), name)
        if other != name:
            raise FormatError(f"layout {layout}: {other} and {name} both use {stem}; rename one.")


def note_on_origin(layout: str, cloud: Cloud) -> tuple[str, ...]:
    """Return a note if a layout shifts the coordinates of a cloud."""
    if layout == "pointcept" or not cloud.origin.any():
        return ()
    shift = " ".join(f"{value:.12g}" for value in cloud.origin)
    return (f"coordinates are written relative to {shift}, because they are far from the origin",)


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
    """Write a scene in a layout, and ``planes.json``; return paths relative to its folder.

    The folder has the name of the scene. Every layout except ``"pointcept"`` needs superpoints, and
    uses one ``level`` of them. 16-bit colors are rounded to 8 bits, as readers of layouts expect.

    Raises:
        FormatError: If some points are not finite, which programs other than Pointcept do not
            support, or a file of other origin would be overwritten.
    """
    fields: dict[str, Any] = {} if scene.dataset is None else {**cloud.fields}
    if "color" in cloud.fields:
        fields["color"] = narrow_colors(cloud.fields["color"])
    levels = [] if superpoints is None else [*superpoints.by_level().values()][level:]
    superpoint = levels[0] if levels else None
    if layout == "pointcept" or superpoint is None:
        origin = cloud.origin.tolist()
        if scene.dataset is not None:
            sample = {**fields, "coord": cloud.coordinates}
            return write_pointcept_scene(folder, sample, seg, superpoint=superpoint, origin=origin)
        fields |= {} if superpoint is None else {"superpoint": superpoint}
        # Labels of the images of a fused cloud.
        images = cloud.header.get("images", lambda labels: ())(seg.labels.int())
        fields |= {f"{name}/plane": image.numpy() for name, image in images}
        return write_results(folder, cloud.coordinates, seg, fields=fields, origin=origin)
    if num_bad := int(np.count_nonzero(superpoint < 0)):
        raise FormatError(
            f"{folder}: expected finite points for layout {layout}, got {num_bad:,} non-finite of "
            f"{len(cloud):,}; remove them, or choose layout pointcept."
        )
    split, stem = split_name(scene.name)
    objects = None
    if layout == "scannet" and scene.dataset == "ScanNet" and scene.path.is_file():
        objects = read_objects(scene.path, len(cloud))
    inputs = fields if scene.dataset is None else {**fields, **cloud.header}
    scan = LayoutScan(
        stem,
        split,
        folder=scene.release_path or scene.name,
        dataset=scene.dataset if scene.dataset is not None else "ScanNet",
        coord=cloud.points.numpy(),
        normal=seg.normals.numpy(),
        superpoint=superpoint.astype(np.int64),
        plane=seg.labels.numpy(),
        inputs={k: np.asarray(v) for k, v in inputs.items()},
        objects=objects,
        coarser=levels[1:],
    )
    # Layouts name files from the output directory.
    up = "../" * (scene.name.count("/") + 1)
    files = LAYOUTS[layout][scan.dataset](scan)
    contents = {f"{up}{path}": content for path, content in files.items()}
    table = describe_planes(seg.planes, origin=cloud.origin.tolist())
    return write_files(folder, contents, table)


def _scannet(scan: LayoutScan) -> Files:
    """Return ScanNet files: superpoints as Segmentator segments, and objects in terms of them."""
    prefix = f"{scan.folder}/{scan.name}_vh_clean_2"
    if scan.dataset == "ScanNet++":
        prefix = f"{scan.folder}/mesh_aligned_0.05"
    files: Files = {f"{prefix}.planes.segs.json": _segments(scan, scan.plane)}
    parts = scan.superpoint
    if scan.objects is not None:
        # The release numbers segments by vertices. Larger IDs ensure that mixing its files with
        # these yields no objects instead of wrong ones.
        parts = len(scan.coord) + _split(scan.superpoint, [rows for _, rows in scan.objects])
        groups = [entry | {"segments": np.unique(parts[r]).tolist()} for entry, r in scan.objects]
        content = {
            "sceneId": f"scannet.{scan.name}",
            "appId": "torchrg",
            "segGroups": groups,
            "segmentsFile": f"scannet.{scan.name}_vh_clean_2.0.010000.segs.json",
        }
        files[f"{scan.folder}/{scan.name}.aggregation.json"] = _json(content)
    return {f"{prefix}.0.010000.segs.json": _segments(scan, parts), **files}


def _split(
    superpoint: NDArray[np.integer], objects: Sequence[NDArray[np.integer]]
) -> NDArray[np.int64]:
    """Split superpoints so that each lies entirely inside or outside every object.

    Objects may overlap, because some segments of the release belong to two objects.
    """
    parts = superpoint.astype(np.int64)
    for rows in objects:
        parts[rows] = parts.max(initial=0) + 1 + np.unique(parts[rows], return_inverse=True)[1]
    return np.unique(parts, return_inverse=True)[1].reshape(-1)


def _segments(scan: LayoutScan, labels: NDArray[np.integer]) -> bytes:
    """Encode labels as a segments JSON."""
    return _json({"params": {}, "sceneId": scan.name, "segIndices": labels.tolist()})


def _json(content: Any) -> bytes:  # noqa: ANN401
    """Encode an object as compact JSON."""
    return json.dumps(content, separators=(",", ":")).encode()


def _mmdet3d(scan: LayoutScan) -> Files:
    """Return MMDetection3D files: the input of ``create_data``, and the input of its loaders."""
    vertices = np.hstack([scan.coord, scan.color.astype(np.float32)])
    prefix = f"scannet_instance_data/{scan.name}"
    files: Files = {
        f"{prefix}_vert.npy": vertices,
        f"{prefix}_sp_label.npy": scan.superpoint,
        f"{prefix}_plane.npy": scan.plane,
        f"points/{scan.name}.bin": vertices.tobytes(),
        f"super_points/{scan.name}.bin": scan.superpoint.tobytes(),
    }
    if scan.ground_truth is not None or scan.split == "test":
        files[f"meta_data/scannetv2_{scan.split}/{scan.name}.json"] = _json({"name": scan.name})
    if scan.ground_truth is None:
        return files
    # MMDetection3D counts objects from one.
    category, instance = scan.category, scan.ground_truth[1] + 1
    matrix = scan.inputs.get("axis_align_matrix", np.eye(4))
    aligned = scan.coord @ matrix[:3, :3].T + matrix[:3, 3]
    files |= {
        f"{prefix}_sem_label.npy": category,
        f"{prefix}_ins_label.npy": instance,
        f"{prefix}_axis_align_matrix.npy": matrix,
        f"{prefix}_unaligned_bbox.npy": _boxes(scan.coord, category, instance),
        f"{prefix}_aligned_bbox.npy": _boxes(aligned, category, instance),
        f"semantic_mask/{scan.name}.bin": category.tobytes(),
        f"instance_mask/{scan.name}.bin": instance.tobytes(),
    }
    return files


def _mmdet3d_s3dis(scan: LayoutScan) -> Files:
    """Return MMDetection3D files for S3DIS, relative to the room's corner, with all objects."""
    low = scan.coord.min(axis=0).astype(np.float64)
    points = np.hstack([scan.coord - low, scan.color]).astype(np.float32)
    segment, instance = _labels(scan)
    instance += 1
    prefix = f"s3dis_data/{scan.name}"
    return {
        f"{prefix}_point.npy": points,
        f"{prefix}_sem_label.npy": segment,
        f"{prefix}_ins_label.npy": instance,
        f"Stanford3dDataset_v1.2_Aligned_Version/{scan.folder}/plane.npy": scan.plane,
        f"points/{scan.name}.bin": points.tobytes(),
        f"super_points/{scan.name}.bin": scan.superpoint.tobytes(),
        f"semantic_mask/{scan.name}.bin": segment.tobytes(),
        f"instance_mask/{scan.name}.bin": instance.tobytes(),
    }


def _labels(scan: LayoutScan) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return class and object of each S3DIS point; every point has both."""
    if scan.ground_truth is None:
        raise FormatError(f"{scan.name}: expected classes and objects of S3DIS, got none.")
    segment, instance = scan.ground_truth
    return segment, np.unique(instance, return_inverse=True)[1].reshape(-1)


def _boxes(
    coord: NDArray[np.floating], category: NDArray[np.int64], instance: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return center, size and category of each benchmark object, shape ``(K, 7)``."""
    rows = []
    for number in np.unique(instance[np.isin(category, NYU_IDS[_NUM_STUFF:]) & (instance > 0)]):
        inside = instance == number
        low, high = coord[inside].min(axis=0), coord[inside].max(axis=0)
        kinds, counts = np.unique(category[inside], return_counts=True)
        rows.append([*(low + high) / 2, *(high - low), kinds[counts.argmax()]])
    boxes = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return boxes[np.isin(boxes[:, 6], NYU_IDS[_NUM_STUFF:])]


def _spformer(scan: LayoutScan) -> Files:
    """Return SPFormer files: a tuple with the superpoints in the middle."""
    coord, color, *ground_truth = _centered(scan)
    content = (coord, color, scan.superpoint, *ground_truth)
    return {
        f"{scan.split}/{scan.name}_inst_nostuff.pth": _to_pickle(content),
        f"planes/{scan.name}.pth": _to_pickle(scan.plane),
    }


def _isbnet(scan: LayoutScan) -> Files:
    """Return files of ISBNet and its successors: a tuple, and a file of superpoints.

    S3DIS rooms have unchanged coordinates and colors, and objects of all classes.
    """
    folder, content = scan.split, _centered(scan)
    if scan.dataset == "S3DIS":
        folder, content = "preprocess", (scan.coord, scan.color.astype(np.float32), *_labels(scan))
    return {
        f"{folder}/{scan.name}_inst_nostuff.pth": _to_pickle(content),
        f"superpoints/{scan.name}.pth": _to_pickle(scan.superpoint),
        f"planes/{scan.name}.pth": _to_pickle(scan.plane),
    }


def _centered(scan: LayoutScan) -> tuple[NDArray[Any], ...]:
    """Return centered coordinates, colors in [-1, 1], and classes and objects if known."""
    mean = scan.coord.mean(axis=0, dtype=np.float64)
    coord = (scan.coord - mean).astype(np.float32)
    color = (scan.color / _CENTERED - 1).astype(np.float32)
    if scan.ground_truth is None:
        return coord, color
    segment, instance = scan.ground_truth
    is_object = (instance >= 0) & ((segment < 0) | (segment >= _NUM_STUFF))
    objects = np.full(len(segment), _IGNORED, dtype=np.float64)
    objects[is_object] = np.unique(instance[is_object], return_inverse=True)[1].reshape(-1)
    return coord, color, np.where(segment < 0, _IGNORED, segment).astype(np.float64), objects


def _mask3d(scan: LayoutScan) -> Files:
    """Return Mask3D files of a ScanNet scan; its classes are NYU40 categories."""
    labels = None if scan.ground_truth is None else (scan.category, scan.ground_truth[1])
    # Mask3D identifies a scan by its mesh folder.
    entry = {"scene": scan.name, "raw_filepath": f"{scan.name}/{scan.name}_vh_clean_2.ply"}
    mode = SPLIT_NAMES[scan.split]
    paths = f"{mode}/{_mask3d_name(scan.name)}", f"{mode}/{scan.name}"
    return _mask3d_files(scan, *paths, labels, entry, first_class=0)


def _mask3d_s3dis(scan: LayoutScan) -> Files:
    """Return Mask3D files of an S3DIS room; its classes start at one in the ground truth."""
    area, room = scan.folder.split("/")
    entry = {"scene": room, "area": area, "raw_filepath": scan.folder}
    return _mask3d_files(scan, scan.folder, scan.folder, _labels(scan), entry, first_class=1)


def _mask3d_files(
    scan: LayoutScan,
    stem: str,
    ground_truth_path: str,
    labels: tuple[NDArray[np.int64], NDArray[np.int64]] | None,
    entry: Mapping[str, Any],
    first_class: int,
) -> Files:
    """Return an array of all columns (superpoints are the tenth), ground truth and list entry."""
    mode, _, name = stem.partition("/")
    color = scan.color.astype(np.int64)
    num_values = 255 * max(len(color), 1)
    entry = {
        "filepath": f"{stem}.npy",
        "file_len": len(color),
        "color_mean": (color.sum(axis=0) / num_values).tolist(),
        "color_std": ((color**2).sum(axis=0) / (255 * num_values)).tolist(),
        **entry,
    }
    files: Files = {f"planes/{scan.name}.npy": scan.plane}
    _check_range(scan, "superpoints", scan.superpoint, 0, _MAX_EXACT)
    columns: list[NDArray[Any]] = [scan.coord, scan.color, scan.normal, scan.superpoint[:, None]]
    if labels is not None:
        category, instance = labels
        _check_range(scan, "numbers of classes", category, 0, _MAX_EXACT)
        _check_range(scan, "numbers of objects", instance, -1, _MAX_OBJECTS)
        columns += [category[:, None], instance[:, None]]
        ground_truth = (category + first_class) * 1000 + instance + 1
        entry["instance_gt_filepath"] = path = f"instance_gt/{ground_truth_path}.txt"
        files[path] = "".join(f"{number}\n" for number in ground_truth).encode()
    if labels is not None or mode == "test":
        files[f"{mode}_database/{name}.json"] = _json(entry)
    return {f"{stem}.npy": np.hstack([c.astype(np.float32) for c in columns]), **files}


def _check_range(
    scan: LayoutScan, what: str, numbers: NDArray[np.integer], low: int, end: int
) -> None:
    """Raise FormatError for integers that Mask3D's files cannot represent."""
    bad = numbers[(numbers < low) | (numbers >= end)]
    if len(bad):
        raise FormatError(
            f"{scan.name}: expected {what} from {low} to {end - 1:,} for layout mask3d, got "
            f"{bad[0]:,}; choose another layout."
        )


def _mask3d_name(name: str) -> str:
    """Return Mask3D's name of a scan, without ScanNet's prefix ``scene``."""
    return re.sub(r"^scene(?=[0-9]{4}_[0-9]{2}$)", "", name)


def _npy(scan: LayoutScan) -> Files:
    """Return a folder of plain arrays, as used by GrowSP and others."""
    return {f"superpoints/{scan.name}.npy": scan.superpoint, f"planes/{scan.name}.npy": scan.plane}


def _nag(scan: LayoutScan) -> Files:
    """Return a Superpoint Transformer file: points and all levels, with class counts."""
    values: dict[str, Any] = {"rgb": scan.color, "normal": scan.normal}
    numbers = _NAG_CLASSES.get(scan.dataset)
    if scan.ground_truth is not None and numbers is not None:
        # The last column counts points without a class.
        one_hot = np.eye(len(numbers), dtype=np.int64)[numbers]
        values["y"] = one_hot[scan.ground_truth[0].clip(min=-1)]
    fine, *coarse = (torch.from_numpy(level).long() for level in (scan.superpoint, *scan.coarser))
    parts = Superpoints(fine, torch.full((int(fine.max()) + 1,), UNLABELED), tuple(coarse))
    levels = make_nag(scan.coord, parts, data=dict, **values)
    return {f"{scan.declared_split or 'nag'}/{scan.name}.h5": encode_nag(levels)}


_NAG_CLASSES = {
    "ScanNet": [*range(len(NYU_IDS) + 1)],
    "S3DIS": [*map(CLASS_ORDERS["spt"].index, CLASS_ORDERS["pointcept"]), 13],
}
"""Class IDs in Superpoint Transformer by class of the data set; the last is for none."""
LAYOUTS: dict[str, dict[str, Callable[[LayoutScan], Files]]] = {
    "scannet": dict.fromkeys(("ScanNet", "ScanNet++", ""), _scannet),
    "mmdet3d": {"ScanNet": _mmdet3d, "S3DIS": _mmdet3d_s3dis},
    "spformer": {"ScanNet": _spformer},
    "isbnet": dict.fromkeys(("ScanNet", "S3DIS"), _isbnet),
    "mask3d": {"ScanNet": _mask3d, "S3DIS": _mask3d_s3dis},
    "nag": dict.fromkeys(("ScanNet", "ScanNet++", "S3DIS", ""), _nag),
    "npy": dict.fromkeys(("ScanNet", "ScanNet++", "S3DIS", ""), _npy),
}
"""File functions by layout and data set. The empty name stands for labels of unknown classes.
Clouds without labels are written like ScanNet scans."""


def _to_pickle(content: Any) -> bytes:  # noqa: ANN401
    """Return the output of ``torch.save`` in a form that NumPy 1 can also load."""
    with io.BytesIO() as stream:
        # Its older form has no checksum, so the module can get its name before NumPy 2.
        torch.save(content, stream, _use_new_zipfile_serialization=False)
        return stream.getvalue().replace(b"cnumpy._core.", b"cnumpy.core.")
