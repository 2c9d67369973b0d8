"""A folder of results, each computed once by one commit."""

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import surroundings
import torch

from torchrg.io import atomic_path

Record = dict[str, Any]


@dataclass(frozen=True)
class Folder:
    """Where results are kept.

    Args:
        path: The folder; it is made when the first result comes.
    """

    path: Path

    def cell(self, name: str, work: Callable[[], Record], *, needs: Path | None = None) -> Record:
        """Return the record of that name, computed now if this commit has not made it yet.

        A run that was interrupted goes on where it stopped, as records appear whole or not at all.
        Those of other commits are made again: a report is of one.

        Args:
            name: Of the record.
            work: Computes it.
            needs: A file that ``work`` writes beside it, without which the record is of no use.
        """
        path = self.path / "cells" / f"{name}.json"
        if path.exists() and (needs is None or needs.exists()):
            record: Record = json.loads(path.read_text())
            if record["made_with"]["commit"] == made_with()["commit"]:
                return record
        record = {**work(), "made_with": made_with()}
        path.parent.mkdir(parents=True, exist_ok=True)
        self.write(Path("cells") / path.name, json.dumps(record, indent=1))
        return record

    def write(self, name: Path | str, text: str) -> None:
        """Write a text file, whole or not at all."""
        with atomic_path(self.place(name)) as path:
            path.write_text(text, encoding="utf-8")

    def place(self, name: Path | str) -> Path:
        """Return the path of a file, its folder made."""
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target


@functools.cache
def made_with() -> Record:
    """Return versions, commit, processor and threads: what a time depends on."""
    return surroundings.describe(torch.get_num_threads())


def is_committed(commit: str) -> bool:
    """Return whether the code is that of a commit, not of a tree with changes.

    Example:
        >>> is_committed("2f26e94"), is_committed("2f26e94-dirty")
        (True, False)
    """
    return commit not in ("", "unknown") and "-dirty" not in commit


def describe_surroundings(records: list[Record]) -> str:
    """Return how records were made, in one line; several values where they differ."""
    made = [record["made_with"] for record in records]
    values = {
        name: ", ".join(dict.fromkeys(str(one[name]) for one in made))
        for name in made_with()
        if all(name in one for one in made)
    }
    return "; ".join(f"{name} {value}" for name, value in values.items())
