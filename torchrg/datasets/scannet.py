"""ScanNet and ScanNet++ as released: mesh vertices and annotations.

The points are the mesh vertices; the faces only determine the front of each vertex. Annotations
list groups of segments, which are sets of vertices.
"""

import csv
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._checks import check_choices
from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform, check_folder, list_dir
from torchrg.errors import FormatError, warn
from torchrg.io import read_cloud
from torchrg.io.files import PARSE_ERRORS, decode_file, list_some, local_path, wrap_errors
from torchrg.io.plane_table import Arrays
from torchrg.linalg.rigid import check_rigid
from torchrg.structures import UNLABELED, Cloud
from torchrg.transforms.rows import SampleDict

MESH, MESH_PLUSPLUS = "_vh_clean_2.ply", "mesh_aligned_0.05.ply"
"""Suffix of a scan's mesh in ScanNet, and its file name in ScanNet++."""
CATEGORIES = "scannetv2-labels.combined.tsv"
"""ScanNet's table of category IDs of annotation labels."""
CLASSES = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "desk", "curtain", "refrigerator", "shower curtain", "toilet", "sink",
    "bathtub", "otherfurniture",
)  # fmt: skip
"""Names of the 20 benchmark classes, by index."""
NYU_IDS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36, 39)
"""NYU40 IDs of these classes, by index."""
_RANGES_200 = (
    "1-11 13-19 21-24 26-29 31-36 38-42 44-52 54-59 62-80 82 84 86-90 93 95-107 110 112 115 116 "
    "118 120-122 125 128 130-132 134 136 138-141 145 148 154-157 159 161 163 165 166 168-170 177 "
    "180 185 188 191 193 195 202 208 213 214 221 229 230 232 233 242 250 261 264 276 283 286 300 "
    "304 312 323 325 331 342 356 370 392 395 399 408 417 488 540 562 570 572 581 609 748 776 1156 "
    "1163-1176 1178-1191"
)
IDS_200 = tuple(
    number
    for first, _, last in (words.partition("-") for words in _RANGES_200.split())
    for number in range(int(first), int(last or first) + 1)
)
"""IDs in :data:`CATEGORIES` of the ScanNet200 classes, by index."""
Split = Literal["train", "val", "test"]
_SPLITS: dict[Split, tuple[str, str]] = {
    "train": ("scannetv2_train.txt", "nvs_sem_train.txt"),
    "val": ("scannetv2_val.txt", "nvs_sem_val.txt"),
    "test": ("scannetv2_test.txt", "sem_test.txt"),
}
"""Files that list the scans of each split, one per line."""
_FOLDERS = ("", "splits", "meta_data", "metadata/semantic_benchmark")
"""Folders below the root that may contain such lists, and class tables."""
_MAX_LABELS = 3
"""Maximum number of objects per vertex in ScanNet++."""
_MAX_CLASS = 65_535
"""Largest class ID: labels of the release have 16 bits."""
_MAX_ID = np.iinfo(np.int32).max
"""Largest object ID in ScanNet."""


