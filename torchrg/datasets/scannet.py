"""ScanNet and ScanNet++ as they are released: vertices of a mesh, and what each of them is of.

The points are the vertices; what is kept of the faces is which side of a vertex is the front.
Annotations name groups of segments, and a segment is a set of vertices.
"""

import csv
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform, check_folder, listed
from torchrg.errors import ConfigError, FormatError
from torchrg.io import read_cloud
from torchrg.io.files import DAMAGES, read_text, refusing
from torchrg.plane_table import Arrays
from torchrg.structures import Cloud
from torchrg.transforms.rows import SampleDict

MESH, MESH_PLUSPLUS = "_vh_clean_2.ply", "mesh_aligned_0.05.ply"
"""End of the name of a scan's mesh in ScanNet, and the whole name in ScanNet++."""
CATEGORIES = "scannetv2-labels.combined.tsv"
"""Table of ScanNet that numbers the words of its annotations."""
CLASSES = (
    "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf",
    "picture", "counter", "desk", "curtain", "refrigerator", "shower curtain", "toilet", "sink",
    "bathtub", "otherfurniture",
)  # fmt: skip
"""Names of the 20 classes of the benchmark, by number."""
NYU_IDS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36, 39)
"""Categories of NYU40 that are these classes, by number."""
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
"""Numbers in :data:`CATEGORIES` that are the classes of ScanNet200, by number."""
_SPLITS = {
    "train": ("scannetv2_train.txt", "nvs_sem_train.txt"),
    "val": ("scannetv2_val.txt", "nvs_sem_val.txt"),
    "test": ("scannetv2_test.txt", "sem_test.txt"),
}
"""Files that list the scans of each split, one a line."""
_PLACES = ("", "splits", "meta_data", "metadata/semantic_benchmark")
"""Folders below the root in which such files, and tables of classes, are looked for."""
_MAX_LABELS = 3
"""Objects that a vertex of ScanNet++ may be of at once."""
_LARGEST_CLASS = 65_535
"""Largest number of a class: labels of the release have 16 bits."""
_MAX_ID = np.iinfo(np.int32).max
"""Largest number of an object of ScanNet."""
_NONE = -1


