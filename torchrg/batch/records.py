"""Provenance records, used to skip up-to-date scans."""

import dataclasses
import json
from pathlib import Path

from torchrg.batch.scans import Job
from torchrg.config import DepthConfig, NormalsConfig, PipelineConfig
from torchrg.datasets.provenance import Record, describe_versions, read_record
from torchrg.errors import FormatError
from torchrg.io.files import fingerprint, hash_file
from torchrg.io.result import RECORD as RECORD

_RESULTS = {"points": int, "regions": int, "repairs": list, "warnings": list}
"""Types of the record entries that reports repeat."""


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig | DepthConfig) -> Record:
    """Return the provenance of a result of one file, as JSON values."""
    return {
        "versions": describe_versions(),
        "config": dataclasses.asdict(settings),
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }


def reason_to_convert(job: Job) -> str:
    """Return why a scan must be converted, or "" if it is up to date.

    ``"new"`` without a complete record; else the first of version, settings, options, input or
    results that differs from the record, or that the record is damaged.
    """
    record = read_record(job.folder)
    if record is None or "outputs" not in record:
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
