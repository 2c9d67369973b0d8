"""What a part of the report consists of: texts, tables, figures and claims; ready for JSON."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

Block = dict[str, Any]


def text(words: str) -> Block:
    """Return a paragraph."""
    return {"kind": "text", "text": words}


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> Block:
    """Return a table of printed values; ``**bold**`` is bold."""
    return {
        "kind": "table",
        "title": title,
        "head": list(head),
        "rows": [list(row) for row in rows],
        "note": note,
    }


def figure(file: str, caption: str) -> Block:
    """Return a picture, a file beside the report."""
    return {"kind": "figure", "file": file, "caption": caption}


def claim(
    where: str,
    words: str,
    found: Mapping[str, tuple[bool, str]],
    why: str = "",
    *,
    quick_tells: bool = True,
) -> Block:
    """Return a statement, and where it comes out.

    Args:
        where: Its place in the paper.
        words: What it says.
        found: On what it was tried; whether it came out there, and the numbers behind that.
        why: What else is to be known: where it fails, the reason.
        quick_tells: Whether small clouds can tell, too.
    """
    return {
        "where": where,
        "text": words,
        "holds": [place for place, (holds, _) in found.items() if holds],
        "fails": [place for place, (holds, _) in found.items() if not holds],
        "numbers": {place: numbers for place, (_, numbers) in found.items()},
        "why": why,
        "quick_tells": quick_tells,
    }


def verdict(block: Block) -> str:
    """Return whether a claim holds, or where.

    Example:
        >>> verdict(claim("", "", {"a": (True, ""), "b": (False, ""), "c": (True, "")}))
        'holds on 2 of 3: a, c'
    """
    holds, fails = block["holds"], block["fails"]
    if not holds or not fails:
        return "holds" if holds else "does not"
    return f"holds on {len(holds)} of {len(holds) + len(fails)}: {', '.join(holds)}"


def section(
    title: str,
    blocks: Sequence[Block],
    records: Any,  # noqa: ANN401
    claims: Sequence[Block] = (),
) -> dict[str, Any]:
    """Return a part of the report, with the records that it was made from."""
    return {"title": title, "blocks": list(blocks), "claims": list(claims), "records": records}


def rising(values: Iterable[float | None], form: str) -> tuple[bool, str]:
    """Return whether values rise, and how they are printed.

    Example:
        >>> rising([0.1, 0.3, 0.2], ".2f")
        (False, '0.10, 0.30, 0.20')
    """
    values = list(values)
    if None in values:
        return False, ", ".join("-" if value is None else format(value, form) for value in values)
    ordered = all(low < high for low, high in pairwise(values))
    return ordered, (" < " if ordered else ", ").join(format(value, form) for value in values)


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