class ScanNet(SceneDataset):
    """The scans of ScanNet, ``ROOT/scans/<scan>/<scan>_vh_clean_2.ply``, or of ScanNet++.

    Of ScanNet++ the meshes are ``ROOT/data/<scan>/scans/mesh_aligned_0.05.ply``. Splits are those
    of the lists of the data set (``scannetv2_train.txt``, ``nvs_sem_train.txt`` and so on) in
    ``ROOT``, ``ROOT/splits`` or ``ROOT/meta_data``. A scan on none of them, and one without
    annotations where there are no lists, is in ``test``.

    A sample has ``coord`` ``(N, 3)`` float32 in metres as the mesh has them, ``color`` ``(N, 3)``
    uint8, ``axis_align_matrix`` ``(4, 4)`` float64, the motion that sets the scan upright, where
    it is known, and ``name``, as in ``train/scene0000_00``. With annotations: ``segment`` ``(N,)``
    int64, a place in ``classes``, and ``instance`` ``(N,)`` int64, the number of the object; -1 for
    none. Where the table ``scannetv2-labels.combined.tsv`` is found beside the lists, also
    ``segment200``, a place in :data:`IDS_200`. Vertices of ScanNet++ that are of several objects
    have the smallest.

    Args:
        root: The folder that holds ``scans`` or ``data``, or the scans themselves.
        split: ``"train"``, ``"val"`` or ``"test"``. Default: all.
        transform: Called with each sample.

    Attributes:
        scenes: Name, mesh and input files of each scan, in natural order.
        classes: Names of the classes by number.

    Raises:
        FormatError: If there is no such folder, no scan in it, or a list or table is damaged.
        ConfigError: If the split is unknown.

    Warns:
        UserWarning: If a list names scans that are not there.

    References:
        [1] A. Dai et al. ScanNet: richly-annotated 3D reconstructions of indoor scenes. CVPR, 2017.
        [2] C. Yeshwanth et al. ScanNet++: a high-fidelity dataset of 3D indoor scenes. ICCV, 2023.
    """

    kind = "scannet"

    def __init__(
        self,
        root: str | os.PathLike[str],
        split: str | None = None,
        *,
        transform: Transform | None = None,
    ) -> None:
        if split is not None and split not in _SPLITS:
            raise ConfigError(
                f"ScanNet: expected split to be one of {', '.join(_SPLITS)}, got {split!r}."
            )
        self.root = Path(root)
        self.transform = transform
        check_folder(self.root)
        scenes = [_scene(self.root, mesh) for mesh in _meshes(self.root)]
        if not scenes:
            raise FormatError(
                f"{root}: expected scans as <scan>/<scan>{MESH} or <scan>/scans/{MESH_PLUSPLUS}, "
                "got none; pass the folder that holds scans or data."
            )
        lists = _lists(self.root)
        _warn_of_others(lists, {scene.name for scene in scenes})
        named = [scene._replace(name=f"{_split(scene, lists)}/{scene.name}") for scene in scenes]
        self.scenes = [
            scene for scene in named if split is None or scene.name.startswith(f"{split}/")
        ]
        is_plus = any(scene.path.name == MESH_PLUSPLUS for scene in scenes)
        self.classes = tuple(_classes_plus(self.root)) if is_plus else CLASSES
        # Every scan needs them: what is wrong with them is told before the first.
        _read_mapping(self.root) if is_plus else _read_categories(self.root)

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a scan; see :func:`read_scannet_scan`."""
        cloud = read_scannet_scan(scene.path, self.root)
        if "instance" in cloud.fields or scene.name.startswith("test/"):
            return cloud
        note = "no labels: annotations or the table of their words are missing"
        return replace(cloud, notes=(*cloud.notes, note))

    def check_output(self, layout: str, out: Path) -> None:
        """Raise ConfigError if files of ScanNet go to ``root``; others may go beside the meshes."""
        if layout == "scannet":
            super().check_output(layout, out)

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a scan."""
        sample = super().read_sample(index)
        sample.pop("category", None)
        if "segment20" in sample:
            sample["segment"] = sample.pop("segment20")
        return sample


def read_scannet_scan(mesh: Path, root: Path) -> Cloud:
    """Read a scan of ScanNet or ScanNet++ from the raw release; nothing is written.

    Args:
        mesh: The mesh of the scan.
        root: Folder of the data set, in which tables of classes are looked for.

    Returns:
        The vertices, in float32, with ``front`` by the faces and, where they are known, ``color``
        ``(N, 3)`` uint8 and labels as Pointcept stores them: of ScanNet ``segment20``,
        ``segment200``, ``instance`` ``(N,)`` int64, and ``category``, the number in NYU40, 0 for
        none; of ScanNet++ ``segment`` and ``instance`` ``(N, 3)`` int16, the smallest object first.
        Its header has ``axis_align_matrix`` ``(4, 4)`` float64.

    Raises:
        FormatError: If a file is damaged, or is of another number of vertices.
    """
    cloud, files = read_cloud(mesh), _files_of(mesh)
    fields = {name: cloud.fields[name] for name in cloud.fields.keys() & {"color"}}
    if mesh.name == MESH_PLUSPLUS:
        header, labels = {}, _labels_plus(mesh, root, len(cloud))
    else:
        header = _alignment(files["text"]) if "text" in files else {}
        labels = _labels(files, root, len(cloud))
    coordinates = cloud.coordinates.astype(np.float32)
    return replace(cloud, coordinates=coordinates, fields=fields | labels, header=header)


def read_objects(mesh: Path, count: int) -> list[tuple[dict[str, Any], NDArray[np.integer]]] | None:
    """Read the objects of a scan of ScanNet, as its annotation lists them.

    Args:
        mesh: The mesh of the scan.
        count: Its number of vertices.

    Returns:
        ``id``, ``objectId`` and ``label`` of each object, and its vertices; None of a scan without
        annotation. A vertex may be of several objects.

    Raises:
        FormatError: If a file is damaged, or is of another number of vertices.
    """
    files = _files_of(mesh)
    if not {"segments", "groups"} <= files.keys():
        return None
    return [
        ({"id": number, "objectId": other, "label": label}, rows)
        for label, (number, other), _, rows in _groups(files, count, ("id", "objectId"), _MAX_ID)
    ]