class ScanNet(SceneDataset):
    """Scans of ScanNet, ``ROOT/scans/<scan>/<scan>_vh_clean_2.ply``, or of ScanNet++.

    ScanNet++ meshes are ``ROOT/data/<scan>/scans/mesh_aligned_0.05.ply``. Splits are read from the
    data set's lists (``scannetv2_train.txt``, ``nvs_sem_train.txt`` and so on) in ``ROOT``,
    ``ROOT/splits`` or ``ROOT/meta_data``. Unlisted scans, and without lists all scans without
    annotations, are in ``test``.

    A sample has ``coord`` ``(N, 3)`` float32 in meters, in mesh coordinates, ``color`` ``(N, 3)``
    uint8, and ``name``, as in ``train/scene0000_00``. If known, ``axis_align_matrix`` ``(4, 4)``
    float64 is the rigid transform that makes the scan upright. With annotations: ``segment``
    ``(N,)`` int64, an index into ``classes``, and ``instance`` ``(N,)`` int64, the object ID; -1
    for none. If the table ``scannetv2-labels.combined.tsv`` is next to the lists, also
    ``segment200``, an index into :data:`IDS_200`. In ScanNet++ the smallest object counts.

    Args:
        root: The folder that contains ``scans`` or ``data``, or the scans themselves.
        split: ``"train"``, ``"val"`` or ``"test"``. Default: all.
        transform: Applied to each sample.

    Attributes:
        scenes: Name, mesh and input files of each scan, in natural order.
        classes: Class names by index.

    Raises:
        FormatError: If the folder is missing or contains no scan, or a list or table is corrupt.
        ConfigError: If the split is unknown.

    Warns:
        UserWarning: If a list contains names of missing scans.

    References:
        [1] A. Dai et al. ScanNet: richly-annotated 3D reconstructions of indoor scenes. CVPR, 2017.
        [2] C. Yeshwanth et al. ScanNet++: a high-fidelity dataset of 3D indoor scenes. ICCV, 2023.
    """

    kind = "scannet"

    def __init__(
        self,
        root: str | os.PathLike[str],
        split: Split | None = None,
        *,
        transform: Transform | None = None,
    ) -> None:
        if split is not None:
            check_choices("ScanNet", split=(split, Split))
        self.root = local_path(root)
        self.transform = transform
        check_folder(self.root)
        scenes = [_scene(self.root, mesh) for mesh in _meshes(self.root)]
        if not scenes:
            raise FormatError(
                f"{root}: expected scans as <scan>/<scan>{MESH} or <scan>/scans/{MESH_PLUSPLUS}, "
                "got none; pass the folder that contains scans or data."
            )
        lists = _read_lists(self.root)
        known = {scene.name for scene in scenes}
        if missing := [name for name in lists if name not in known]:
            count, path = f"{len(missing):,} of {len(lists):,}", lists[missing[0]][1]
            what = f"{count} listed scans are missing; download them, or correct the names"
            _warn_entries(path, what, missing)
        named = [scene._replace(name=f"{_split(scene, lists)}/{scene.name}") for scene in scenes]
        self.scenes = [
            scene for scene in named if split is None or scene.name.startswith(f"{split}/")
        ]
        is_plus = any(scene.path.name == MESH_PLUSPLUS for scene in scenes)
        self.classes = tuple(_scannetpp_classes(self.root)) if is_plus else CLASSES
        # Every scan needs these tables, so errors in them are raised before the first scan.
        _read_mapping(self.root) if is_plus else _read_categories(self.root)

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a scan; see :func:`read_scannet_scan`."""
        cloud = read_scannet_scan(scene.path, self.root)
        if "instance" in cloud.fields or scene.name.startswith("test/"):
            return cloud
        note = "no labels: the annotations or the table of label categories are missing"
        return replace(cloud, notes=(*cloud.notes, note))

    def allows_results(self, layout: str) -> bool:
        """Return whether a layout may be written to ``root``: all but ScanNet's."""
        return layout != "scannet"

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a scan."""
        sample = super().read_sample(index)
        sample.pop("category", None)
        if "segment20" in sample:
            sample["segment"] = sample.pop("segment20")
        return sample


def read_scannet_scan(mesh: Path, root: Path) -> Cloud:
    """Read a scan of ScanNet or ScanNet++ from the raw release.

    Args:
        mesh: The mesh of the scan.
        root: Folder of the data set, in which class tables are searched.

    Returns:
        The vertices, in float32, with ``front`` from the faces and, if known, ``color`` ``(N, 3)``
        uint8 and labels as Pointcept stores them: for ScanNet ``segment20``, ``segment200``,
        ``instance`` ``(N,)`` int64, and ``category``, the NYU40 ID, 0 for none; for ScanNet++
        ``segment`` and ``instance`` ``(N, 3)`` int16, the smallest object first. The header has
        ``axis_align_matrix`` ``(4, 4)`` float64.

    Raises:
        FormatError: If a file is corrupt, or has another number of vertices.
    """
    cloud, files = read_cloud(mesh), _scan_files(mesh)
    fields = {name: cloud.fields[name] for name in cloud.fields.keys() & {"color"}}
    if mesh.name == MESH_PLUSPLUS:
        header, labels = {}, _scannetpp_labels(mesh, root, len(cloud))
    else:
        header = _alignment(files["text"]) if "text" in files else {}
        labels = _scannet_labels(files, root, len(cloud))
    coordinates = cloud.coordinates.astype(np.float32)
    return replace(cloud, coordinates=coordinates, fields=fields | labels, header=header)


def read_objects(mesh: Path, count: int) -> list[tuple[dict[str, Any], NDArray[np.integer]]] | None:
    """Read the objects in the annotation of a ScanNet scan.

    Args:
        mesh: The mesh of the scan.
        count: Its number of vertices.

    Returns:
        ``id``, ``objectId`` and ``label`` of each object, and its vertices; None for a scan without
        annotation. A vertex may belong to several objects.

    Raises:
        FormatError: If a file is corrupt, or has another number of vertices.
    """
    files = _scan_files(mesh)
    if not {"segments", "groups"} <= files.keys():
        return None
    return [
        ({"id": number, "objectId": other, "label": label}, rows)
        for label, (number, other), _, rows in _groups(files, count, ("id", "objectId"), _MAX_ID)
    ]


def _meshes(root: Path) -> Iterator[Path]:
    """Yield the mesh of each scan in natural order."""
    for folder in (root, *list_dir(root)):
        for scan in list_dir(folder) if folder.is_dir() else ():
            for mesh in (scan / f"{scan.name}{MESH}", scan / "scans" / MESH_PLUSPLUS):
                if mesh.is_file():
                    yield mesh


def _scene(root: Path, mesh: Path) -> SceneFiles:
    """Return a scan with its input files; its name has no split."""
    is_plus = mesh.name == MESH_PLUSPLUS
    name = mesh.parent.parent.name if is_plus else mesh.parent.name
    names = ("map_benchmark.csv", "top100.txt") if is_plus else (CATEGORIES,)
    tables = filter(None, (_find_file(root, table) for table in names))
    # Programs that read ScanNet++ superpoints use scans instead of the release's data.
    location = f"scans/{name}/scans" if is_plus else mesh.parent.relative_to(root).as_posix()
    dataset = "ScanNet++" if is_plus else "ScanNet"
    return SceneFiles(name, mesh, (mesh, *_scan_files(mesh).values(), *tables), dataset, location)


def _scan_files(mesh: Path) -> dict[str, Path]:
    """Return the existing files next to a mesh, by purpose."""
    folder = mesh.parent
    if mesh.name == MESH_PLUSPLUS:
        names = {"segments": "segments.json", "groups": "segments_anno.json"}
    else:
        scan = mesh.name.removesuffix(MESH)
        names = {
            "segments": f"{mesh.stem}.0.010000.segs.json",
            "groups": f"{scan}.aggregation.json",
            "categories": f"{mesh.stem}.labels.ply",
            "text": f"{scan}.txt",
        }
    return {key: folder / name for key, name in names.items() if (folder / name).is_file()}


def _find_file(root: Path, name: str) -> Path | None:
    """Return the first existing file of that name among the possible folders."""
    return next((path for folder in _FOLDERS if (path := root / folder / name).is_file()), None)


def _read_lists(root: Path) -> dict[str, tuple[str, Path]]:
    """Return the split and the list of each listed scan."""
    paths = ((split, _find_file(root, name)) for split, names in _SPLITS.items() for name in names)
    lists = dict[str, tuple[str, Path]]()
    for split, path in paths:
        if path is not None:
            names = decode_file(path).split()
            both = [name for name in names if lists.get(name, (split,))[0] != split]
            lists |= dict.fromkeys(names, (split, path))
            _warn_entries(path, f"scans of another split are in {split}, too, which counts", both)
    return lists


def _split(scene: SceneFiles, lists: Mapping[str, tuple[str, Path]]) -> str:
    """Return the split of a scan."""
    if lists:
        return lists[scene.name][0] if scene.name in lists else "test"
    return "train" if "groups" in _scan_files(scene.path) else "test"


def _alignment(path: Path) -> Arrays:
    """Return the alignment matrix in a scan's text file, if any."""
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        name, _, numbers = line.partition("=")
        if name.strip() == "axisAlignment":
            message = f"{path}: expected 16 finite numbers as axisAlignment, got: "
            with wrap_errors(message, *PARSE_ERRORS, repair="; the file may be corrupt"):
                matrix = np.array(numbers.split(), dtype=np.float64).reshape(4, 4)
                if not np.isfinite(matrix).all():
                    raise ValueError(shortened(numbers.strip()))
                check_rigid(path.name, name.strip(), torch.from_numpy(matrix))
            return {"axis_align_matrix": matrix}
    return {}


