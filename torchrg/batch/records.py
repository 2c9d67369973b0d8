"""When a scan is done: its record is there, says what would be done now, and its files agree."""

import dataclasses
import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy
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
        "scipy": scipy.__version__,
        "kernels": "none" if kernels.name_of_library() is None else "C++",
    }


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BYTES_AT_ONCE):
            digest.update(block)
    return digest.hexdigest()


def write_record(folder: Path, description: Record, report: TaskReport) -> None:
    """Write the record of a scan whose files are complete, with its description before the work."""
    record = {
        **description,
        "points": report.num_points,
        "regions": report.num_regions,
        "repairs": list(report.repairs),
        "warnings": list(report.warnings),
        "measured": report.measured,
        "outputs": {name: fingerprint(folder / name) for name in report.files},
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
    names = ("versions", "outputs")
    if isinstance(content, dict) and all(isinstance(content.get(name), dict) for name in names):
        return content
    if is_ours and content is not None:
        raise FormatError(
            f"{folder / RECORD}: was not written by torchrg; move it away, or choose another "
            "directory."
        )
    return None


def remove_earlier(folder: Path, record: Record, files: Collection[str]) -> None:
    """Remove the files of an earlier record, but for those of these names or changed since."""
    for name in record["outputs"].keys() - set(files):
        path = folder / name
        is_result = path.parent == folder and path.is_file() and not path.is_symlink()
        if is_result and fingerprint(path) == record["outputs"][name]:
            path.unlink()


def reason_to_convert(job: Recorded) -> str:
    """Return why a scan is not done, or nothing if it is.

    ``"new"`` without a record; else which of input, settings, version or results is another than
    the record says.
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
