"""What a result was made from: versions, settings, input; no times, so equal runs are equal."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch

from torchrg.config import NormalsConfig, PipelineConfig


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig) -> dict[str, Any]:
    """Return what is needed to make a result of one file again, ready for JSON.

    Args:
        source: The input file.
        settings: The resolved settings.

    Returns:
        Versions, settings, name and SHA-256 of the input, device.
    """
    return {
        "versions": describe_versions(),
        "config": dataclasses.asdict(settings),
        "input": {"name": source.name, "sha256": hash_file(source)},
        "device": "cpu",
    }


def describe_versions() -> dict[str, str]:
    """Return the versions of what decides a result.

    Example:
        >>> sorted(describe_versions())
        ['numpy', 'scipy', 'torch', 'torchrg']
    """
    from torchrg import __version__

    return {
        "torchrg": __version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