def _scannet_labels(files: Mapping[str, Path], root: Path, count: int) -> Arrays:
    """Return the labels of a ScanNet scan."""
    words = _read_categories(root)
    arrays: Arrays = {}
    if "groups" in files and "segments" in files:
        instance = np.full(count, UNLABELED, dtype=np.int64)
        numbers = np.zeros((count, 2), dtype=np.int64)
        owners: dict[int, int] = {}
        shared, unknown = [], []
        for label, (number,), segments, rows in _groups(files, count, ["id"], _MAX_ID):
            instance[rows] = number
            numbers[rows] = words.get(label, (0, 0))
            shared += [id_ for id_ in segments if owners.get(id_, number) != number]
            owners |= dict.fromkeys(segments, number)
            unknown += [label] if words and label not in words else []
        path = files["groups"]
        _warn_entries(path, "segments belong to two objects, and the later is used", shared)
        _warn_entries(path, f"objects have labels that are not in {CATEGORIES}", unknown)
        arrays["instance"] = instance
        if words:
            arrays |= {"category": numbers[:, 0], "segment200": _index_in(numbers[:, 1], IDS_200)}
    if "categories" in files:
        labels = read_cloud(files["categories"]).fields.get("labels")
        if labels is None or labels.shape != (count,):
            raise FormatError(
                f"{files['categories']}: expected a label for each of {count:,} vertices, got "
                f"{'none' if labels is None else f'{len(labels):,}'}; the file may be corrupt."
            )
        category = labels.astype(np.int64)
        wrong = np.flatnonzero((category < 0) | (category > _MAX_CLASS))
        if len(wrong):
            raise FormatError(
                f"{files['categories']}: vertex {wrong[0]:,}: expected a label from 0 to "
                f"{_MAX_CLASS:,}, got {category[wrong[0]]}; the file may be corrupt."
            )
        arrays["category"] = category
    if "category" in arrays:
        arrays["segment20"] = _index_in(arrays["category"], NYU_IDS)
    return arrays


