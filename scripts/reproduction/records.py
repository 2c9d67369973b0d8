"""Records computed once per commit, and the blocks of the report made from them."""

import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import surroundings
import torch

from torchrg.io.files import atomic_path

Record = dict[str, Any]
Block = dict[str, Any]
"""A paragraph, table, figure or claim of the report, ready for JSON."""

Outcome = tuple[bool, str]
"""Whether a claim holds in one place, and the numbers behind it."""


@dataclass(frozen=True)
class Folder:
    """Output folder, created with the first result."""

    path: Path

    def cell(
        self, name: str, compute: Callable[[], Record], *, needs: Path | None = None
    ) -> Record:
        """Return the record of that name, computed unless this commit has already made it.

        Records are written atomically, so an interrupted run resumes. Records of other commits are
        computed again, because a report describes a single commit.

        Args:
            name: Name of the record.
            compute: Function that computes it.
            needs: Second output file of ``compute``; if it is missing, the record is not used.
        """
        path = self.path / "cells" / f"{name}.json"
        if path.exists() and (needs is None or needs.exists()):
            record: Record = json.loads(path.read_text())
            if record["made_with"]["commit"] == made_with()["commit"]:
                return record
        record = {**compute(), "made_with": made_with()}
        self.write(f"cells/{name}.json", json.dumps(record, indent=1))
        return record

    def write(self, name: str, text: str) -> None:
        """Write a text file atomically."""
        with atomic_path(self.path_of(name)) as path:
            path.write_text(text, encoding="utf-8")

    def path_of(self, name: str) -> Path:
        """Return the path of a file, and create its folder."""
        target = self.path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target


@functools.cache
def made_with() -> Record:
    """Return versions, commit, processor and threads, which run times depend on."""
    return surroundings.describe(torch.get_num_threads())


def is_committed(commit: str) -> bool:
    """Return whether a name denotes one commit, without local changes.

    Example:
        >>> is_committed("2f26e94"), is_committed("2f26e94-dirty"), is_committed("2f26e94, ad1e777")
        (True, False, False)
    """
    return commit not in ("", "unknown") and "-dirty" not in commit and "," not in commit


def describe_surroundings(records: list[Record]) -> str:
    """Return how records were made, in one line; several values where they differ."""
    made = [record["made_with"] for record in records]
    values = {
        name: ", ".join(dict.fromkeys(str(one[name]) for one in made))
        for name in made_with()
        if all(name in one for one in made)
    }
    return "; ".join(f"{name} {value}" for name, value in values.items())


def text(words: str) -> Block:
    """Return a paragraph."""
    return {"kind": "text", "text": words}


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> Block:
    """Return a table of printed values; ``**bold**`` is bold."""
    rows = [list(row) for row in rows]
    return {"kind": "table", "title": title, "head": list(head), "rows": rows, "note": note}


def figure(file: str, caption: str) -> Block:
    """Return an image, a file next to the report."""
    return {"kind": "figure", "file": file, "caption": caption}


def claim(
    where: str,
    words: str,
    found: Mapping[str, Outcome | None],
    note: str = "",
    why: Callable[[list[str]], str] | None = None,
    *,
    quick_tells: bool = True,
) -> Block:
    """Return a claim with its outcomes.

    Args:
        where: Place in the paper.
        words: What the paper claims.
        found: Outcome by place, such as a cloud; None where a value is missing, which is skipped.
        note: What the numbers are.
        why: Function that computes a reason from the places where the claim fails; called only if
            there are any.
        quick_tells: Whether small clouds are large enough for a verdict.
    """
    tried = {place: outcome for place, outcome in found.items() if outcome is not None}
    fails = [place for place, (holds, _) in tried.items() if not holds]
    return {
        "where": where,
        "text": words,
        "holds": [place for place, (holds, _) in tried.items() if holds],
        "fails": fails,
        "numbers": {place: numbers for place, (_, numbers) in tried.items()},
        "note": note,
        "why": why(fails) if why and fails else "",
        "quick_tells": quick_tells,
    }


def verdict(block: Block) -> str:
    """Return whether a claim holds, or where.

    Example:
        >>> verdict(claim("", "", {"a": (True, ""), "b": (False, ""), "c": (True, "")}))
        'holds on 2 of 3: a, c'
        >>> verdict(claim("", "", {"a": None}))
        'not tried'
    """
    holds, fails = block["holds"], block["fails"]
    if holds and fails:
        return f"holds on {len(holds)} of {len(holds) + len(fails)}: {', '.join(holds)}"
    return "holds" if holds else "does not hold" if fails else "not tried"


def section(
    title: str,
    blocks: Sequence[Block],
    records: Any,  # noqa: ANN401
    claims: Sequence[Block] = (),
) -> Record:
    """Return a part of the report, with the records behind it."""
    return {"title": title, "blocks": list(blocks), "claims": list(claims), "records": records}


def rising(values: Iterable[float | None], form: str) -> Outcome | None:
    """Return whether values rise, and how they are printed; None if one is missing.

    Example:
        >>> rising([0.1, 0.3, 0.2], ".2f")
        (False, '0.10, 0.30, 0.20')
    """
    values = list(values)
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    ordered = all(low < high for low, high in pairwise(known))
    return ordered, (" < " if ordered else ", ").join(format(value, form) for value in known)


def mark_best(values: Sequence[float | None], form: str, *, higher: bool | None) -> list[str]:
    """Return printed numbers, the best bold unless all are equal, and a dash for missing ones.

    Example:
        >>> mark_best([1.0, None, 2.0], ".1f", higher=True)
        ['1.0', '-', '**2.0**']
    """
    shown = ["-" if value is None else format(value, form) for value in values]
    known = [value for value in values if value is not None]
    if higher is None or len(set(shown) - {"-"}) < 2:
        return shown
    best = format(max(known) if higher else min(known), form)
    return [f"**{word}**" if word == best else word for word in shown]
