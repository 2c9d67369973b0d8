"""What a result was made from: versions, settings, input; no times, so equal runs are equal."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch

from torchrg import __version__
from torchrg.config import NormalsConfig, PipelineConfig


def describe_run(source: Path, settings: PipelineConfig | NormalsConfig) -> dict[str, Any]:
    """Return what is needed to make a result again, ready for JSON.

    Args:
        source: The input file.
        settings: The resolved settings.

    Returns:
        Versions, settings, name and SHA-256 of the input, device.
    """
    with source.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "versions": {
            "torchrg": __version__,
            "torch": torch.__version__,
            "numpy": np.__version__,
            "scipy": scipy.__version__,
        },
        "config": dataclasses.asdict(settings),
        "input": {"name": source.name, "sha256": digest},
        "device": "cpu",
    }
