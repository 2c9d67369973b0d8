"""Index files of converted data sets.

Each scan has an entry file among its outputs, and a list contains its entries in natural order.
Lists thus contain all existing scans, whichever command wrote them, and identical scans give
identical lists. Lists that a program provides are only completed. A scan is listed in one split.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrg.datasets.folder import natural_key
from torchrg.datasets.layouts import SPLIT_NAMES
from torchrg.datasets.s3dis import CLASS_ORDERS, ROOMS_PER_AREA
from torchrg.datasets.scannet import CLASSES, NYU_IDS
from torchrg.errors import FormatError
from torchrg.io.files import OUTPUT_MARK, atomic_path, create_folder, remove_leftovers, wrap_errors

ListEntry = dict[str, Any]
"""List entry of a scan, by key."""
ListEntries = Mapping[str, Sequence[ListEntry]]
"""List entries by the folder that contains them."""


def check_lists(layout: str, dataset: str, out: Path) -> None:
    """Raise FormatError if :func:`write_lists` would overwrite lists of other origin.

    The output directory may not exist.
    """
    folders, contents = _DATABASES.get((layout, dataset), _NO_LISTS)
    if any((out / folder).is_dir() for folder in folders):
        return
    for name in contents(dict.fromkeys(folders, ())):
        if (out / name).exists():
            raise FormatError(
                f"{out / name}: is of another data set or program; move it, or use another "
                "directory."
            )


def write_lists(layout: str, dataset: str, out: Path, *, without: Collection[Path] = ()) -> None:
    """Write the lists of a directory from the entries of its scans, if there are any.

    The directory is locked; temporary files of a killed process are removed.

    Args:
        layout: A key of :data:`torchrg.datasets.layouts.LAYOUTS`, or ``"pointcept"``.
        dataset: A key of its row.
        out: The output directory.
        without: Entry files below ``out`` to omit from the lists.

    Raises:
        FormatError: If an entry is corrupt, or a list cannot be written.
    """
    out = out.resolve()
    remove_leftovers(out, OUTPUT_MARK)
    if (layout, dataset) == ("mmdet3d", "ScanNet"):
        _write_names(out, [f"meta_data/scannetv2_{split}" for split in SPLIT_NAMES], without)
    folders, contents = _DATABASES.get((layout, dataset), _NO_LISTS)
    entries = {folder: _read_entries(out, folder, without) for folder in folders}
    if any(entries.values()) or _entry_files(out, folders, without):
        import yaml

        for name, content in contents(entries).items():
            text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
            _write(out, name, text)


def _write_names(out: Path, folders: Sequence[str], without: Collection[Path]) -> None:
    """Write the name lists of MMDetection3D, which requires all of them, even if empty.

    Names whose entry belongs to another split are removed from a list.
    """
    entries = {folder: _read_entries(out, folder, without) for folder in folders}
    listed_in = {folder: [entry["name"] for entry in found] for folder, found in entries.items()}
    removed = {path.stem for path in _entry_files(out, folders, without)}
    for folder, scans in listed_in.items() if any(listed_in.values()) or removed else ():
        path = out / f"{folder}.txt"
        text = path.read_text("utf-8", "surrogateescape") if path.is_file() else ""
        existing = [line.strip() for line in text.splitlines() if line.strip()]
        moved = removed.union(*listed_in.values()) - set(scans)
        listed = [name for name in existing if name not in moved]
        foreign = set(listed) - set(scans)
        missing = [name for name in scans if name not in listed]
        if missing or not foreign or listed != existing:
            # A list provided by the program keeps its order; ours has the order of the entries.
            names = [*listed, *missing] if foreign else scans
            _write(out, path.relative_to(out), "".join(f"{name}\n" for name in names))


def _write(out: Path, name: str | Path, text: str) -> None:
    """Write a list atomically."""
    create_folder((out / name).parent)
    with atomic_path(out / name, within=out, mark=OUTPUT_MARK) as temporary:
        # Undecodable bytes of file names stay as they are.
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")


def _entry_files(out: Path, folders: Sequence[str], files: Collection[Path]) -> list[Path]:
    """Return the files that are list entries in the given folders."""
    parents = {out / folder for folder in folders}
    return [path for path in files if path.parent in parents]


def _read_entries(out: Path, folder: str, without: Collection[Path]) -> list[ListEntry]:
    """Return the entries of a list, with absolute file paths."""
    found = [path for path in (out / folder).glob("[!.]*.json") if path not in without]
    paths = sorted(found, key=lambda path: natural_key(path.stem))
    entries = []
    for path in paths:
        message = f"{path}: expected an entry of a list, got: "
        with wrap_errors(message, ValueError, repair="; move it, and convert the scan again"):
            entry = json.loads(path.read_text(encoding="utf-8"))
        keys = {"filepath", "instance_gt_filepath"} & entry.keys()
        entries.append(entry | {key: str(out / entry[key]) for key in keys})
    return entries


def _mask3d(entries: ListEntries) -> dict[str, object]:
    """Return Mask3D's ScanNet databases, class table, and color statistics."""
    train, validation, test = (entries[f"{mode}_database"] for mode in SPLIT_NAMES.values())
    labels = zip(NYU_IDS, CLASSES, strict=True)
    return {
        **{f"{folder}.yaml": [*scans] for folder, scans in entries.items()},
        "train_validation_database.yaml": [*train, *validation],
        "color_mean_std.yaml": _color_mean_std(train or [*validation, *test]),
        "label_database.yaml": {n: {"name": name, "validation": True} for n, name in labels},
    }


def _mask3d_s3dis(entries: ListEntries) -> dict[str, object]:
    """Return Mask3D's database of each S3DIS area, and of its training areas (all others)."""
    contents: dict[str, object] = {f"{folder}.yaml": [*scans] for folder, scans in entries.items()}
    for folder, test in entries.items():
        train = [entry for name, scans in entries.items() if name != folder for entry in scans]
        contents[f"train_{folder}.yaml"] = train
        area = folder.removesuffix("_database")
        contents[f"{area}_color_mean_std.yaml"] = _color_mean_std(train or test)
    classes = enumerate(CLASS_ORDERS["pointcept"])
    contents["label_database.yaml"] = {n: {"name": name, "validation": True} for n, name in classes}
    return contents


def _color_mean_std(entries: Sequence[ListEntry]) -> dict[str, list[float]]:
    """Return mean and deviation of colors from entries, which store the mean of squares."""
    if not entries:
        return {"mean": [0.0] * 3, "std": [1.0] * 3}
    mean, squares = (
        np.mean([entry[key] for entry in entries], axis=0) for key in ("color_mean", "color_std")
    )
    deviation = np.sqrt(np.maximum(squares - mean**2, 0))
    # A constant channel has no deviation to divide by.
    return {"mean": mean.tolist(), "std": np.where(deviation > 0, deviation, 1.0).tolist()}


_NO_LISTS: tuple[Sequence[str], Callable[[ListEntries], dict[str, object]]] = (
    (),
    lambda entries: {},
)
_DATABASES = {
    ("mask3d", "ScanNet"): ([f"{mode}_database" for mode in SPLIT_NAMES.values()], _mask3d),
    ("mask3d", "S3DIS"): ([f"Area_{area}_database" for area in ROOMS_PER_AREA], _mask3d_s3dis),
}
"""Entry folders and database writers, by layout and data set."""
