"""When a scan is done: its record is there, says what would be done now, and its files agree."""

import dataclasses
import hashlib
import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy
import torch

from torchrg import kernels, version
from torchrg.batch.task import Converted
from torchrg.config import DepthConfig, NormalsConfig, PipelineConfig
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import DAMAGES
from torchrg.result import RECORD as RECORD

_TEXT = b"tEXttorchrg\0"
"""Beginning of the part of a PNG that holds a record: a text of the name torchrg."""
_END_BYTES = 12
"""Bytes of the part that every PNG ends with."""


class Recorded(Protocol):
    """What has a record: what decides its results, and where they are."""

    @property
    def record(self) -> Path:
        """The file of the record."""

    def describe(self) -> dict[str, Any]:
        """Return what decides the results; see :func:`describe_work`."""

    def place_of(self, name: str) -> Path:
        """Return the file of a result by its name in the record."""


def describe_run(
    source: Path, settings: PipelineConfig | NormalsConfig | DepthConfig
) -> dict[str, Any]:
    """Return what is needed to make a result of one file again, ready for JSON.

    Versions, settings, name and SHA-256 of the input, device.
    """
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
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def describe_work(
    settings: Any,  # noqa: ANN401 - a dataclass of any kind
    options: dict[str, Any],
    inputs: Sequence[Path],
    root: Path,
) -> dict[str, Any]:
    """Return what decides the results of some inputs below a folder, ready for JSON.

    Versions, settings, options, and name, size and SHA-256 of each input; raises OSError if one
    cannot be read.
    """
    config = dataclasses.asdict(settings)
    # It never changes a result, and lowering it after running out of memory must cost nothing.
    config.pop("chunk_size", None)
    return {
        "versions": describe_versions(),
        "config": config,
        "source": options,
        "inputs": [{"name": _name_below(root, path), **_fingerprint(path)} for path in inputs],
        "device": "cpu",
    }


def write_record(job: Recorded, description: dict[str, Any], converted: Converted) -> None:
    """Write the record of a scan whose files are complete, with its description before the work."""
    record = {
        **description,
        "points": converted.num_points,
        "regions": converted.num_regions,
        "repairs": list(converted.repairs),
        "warnings": list(converted.warnings),
        "outputs": {name: _fingerprint(job.place_of(name)) for name in converted.files},
    }
    text = json.dumps(record, indent=1, sort_keys=True).encode() + b"\n"
    content = _with_text(job.record.read_bytes(), text) if _is_image(job.record) else text
    with atomic_path(job.record) as beside:
        beside.write_bytes(content)


def read_record(job: Recorded) -> dict[str, Any] | None:
    """Return the record of a scan, or None if there is none that can be read."""
    record = _read_json(job)
    return record if _is_record(record) else None


def check_record(job: Recorded) -> None:
    """Raise FormatError if another program has a file in the place of the record."""
    other = _read_json(job)
    if other is not None and not _is_record(other):
        raise FormatError(
            f"{job.record}: was not written by torchrg; move it away, or choose another directory."
        )


def _read_json(job: Recorded) -> Any:  # noqa: ANN401
    """Return what is in the place of the record, None if it is not there or damaged."""
    try:
        content = job.record.read_bytes()
        return json.loads(_split_text(content)[1] if _is_image(job.record) else content)
    except (OSError, *DAMAGES):
        return None


def _is_record(found: Any) -> bool:  # noqa: ANN401
    """Return whether an object of JSON is a record."""
    parts = ("versions", "outputs")
    return isinstance(found, dict) and all(isinstance(found.get(part), dict) for part in parts)


def is_unchanged(job: Recorded, name: str, noted: Any) -> bool:  # noqa: ANN401
    """Return whether a file beside a record is still the one that the record notes."""
    path = job.place_of(name)
    is_result = path.parent == job.record.parent and path.is_file() and not path.is_symlink()
    return is_result and bool(_fingerprint(path) == noted)


def reason_to_convert(job: Recorded) -> str:
    """Return why a scan is not done, or nothing if it is.

    ``"new"`` without a record; else which of input, settings, version or results is another than
    the record says.
    """
    record = read_record(job)
    if record is None:
        return "new"
    try:
        description = json.loads(json.dumps(job.describe()))
    except OSError:
        return "input cannot be read"
    changes = {"versions": "version", "config": "settings", "source": "options", "inputs": "input"}
    for part, name in changes.items():
        if record.get(part) != description[part]:
            return f"{name} changed"
    for name, noted in record["outputs"].items():
        try:
            if _fingerprint(job.place_of(name)) != noted:
                return f"{name} changed"
        except OSError:
            return f"{name} missing"
    return ""


def _fingerprint(path: Path) -> dict[str, Any]:
    """Return the size and the hash of a file, of an image without the record in it."""
    if _is_image(path):
        image, _ = _split_text(path.read_bytes())
        return {"bytes": len(image), "sha256": hashlib.sha256(image).hexdigest()}
    return {"bytes": path.stat().st_size, "sha256": hash_file(path)}


def _is_image(path: Path) -> bool:
    """Return whether a file is a PNG, which can hold a record beside its pixels."""
    return path.suffix.lower() == ".png"


def _with_text(image: bytes, text: bytes) -> bytes:
    """Return a PNG with a text before its end, which programs that show images pass over."""
    body = _TEXT + text
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return image[:-_END_BYTES] + chunk + image[-_END_BYTES:]


def _split_text(content: bytes) -> tuple[bytes, bytes]:
    """Return a PNG without the text that :func:`_with_text` has put into it, and that text."""
    start = content.rfind(_TEXT)
    text = content[start + len(_TEXT) : -4 - _END_BYTES]
    image = content[: start - 4] + content[-_END_BYTES:]
    return (image, text) if start > 0 and _with_text(image, text) == content else (content, b"")


def _name_below(root: Path, path: Path) -> str:
    """Return a path below the root with forward slashes, or the last part of one elsewhere."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
