"""A folder of results, each computed once."""

import json
import os
import platform
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch

from torchrg import __version__
from torchrg.io import atomic_path

Record = dict[str, Any]


@dataclass(frozen=True)
class Folder:
    """Where the results of a part are kept.

    Args:
        path: The folder; it is made when the first result comes.
    """

    path: Path

    def cell(self, name: str, work: Callable[[], Record]) -> Record:
        """Return the record of that name, computed now if it is not there yet.

        A run that was interrupted goes on where it stopped, as records appear whole or not at all.
        """
        path = self.path / "cells" / f"{name}.json"
        if path.exists():
            record: Record = json.loads(path.read_text())
            return record
        record = {**work(), "made_with": surroundings()}
        path.parent.mkdir(parents=True, exist_ok=True)
        self.write(Path("cells") / path.name, json.dumps(record, indent=1))
        return record

    def write(self, name: Path | str, text: str) -> None:
        """Write a text file, whole or not at all."""
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as path:
            path.write_text(text, encoding="utf-8")


def surroundings() -> Record:
    """Return versions, commit, processor and threads: what a time depends on."""
    here = Path(__file__).parent
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=here,
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "torchrg": __version__,
        "commit": git.stdout.strip() or "unknown",
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }


def _processor() -> str:
    """Return the name of the processor."""
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
