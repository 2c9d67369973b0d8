"""Provenance records: which files torchrg wrote for a scan, and from what.

``provenance.json`` in the folder of a scan is first a claim on files that may appear (``claims``),
and last the record of complete files (``outputs``). Files that it does not name are never changed.
The records in an output directory are its index.
"""

import json
import os
from collections.abc import Iterable
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrg import kernels, version
from torchrg.config import DepthConfig, NormalsConfig, PipelineConfig
from torchrg.errors import FormatError
from torchrg.io.files import PARSE_ERRORS, atomic_path, first_line, hash_file, is_unchanged
from torchrg.io.result import RECORD

Record = dict[str, Any]
"""A record, or a part of one, as JSON values."""


def describe_versions() -> dict[str, str]:
    """Return the versions of the software that determines results."""
    return {
        "torchrg": version.__version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "scipy": import_module("scipy").__version__,
        "kernels": "none" if kernels.name_of_library() is None else "C++",
    }


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig | DepthConfig) -> Record:
    """Return the provenance of a result of one file, as JSON values."""
    return {
        "versions": describe_versions(),
        "config": asdict(settings),
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }


def read_record(folder: Path, *, strict: bool = False) -> Record | None:
    """Return the record or claim in a folder, or None if there is none of torchrg.

    With ``strict``, a corrupt file raises FormatError, because it may be a record of torchrg.
    """
    try:
        content = json.loads((folder / RECORD).read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, *PARSE_ERRORS) as error:
        if not strict:
            return None
        raise FormatError(
            f"{folder / RECORD}: expected JSON, got: {first_line(error)}; move it, or its folder."
        ) from error
    content = content if isinstance(content, dict) else {}
    keys = ("claims",) if "claims" in content else ("outputs", "versions")
    is_record = isinstance(content.get("pages", []), list)
    return content if is_record and all(isinstance(content.get(k), dict) for k in keys) else None


def write_record(folder: Path, record: Record) -> None:
    """Write a record or claim atomically."""
    with atomic_path(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def owned_files(record: Record | None) -> dict[str, Record | None]:
    """Return the fingerprints of the files of a record or claim; None for any content."""
    record = record or {}
    return {**(record.get("claims") or record.get("outputs") or {})}


def claim_files(record: Record, names: Iterable[str]) -> Record:
    """Return a record as a claim on its files, and on files with these names of any content."""
    described = {key: value for key, value in record.items() if key != "outputs"}
    return described | {"claims": owned_files(record) | dict.fromkeys(names)}


def check_owned(folder: Path, names: Iterable[str], record: Record | None) -> None:
    """Raise FormatError if a file with one of the names exists, and is not of the record."""
    owned = {*owned_files(record), *([] if record is None else [RECORD])}
    for name in names:
        path = Path(os.path.normpath(folder / name))
        if name not in owned and os.path.lexists(path):
            raise FormatError(
                f"{path}: was not written by torchrg for this scan; move it, or choose another."
            )


def check_source(folder: Path, record: Record, source: Record) -> None:
    """Raise FormatError if a record in a folder is of another layout or kind of data set."""
    earlier = record.get("source")
    earlier = earlier if isinstance(earlier, dict) else {}
    for what, old, new in (
        ("in layout", _layout(earlier), _layout(source)),
        ("of convert", earlier.get("kind"), source.get("kind")),
    ):
        if old != new and old is not None and new is not None:
            raise FormatError(
                f"{folder}: expected results {what} {new}, got {old}; choose another directory."
            )


def _layout(source: Record) -> object:
    """Return an output layout, which has a version; the layout of depth frames is an input's."""
    return source.get("layout") if "version" in source else "pointcept"


def recorded_paths(out: Path, folder: Path, record: Record | None) -> dict[Path, Record | None]:
    """Return the files of a record in a folder by path, without files outside ``out``."""
    files = owned_files(record).items()
    paths = {Path(os.path.normpath(folder / name)): stored for name, stored in files}
    return {path: stored for path, stored in paths.items() if path.is_relative_to(out)}


def remove_unwritten(
    out: Path, folder: Path, record: Record | None, written: Iterable[str]
) -> list[str]:
    """Remove the files of an earlier record that were not written again.

    Returns the names of files that were changed since, which are kept.
    """
    paths = {Path(os.path.normpath(folder / name)) for name in written}
    changed = []
    for path, stored in sorted(recorded_paths(out, folder, record).items()):
        if path not in paths and os.path.lexists(path):
            if is_unchanged(path, stored):
                path.unlink()
            else:
                changed.append(os.path.relpath(path, folder))
    return changed