def _meshes(root: Path) -> Iterator[Path]:
    """Yield the mesh of each scan in natural order."""
    for folder in (root, *listed(root)):
        for scan in listed(folder) if folder.is_dir() else ():
            for mesh in (scan / f"{scan.name}{MESH}", scan / "scans" / MESH_PLUSPLUS):
                if mesh.is_file():
                    yield mesh


def _scene(root: Path, mesh: Path) -> SceneFiles:
    """Return a scan with its input files, named without its split."""
    is_plus = mesh.name == MESH_PLUSPLUS
    name = mesh.parent.parent.name if is_plus else mesh.parent.name
    names = ("map_benchmark.csv", "top100.txt") if is_plus else (CATEGORIES,)
    tables = filter(None, (_find(root, table) for table in names))
    # Programs that read superpoints of ScanNet++ have scans where the release has data.
    place = f"scans/{name}/scans" if is_plus else mesh.parent.relative_to(root).as_posix()
    dataset = "ScanNet++" if is_plus else "ScanNet"
    return SceneFiles(name, mesh, (mesh, *_files_of(mesh).values(), *tables), dataset, place)


def _files_of(mesh: Path) -> dict[str, Path]:
    """Return the files beside a mesh that are there, by what they are."""
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


def _find(root: Path, name: str) -> Path | None:
    """Return a file of the data set in one of the places where it may be."""
    return next((path for place in _PLACES if (path := root / place / name).is_file()), None)


def _lists(root: Path) -> dict[str, tuple[str, Path]]:
    """Return the split of each scan that is on a list, and the list."""
    paths = ((split, _find(root, name)) for split, names in _SPLITS.items() for name in names)
    return {
        name: (split, path)
        for split, path in paths
        if path is not None
        for name in read_text(path).split()
    }


def _warn_of_others(lists: Mapping[str, tuple[str, Path]], scans: set[str]) -> None:
    """Warn of names on the lists that are no scans, if there are any."""
    others = [name for name in lists if name not in scans]
    if others:
        first = others[0]
        warnings.warn(
            f"{lists[first][1]}: {len(others):,} of {len(lists):,} names on the lists are no scans "
            f"that are there (first: {shortened(first)}); fetch these, or correct the names.",
            stacklevel=3,
        )


def _split(scene: SceneFiles, lists: Mapping[str, tuple[str, Path]]) -> str:
    """Return the split of a scan."""
    if lists:
        return lists[scene.name][0] if scene.name in lists else "test"
    return "train" if "groups" in _files_of(scene.path) else "test"


def _alignment(path: Path) -> Arrays:
    """Return the motion in the text of a scan, if there is one."""
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        name, _, numbers = line.partition("=")
        if name.strip() == "axisAlignment":
            message = f"{path}: expected 16 finite numbers as axisAlignment, got: "
            with refusing(message, *DAMAGES, repair="; the file may be corrupt"):
                matrix = np.array(numbers.split(), dtype=np.float64).reshape(4, 4)
                if not np.isfinite(matrix).all():
                    raise ValueError(shortened(numbers.strip()))
            return {"axis_align_matrix": matrix}
    return {}