def _scannetpp_labels(mesh: Path, root: Path, count: int) -> Arrays:
    """Return the labels of a ScanNet++ scan, in which a vertex may belong to several objects."""
    files, classes = _scan_files(mesh), _scannetpp_classes(root)
    renamed = _read_mapping(root)
    if not {"segments", "groups"} <= files.keys() or not classes or renamed is None:
        return {}
    segment = np.full((count, _MAX_LABELS), UNLABELED, dtype=np.int16)
    instance = segment.copy()
    sizes = np.full(segment.shape, np.inf)
    used = np.zeros(count, dtype=np.int64)
    for word, (number,), _, inside in _groups(files, count, ["objectId"], np.iinfo(np.int16).max):
        label = classes.get(renamed.get(word, ""))
        rows = inside[used[inside] < _MAX_LABELS]
        if label is None or not len(rows):
            continue
        slots = (rows, used[rows])
        segment[slots], instance[slots], sizes[slots] = label, number, len(rows)
        used[rows] += 1
    rows, smallest = np.arange(count), sizes.argmin(axis=1)
    for labels in (segment, instance):
        first = labels[:, 0].copy()
        labels[:, 0] = labels[rows, smallest]
        labels[rows, smallest] = np.where(smallest > 0, first, labels[:, 0])
    return {"segment": segment, "instance": instance}


def _groups(
    files: Mapping[str, Path], count: int, keys: Sequence[str], max_id: int
) -> Iterator[tuple[str, list[int], list[int], NDArray[np.integer]]]:
    """Yield label, IDs, segments and vertex rows of each object in an annotation.

    The IDs are the values of ``keys``, at most ``max_id``.

    Raises:
        FormatError: If an object has a segment without vertices, or a file is corrupt.

    Warns:
        UserWarning: If two objects have the same ID.
    """
    path = files["segments"]
    segments = _read_list(path, "segIndices")
    if len(segments) != count:
        raise FormatError(
            f"{path}: expected {count:,} segments, got {len(segments):,}; the file may be corrupt."
        )
    vertex_segments = _to_int64(path, "segIndices", segments)
    known, path = np.unique(vertex_segments), files["groups"]
    seen: set[tuple[str, object]] = set()
    repeated = []
    for i, group in enumerate(_read_list(path, "segGroups")):
        entries = group if isinstance(group, dict) else {}
        label, members = entries.get("label"), entries.get("segments")
        values = [entries.get(key) for key in keys]
        numbers = [n for n in values if type(n) is int and 0 <= n <= max_id]
        if not (isinstance(label, str) and isinstance(members, list) and len(numbers) == len(keys)):
            raise FormatError(
                f"{path}: object {i}: expected a label, an integer from 0 to {max_id:,} as "
                f"{' and '.join(keys)}, and a list of segments, got {shortened(group)}; the file "
                "may be corrupt."
            )
        member_ids = _to_int64(path, f"segments of object {i}", members)
        absent = member_ids[~np.isin(member_ids, known)]
        if len(absent):
            raise FormatError(
                f"{path}: object {i}: expected segments of {files['segments'].name}, got "
                f"{absent[0]}, which is missing there; use the annotation of the same mesh."
            )
        ids = {(key, entries[key]) for key in ("id", "objectId") if key in entries}
        repeated += [numbers[0]] if seen & ids else []
        seen |= ids
        rows = np.flatnonzero(np.isin(vertex_segments, member_ids))
        yield label, numbers, member_ids.tolist(), rows
    _warn_entries(path, "objects share an ID with an earlier one and are merged into it", repeated)


