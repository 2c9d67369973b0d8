"""When a scan is done: its record is there, says what would be done now, and its files agree."""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from torchrg import kernels, version
from torchrg.batch.task import TaskReport
from torchrg.config import DepthConfig, NormalsConfig, PipelineConfig
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import DAMAGES
from torchrg.result import RECORD as RECORD

Record = dict[str, Any]
"""A record, or a piece of one, as JSON holds it."""
_USUAL = "pointcept"
"""Layout of a source that names none."""
_RESULTS = {"points": int, "regions": int, "repairs": list, "warnings": list}
"""Types of the parts of a record that reports repeat."""
_BYTES_AT_ONCE = 1 << 20
"""Bytes of a file that are read together, which bounds the memory."""


class Recorded(Protocol):
    """A scan with a record in the folder of its results."""

    @property
    def folder(self) -> Path:
        """Where the results and the record of them are."""

    def describe(self) -> Record:
        """Return what decides the results, as JSON holds it."""


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig | DepthConfig) -> Record:
    """Return what is needed to make a result of one file again, as JSON holds it."""
    return {
        "versions": describe_versions(),
        "config": dataclasses.asdict(settings),
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }


def describe_versions() -> dict[str, str]:
    """Return the versions of what decides a result."""
    return {
        "torchrg": version.__version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "scipy": metadata.version("scipy"),
        "kernels": "none" if kernels.name_of_library() is None else "C++",
    }


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BYTES_AT_ONCE):
            digest.update(block)
    return digest.hexdigest()


def write_record(
    folder: Path, description: Record, report: TaskReport, other_layouts: Record
) -> None:
    """Write the record of a scan whose files are complete, with its description before the work.

    ``other_layouts`` has the fingerprints of its files in other layouts, by the layout.
    """
    record = {
        **description,
        "points": report.num_points,
        "regions": report.num_regions,
        "repairs": list(report.repairs),
        "warnings": list(report.warnings),
        "measured": report.measured,
        "outputs": {name: fingerprint(folder / name) for name in report.files},
        **({"other_layouts": other_layouts} if other_layouts else {}),
    }
    with atomic_path(folder / RECORD) as beside:
        beside.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_record(folder: Path, *, is_ours: bool = False) -> Record | None:
    """Return the record in a folder, or None if there is none that can be read.

    With ``is_ours``, a file of another program in its place is a FormatError.
    """
    try:
        content = json.loads((folder / RECORD).read_bytes())
    except (OSError, *DAMAGES):
        return None
    if isinstance(content, dict):
        layouts = content.setdefault("other_layouts", {})
        parts = [layouts, content.get("versions"), content.get("outputs")]
        parts += layouts.values() if isinstance(layouts, dict) else ()
        if all(isinstance(part, dict) for part in parts):
            return content
    if is_ours and content is not None:
        raise FormatError(
            f"{folder / RECORD}: was not written by torchrg; move it away, or choose another "
            "directory."
        )
    return None


def split_by_layout(record: Record, layout: str) -> tuple[Record, Record]:
    """Return the files of an earlier record that a layout replaces, and the files that stay.

    The second has files of other layouts by the layout. These are in folders that scans share.

    Example:
        >>> record = {"source": {"layout": "nag"}, "outputs": {"planes.json": 1, "../a.h5": 2}}
        >>> split_by_layout({**record, "other_layouts": {}}, "npy")
        ({'planes.json': 1}, {'nag': {'../a.h5': 2}})
    """
    layouts = dict(record["other_layouts"])
    replaced, outputs = dict(layouts.pop(layout, {})), record["outputs"]
    earlier = layout_of(record) or layout
    shared = {name: outputs[name] for name in outputs if "/" in name and earlier != layout}
    if shared:
        layouts[earlier] = shared
    return replaced | {name: outputs[name] for name in outputs.keys() - shared}, layouts


def layout_of(record: Record) -> str:
    """Return the layout that a record or a description of a scan names, "" without a source."""
    source = record.get("source")
    return str(source.get("layout", _USUAL)) if isinstance(source, dict) else ""


def file_of_record(out: Path, folder: Path, name: str) -> Path | None:
    """Return the path of a file that a record names, None outside the output directory."""
    path = Path(os.path.normpath(folder / name))
    return path if path.is_relative_to(out) else None


def is_unchanged(path: Path, noted: Record) -> bool:
    """Return whether a path is a regular file with the noted fingerprint."""
    return path.is_file() and not path.is_symlink() and fingerprint(path) == noted


def remove_earlier(out: Path, folder: Path, files: Mapping[str, Record]) -> list[str]:
    """Remove earlier files of a scan by name and fingerprint; return the names of changed files.

    Files that were changed since stay, and so does what is outside the output directory.
    """
    changed = []
    for name, noted in sorted(files.items()):
        path = file_of_record(out, folder, name)
        if path is None or not os.path.lexists(path):
            continue
        if is_unchanged(path, noted):
            path.unlink()
        else:
            changed.append(name)
    return changed


def reason_to_convert(job: Recorded) -> str:
    """Return why a scan is not done, or nothing if it is.

    ``"new"`` without a record; else which of input, settings, version or results is another than
    the record says, or that the record is damaged.
    """
    record = read_record(job.folder)
    if record is None:
        return "new"
    try:
        description = json.loads(json.dumps(job.describe()))
    except OSError:
        return "input cannot be read"
    changes = {"versions": "version", "config": "settings", "source": "options", "inputs": "input"}
    for key, name in changes.items():
        if record.get(key) != description[key]:
            return f"{name} changed"
    if not all(isinstance(record.get(name), kind) for name, kind in _RESULTS.items()):
        return "record damaged"
    for name, noted in record["outputs"].items():
        try:
            if fingerprint(job.folder / name) != noted:
                return f"{name} changed"
        except OSError:
            return f"{name} missing"
    return ""


def fingerprint(path: Path) -> Record:
    """Return the size and the hash of a file."""
    return {"bytes": path.stat().st_size, "sha256": hash_file(path)}