def _labels(files: Mapping[str, Path], root: Path, count: int) -> Arrays:
    """Return the labels of a scan of ScanNet."""
    words = _read_categories(root)
    arrays: Arrays = {}
    if "groups" in files and "segments" in files:
        instance = np.full(count, _NONE, dtype=np.int64)
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
        _warn_of_first(path, "segments are in two objects, of which the later is taken", shared)
        _warn_of_first(path, f"objects have labels that {CATEGORIES} does not have", unknown)
        arrays["instance"] = instance
        if words:
            arrays |= {"category": numbers[:, 0], "segment200": _places(numbers[:, 1], IDS_200)}
    if "categories" in files:
        labels = read_cloud(files["categories"]).fields.get("labels")
        if labels is None or labels.shape != (count,):
            raise FormatError(
                f"{files['categories']}: expected a label of each of {count:,} vertices, got "
                f"{'none' if labels is None else f'{len(labels):,}'}; the file may be corrupt."
            )
        category = labels.astype(np.int64)
        wrong = np.flatnonzero((category < 0) | (category > _LARGEST_CLASS))
        if len(wrong):
            raise FormatError(
                f"{files['categories']}: vertex {wrong[0]:,}: expected a label from 0 to "
                f"{_LARGEST_CLASS:,}, got {category[wrong[0]]}; the file may be corrupt."
            )
        arrays["category"] = category
    if "category" in arrays:
        arrays["segment20"] = _places(arrays["category"], NYU_IDS)
    return arrays


def _labels_plus(mesh: Path, root: Path, count: int) -> Arrays:
    """Return the labels of a scan of ScanNet++, in which a vertex may be of several objects."""
    files, classes = _files_of(mesh), _classes_plus(root)
    renamed = _read_mapping(root)
    if not {"segments", "groups"} <= files.keys() or not classes or renamed is None:
        return {}
    segment = np.full((count, _MAX_LABELS), _NONE, dtype=np.int16)
    instance = segment.copy()
    sizes = np.full(segment.shape, np.inf)
    used = np.zeros(count, dtype=np.int64)
    for word, (number,), _, inside in _groups(files, count, ["objectId"], np.iinfo(np.int16).max):
        label = classes.get(renamed.get(word, ""))
        rows = inside[used[inside] < _MAX_LABELS]
        if label is None or not len(rows):
            continue
        place = (rows, used[rows])
        segment[place], instance[place], sizes[place] = label, number, len(rows)
        used[rows] += 1
    every, smallest = np.arange(count), sizes.argmin(axis=1)
    for labels in (segment, instance):
        first = labels[:, 0].copy()
        labels[:, 0] = labels[every, smallest]
        labels[every, smallest] = np.where(smallest > 0, first, labels[:, 0])
    return {"segment": segment, "instance": instance}


def _groups(
    files: Mapping[str, Path], count: int, keys: Sequence[str], most: int
) -> Iterator[tuple[str, list[int], list[int], NDArray[np.integer]]]:
    """Yield label, numbers, segments and rows of the vertices of each object of an annotation.

    The numbers are under some keys, and at most so large.

    Raises:
        FormatError: If an object has a segment that no vertex has, or a file is damaged.

    Warns:
        UserWarning: If two objects have one number.
    """
    path = files["segments"]
    segments = _read_list(path, "segIndices")
    if len(segments) != count:
        raise FormatError(
            f"{path}: expected a segment of each of {count:,} vertices, got {len(segments):,}; "
            "the file may be corrupt."
        )
    of_vertices = _whole(path, "segIndices", segments)
    known, path = np.unique(of_vertices), files["groups"]
    seen: set[int] = set()
    repeated = []
    for place, group in enumerate(_read_list(path, "segGroups")):
        entries = group if isinstance(group, dict) else {}
        label, members = entries.get("label"), entries.get("segments")
        values = [entries.get(key) for key in keys]
        numbers = [n for n in values if type(n) is int and 0 <= n <= most]
        if not (isinstance(label, str) and isinstance(members, list) and len(numbers) == len(keys)):
            raise FormatError(
                f"{path}: object {place}: expected a label, a number from 0 to {most:,} as "
                f"{' and '.join(keys)}, and a list of segments, got {shortened(group)}; the file "
                "may be corrupt."
            )
        whole = _whole(path, f"segments of object {place}", members)
        absent = whole[~np.isin(whole, known)]
        if len(absent):
            raise FormatError(
                f"{path}: object {place}: expected segments of {files['segments'].name}, got "
                f"{absent[0]}, which is not there; take the annotation of the same mesh."
            )
        repeated += [numbers[0]] if numbers[0] in seen else []
        seen.add(numbers[0])
        yield label, numbers, whole.tolist(), np.flatnonzero(np.isin(of_vertices, whole))
    _warn_of_first(path, "objects have the number of another and become one with it", repeated)


