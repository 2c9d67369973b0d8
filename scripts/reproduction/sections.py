"""What a part of the report consists of: texts, claims, tables, figures; ready for JSON."""

from collections.abc import Sequence
from typing import Any

Block = dict[str, Any]


def text(words: str) -> Block:
    """Return a paragraph."""
    return {"kind": "text", "text": words}


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> Block:
    """Return a table of printed values; ``**bold**`` is bold."""
    return {
        "kind": "table",
        "title": title,
        "head": list(head),
        "rows": [list(row) for row in rows],
        "note": note,
    }


def figure(file: str, caption: str, page: str = "") -> Block:
    """Return a picture, a file beside the report, and the page that it leads to, if any."""
    return {"kind": "figure", "file": file, "caption": caption, "page": page}


def claim(words: str, holds: bool, numbers: str, why: str = "") -> Block:
    """Return a statement of the paper, whether it came out here, and the numbers behind that."""
    return {"kind": "claim", "text": words, "holds": bool(holds), "numbers": numbers, "why": why}


def section(title: str, blocks: Sequence[Block], records: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return a part of the report, with the records that it was made from."""
    return {"title": title, "blocks": list(blocks), "records": records}


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
