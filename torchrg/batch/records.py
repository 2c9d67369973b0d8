"""Provenance records, used to skip up-to-date scans."""

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
from torchrg.io.files import PARSE_ERRORS, check_regular
from torchrg.result import RECORD as RECORD

Record = dict[str, Any]
"""A record, or a part of one, as JSON values."""
_DEFAULT_LAYOUT = "pointcept"
"""Default layout of a source."""
_RESULTS = {"points": int, "regions": int, "repairs": list, "warnings": list}
"""Types of the record entries that reports repeat."""
_BYTES_PER_READ = 1 << 20
"""Bytes of a file read together, which bounds the memory."""


class Recorded(Protocol):
    """Scan with a record in the folder of its results."""

    @property
    def folder(self) -> Path:
        """Folder of the results and their record."""

    def describe(self) -> Record:
        """Return everything that determines the results, as JSON values."""


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig | DepthConfig) -> Record:
    """Return the provenance of a result of one file, as JSON values."""
    return {
        "versions": describe_versions(),
        "config": dataclasses.asdict(settings),
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }


def describe_versions() -> dict[str, str]:
    """Return the versions of the software that determines results."""
    return {
        "torchrg": version.__version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "scipy": metadata.version("scipy"),
        "kernels": "none" if kernels.name_of_library() is None else "C++",
    }


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    check_regular(path)
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BYTES_PER_READ):
            digest.update(block)
    return digest.hexdigest()


def write_record(
    folder: Path, description: Record, report: TaskReport, other_layouts: Record
) -> None:
    """Write the record of a scan with complete files; ``description`` is from before the work.

    ``other_layouts`` contains the fingerprints of its files in other layouts, by layout.
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
    with atomic_path(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_record(folder: Path, *, strict: bool = False) -> Record | None:
    """Return the record in a folder, or None if it is missing or unreadable.

    With ``strict``, a record file of another program raises FormatError.
    """
    try:
        content = json.loads((folder / RECORD).read_bytes())
    except (OSError, *PARSE_ERRORS):
        return None
    if isinstance(content, dict):
        layouts = content.setdefault("other_layouts", {})
        parts = [layouts, content.get("versions"), content.get("outputs")]
        parts += layouts.values() if isinstance(layouts, dict) else ()
        if all(isinstance(part, dict) for part in parts):
            return content
    if strict and content is not None:
        raise FormatError(
            f"{folder / RECORD}: was not written by torchrg; move it, or choose another directory."
        )
    return None


def split_by_layout(record: Record, layout: str) -> tuple[Record, Record]:
    """Split the files of an earlier record into replaced files and kept files.

    The kept files belong to other layouts, in folders that scans share, and are keyed by layout.

    Example:
        >>> record = {"source": {"layout": "nag"}, "outputs": {"planes.json": 1, "../a.h5": 2}}
        >>> split_by_layout({**record, "other_layouts": {}}, "npy")
        ({'planes.json': 1}, {'nag': {'../a.h5': 2}})
    """
    layouts = dict(record["other_layouts"])
    replaced, outputs = dict(layouts.pop(layout, {})), record["outputs"]
    earlier = get_layout(record) or layout
    shared = {name: outputs[name] for name in outputs if "/" in name and earlier != layout}
    if shared:
        layouts[earlier] = shared
    return replaced | {name: outputs[name] for name in outputs.keys() - shared}, layouts


def get_layout(record: Record) -> str:
    """Return the layout in a record or a description of a scan, "" without a source."""
    source = record.get("source")
    return str(source.get("layout", _DEFAULT_LAYOUT)) if isinstance(source, dict) else ""


def resolve_output(out: Path, folder: Path, name: str) -> Path | None:
    """Return the path of a file in a record, or None outside the output directory."""
    path = Path(os.path.normpath(folder / name))
    return path if path.is_relative_to(out) else None


def is_unchanged(path: Path, stored: Record) -> bool:
    """Return whether a path is a regular file with the stored fingerprint."""
    return path.is_file() and not path.is_symlink() and fingerprint(path) == stored


def remove_replaced(out: Path, folder: Path, files: Mapping[str, Record]) -> list[str]:
    """Remove earlier files of a scan by name and fingerprint; return the names of changed files.

    Changed files and files outside the output directory are kept.
    """
    changed = []
    for name, stored in sorted(files.items()):
        path = resolve_output(out, folder, name)
        if path is None or not os.path.lexists(path):
            continue
        if is_unchanged(path, stored):
            path.unlink()
        else:
            changed.append(name)
    return changed


def reason_to_convert(job: Recorded) -> str:
    """Return why a scan must be converted, or "" if it is up to date.

    ``"new"`` without a record; else the first of version, settings, options, input or results that
    differs from the record, or that the record is damaged.
    """
    record = read_record(job.folder)
    if record is None:
        return "new"
    try:
        description = json.loads(json.dumps(job.describe()))
    except (OSError, FormatError):
        return "input cannot be read"
    changes = {"versions": "version", "config": "settings", "source": "options", "inputs": "input"}
    for key, name in changes.items():
        if record.get(key) != description[key]:
            return f"{name} changed"
    if not all(isinstance(record.get(name), kind) for name, kind in _RESULTS.items()):
        return "record damaged"
    for name, stored in record["outputs"].items():
        try:
            if fingerprint(job.folder / name) != stored:
                return f"{name} changed"
        except OSError:
            return f"{name} missing"
    return ""


def fingerprint(path: Path) -> Record:
    """Return the size and the SHA-256 of a file."""
    return {"bytes": path.stat().st_size, "sha256": hash_file(path)}
