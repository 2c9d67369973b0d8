"""A report as HTML, by the template ``report.html.jinja`` beside this file, and as Markdown."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined

from reproduction.sections import Block, verdict

TEMPLATE = Path(__file__).with_name("report.html.jinja")


def to_html(report: Mapping[str, Any]) -> str:
    """Return a report as one page; its pictures are files beside it."""
    environment = Environment(autoescape=True, trim_blocks=True, undefined=StrictUndefined)
    environment.globals = {"verdict": verdict, "figures": _figures}
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(report)


def to_markdown(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown."""
    paragraphs = [f"# {report['title']}", report["intro"], report["made_with"]]
    paragraphs.append(_claims_in_markdown(report["claims"]))
    for part in report["parts"].values():
        paragraphs.append(f"## {part['title']}")
        paragraphs += [_IN_MARKDOWN[block["kind"]](block) for block in part["blocks"]]
    return "\n\n".join(paragraphs) + "\n"


def markdown_table(block: Block) -> str:
    """Return a table in Markdown, with its title and its note."""
    columns = len(block["head"])
    lines = [block["head"], ["---", *["--:"] * (columns - 1)], *block["rows"]]
    rows = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return "\n\n".join(filter(None, [block["title"], rows, block["note"]]))


def _claims_in_markdown(claims: Sequence[Block]) -> str:
    """Return a line for each claim."""
    lines = ["| in the paper | claim | verdict | figures |", "| --- | --- | --- | --- |"]
    for claim in claims:
        cells = [claim["where"], claim["text"], f"**{verdict(claim)}**", _figures(claim)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figures(claim: Block) -> str:
    """Return the numbers behind a claim, and what else is to be known."""
    numbers = "; ".join(f"{place}: {number}" for place, number in claim["numbers"].items())
    return f"{numbers}. {claim['why']}".strip()


_IN_MARKDOWN = {
    "text": lambda block: block["text"],
    "table": markdown_table,
    "figure": lambda block: f"![{block['file']}]({block['file']})\n\n{block['caption']}",
}