def _warn_of_first(path: Path, what: str, entries: Sequence[object]) -> None:
    """Warn of entries of a file that do not fit others, if there are any, and name the first."""
    if entries:
        more = f" and {len(entries) - 1:,} more" if len(entries) > 1 else ""
        warnings.warn(f"{path}: {what}: {shortened(entries[0])}{more}.", stacklevel=2)


def _read_list(path: Path, key: str) -> list[Any]:
    """Return the list that a file of JSON has under a key."""
    message = f"{path}: expected JSON with a list {key}, got: "
    with refusing(message, *DAMAGES, repair="; the file may be corrupt"):
        content = json.loads(read_text(path))
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise TypeError(shortened(content))
        values: list[Any] = content[key]
        return values


def _whole(path: Path, what: str, values: Sequence[object]) -> NDArray[np.int64]:
    """Return whole numbers of 64 bits, and refuse all others; ``what`` they are is for messages."""
    message = f"{path}: expected {what} to be whole numbers, got: "
    with refusing(message, *DAMAGES, repair="; the file may be corrupt"):
        if not set(map(type, values)) <= {int}:
            place = next(i for i, value in enumerate(values) if type(value) is not int)
            raise TypeError(f"{shortened(values[place])} as number {place:,}")
        return np.array(values, dtype=np.int64)


def _read_rows(path: Path, columns: tuple[str, ...], delimiter: str) -> Iterator[dict[str, str]]:
    """Yield the rows of a table that has some columns."""
    message = f"{path}: expected a table with columns {', '.join(columns)}, got: "
    with refusing(message, csv.Error, *DAMAGES, repair="; the file may be corrupt"):
        rows = csv.DictReader(StringIO(read_text(path), newline=None), delimiter=delimiter)
        if missing := [name for name in columns if name not in (rows.fieldnames or ())]:
            raise LookupError(f"none called {missing[0]}")
        for row in rows:
            if any(row[name] is None for name in columns):
                raise LookupError(f"line {rows.line_num:,} with fewer")
            yield row


def _read_categories(root: Path) -> dict[str, tuple[int, int]]:
    """Return the numbers in NYU40 and ScanNet200 of each word of an annotation.

    There are none without the table of them.
    """
    path = _find(root, CATEGORIES)
    numbers: dict[str, tuple[int, int]] = {}
    columns = ("raw_category", "nyu40id", "id")
    for row in [] if path is None else _read_rows(path, columns, "\t"):
        pair = tuple(_class_number(path, row, name) for name in columns[1:])
        numbers.setdefault(row["raw_category"], (pair[0], pair[1]))
    return numbers


def _class_number(path: Path | None, row: Mapping[str, str], name: str) -> int:
    """Return the number of a class in a row of a table, 0 where it is left out."""
    text = row[name].strip() or "0"
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not (0 <= number <= _LARGEST_CLASS and number.is_integer()):
        raise FormatError(
            f"{path}: {shortened(row['raw_category'])}: expected {name} to be a whole number from "
            f"0 to {_LARGEST_CLASS:,}, got {shortened(text)}; the file may be corrupt."
        )
    return int(number)


def _read_mapping(root: Path) -> dict[str, str] | None:
    """Return the class of the benchmark of each word of an annotation; words of none are absent.

    It is None without the table of them.
    """
    path = _find(root, "map_benchmark.csv")
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


def _classes_plus(root: Path) -> dict[str | None, int]:
    """Return the numbers of the classes of ScanNet++ by name, none where there is no list."""
    path = _find(root, "top100.txt")
    lines = [] if path is None else read_text(path).splitlines()
    return {name.strip(): number for number, name in enumerate(filter(str.strip, lines))}


def _places(numbers: NDArray[np.integer], ids: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the place of each number in an ascending list, -1 for those that are not in it."""
    places = np.searchsorted(ids, numbers).clip(max=len(ids) - 1)
    classes: NDArray[np.int64] = np.where(np.array(ids)[places] == numbers, places, _NONE)
    return classes