def _warn_entries(path: Path, what: str, entries: Sequence[object]) -> None:
    """Warn of inconsistent entries of a file, if any, and name the first."""
    if entries:
        warn(f"{path}: {what}: {list_some([*map(shortened, entries)], max_names=1)}.")


def _read_list(path: Path, key: str) -> list[Any]:
    """Return the list at a key of a JSON file."""
    message = f"{path}: expected JSON with a list {key}, got: "
    with wrap_errors(message, *PARSE_ERRORS, repair="; the file may be corrupt"):
        content = json.loads(decode_file(path))
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise TypeError(shortened(content))
        values: list[Any] = content[key]
        return values


def _to_int64(path: Path, what: str, values: Sequence[object]) -> NDArray[np.int64]:
    """Convert a list to int64, and raise FormatError for other values; ``what`` names the list."""
    message = f"{path}: expected {what} to be integers, got: "
    with wrap_errors(message, *PARSE_ERRORS, repair="; the file may be corrupt"):
        if not set(map(type, values)) <= {int}:
            index = next(i for i, value in enumerate(values) if type(value) is not int)
            raise TypeError(f"{shortened(values[index])} as number {index:,}")
        return np.array(values, dtype=np.int64)


def _read_rows(path: Path, columns: tuple[str, ...], delimiter: str) -> Iterator[dict[str, str]]:
    """Yield the rows of a table that has the given columns."""
    message = f"{path}: expected a table with columns {', '.join(columns)}, got: "
    with wrap_errors(message, csv.Error, *PARSE_ERRORS, repair="; the file may be corrupt"):
        rows = csv.DictReader(StringIO(decode_file(path), newline=None), delimiter=delimiter)
        if missing := [name for name in columns if name not in (rows.fieldnames or ())]:
            raise LookupError(f"none called {missing[0]}")
        for row in rows:
            if any(row[name] is None for name in columns):
                raise LookupError(f"line {rows.line_num:,} with fewer")
            yield row


def _read_categories(root: Path) -> dict[str, tuple[int, int]]:
    """Return the NYU40 and ScanNet200 IDs of each annotation label.

    Without the table, the result is empty.
    """
    path = _find_file(root, CATEGORIES)
    numbers: dict[str, tuple[int, int]] = {}
    columns = ("raw_category", "nyu40id", "id")
    for row in [] if path is None else _read_rows(path, columns, "\t"):
        pair = tuple(_class_number(path, row, name) for name in columns[1:])
        numbers.setdefault(row["raw_category"], (pair[0], pair[1]))
    return numbers


def _class_number(path: Path | None, row: Mapping[str, str], name: str) -> int:
    """Return a class ID in a row of a table, 0 if it is empty."""
    text = row[name].strip() or "0"
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not (0 <= number <= _MAX_CLASS and number.is_integer()):
        raise FormatError(
            f"{path}: {shortened(row['raw_category'])}: expected {name} to be an integer from "
            f"0 to {_MAX_CLASS:,}, got {shortened(text)}; the file may be corrupt."
        )
    return int(number)


def _read_mapping(root: Path) -> dict[str, str] | None:
    """Return the benchmark class of each annotation label, without labels of no class.

    Without the table, the result is None.
    """
    path = _find_file(root, "map_benchmark.csv")
    if path is None:
        return None
    classes: dict[str, str] = {}
    for row in _read_rows(path, ("class", "semantic_map_to"), ","):
        target = row["semantic_map_to"]
        if target and target != "None":
            classes[row["class"]] = target
        elif not target:
            classes.setdefault(row["class"], row["class"])
    return classes


def _scannetpp_classes(root: Path) -> dict[str | None, int]:
    """Return the class indices of ScanNet++ by name; empty without a list."""
    path = _find_file(root, "top100.txt")
    lines = [] if path is None else decode_file(path).splitlines()
    return {name.strip(): number for number, name in enumerate(filter(str.strip, lines))}


def _index_in(numbers: NDArray[np.integer], ids: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the index of each number in an ascending list, -1 if it is missing."""
    indices = np.searchsorted(ids, numbers).clip(max=len(ids) - 1)
    classes: NDArray[np.int64] = np.where(np.array(ids)[indices] == numbers, indices, UNLABELED)
    return classes
