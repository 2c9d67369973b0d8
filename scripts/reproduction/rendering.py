"""A report as HTML and as Markdown."""

import html
import re
from collections.abc import Mapping
from typing import Any

from reproduction.sections import Block

STYLE = """
body { font: 16px/1.5 Georgia, serif; color: #222; max-width: 72rem; margin: 2rem auto;
       padding: 0 1rem }
h1, h2 { font-weight: normal }
h2 { border-top: 1px solid #999; padding-top: 1.5rem; margin-top: 3rem }
table { border-collapse: collapse; margin: .5rem 0; font: 14px/1.4 system-ui, sans-serif;
        border-top: 2px solid #222; border-bottom: 2px solid #222 }
th, td { padding: .2rem .8rem; text-align: right }
th:first-child, td:first-child { text-align: left }
thead { border-bottom: 1px solid #222 }
.wide { overflow-x: auto }
caption, figcaption, .note { font-size: 15px; text-align: left }
caption { padding: .4rem 0 }
figure { margin: 2rem 0 }
img { max-width: 100% }
.note, .made { color: #555 }
.made { font-size: 14px }
.claim { border-left: 5px solid #2a7f3f; padding: .3rem 1rem; margin: 1rem 0; background: #f6faf6 }
.fails { border-color: #c44e52; background: #fdf5f5 }
.claim b { font-family: system-ui, sans-serif }
"""


def to_html(report: Mapping[str, Any]) -> str:
    """Return a report as one page; its pictures are files beside it."""
    parts = [f"<h1>{html.escape(report['title'])}</h1>", f"<p>{html.escape(report['intro'])}</p>"]
    parts.append(f"<p class=made>{html.escape(report['made_with'])}</p>")
    if len(report["parts"]) > 1:
        links = (f"<li><a href='#{name}'>{part['title']}</a>" for name, part in _parts(report))
        parts.append(f"<ul>{''.join(links)}</ul>")
    for name, part in _parts(report):
        parts.append(f"<h2 id='{name}'>{html.escape(part['title'])}</h2>")
        parts += [_BLOCKS_IN_HTML[block["kind"]](block) for block in part["blocks"]]
    head = f"<meta charset='utf-8'><title>{html.escape(report['title'])}</title>"
    head += f"<style>{STYLE}</style>"
    body = "\n".join(parts)
    return f"<!doctype html><html lang='en'><head>{head}</head>\n<body>\n{body}\n</body></html>\n"


def to_markdown(report: Mapping[str, Any]) -> str:
    """Return a report as Markdown."""
    parts = [f"# {report['title']}", report["intro"], report["made_with"]]
    for _, part in _parts(report):
        parts.append(f"## {part['title']}")
        parts += [_BLOCKS_IN_MARKDOWN[block["kind"]](block) for block in part["blocks"]]
    return "\n\n".join(parts) + "\n"


def _parts(report: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return list(report["parts"].items())


def markdown_table(block: Block) -> str:
    """Return a table in Markdown, with its title and its note."""
    columns = len(block["head"])
    lines = [block["head"], ["---", *["--:"] * (columns - 1)], *block["rows"]]
    rows = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return "\n\n".join(filter(None, [block["title"], rows, block["note"]]))


def _markdown_claim(block: Block) -> str:
    word = "Comes out" if block["holds"] else "Does not come out"
    return " ".join(
        filter(None, [f"> **{word}:** {block['text']}", block["numbers"], block["why"]])
    )


def _html_claim(block: Block) -> str:
    word, kind = ("Comes out", "") if block["holds"] else ("Does not come out", " fails")
    words = " ".join(_inline(block[key]) for key in ("text", "numbers", "why"))
    return f"<p class='claim{kind}'><b>{word}:</b> {words}</p>"


def _html_table(block: Block) -> str:
    head = "".join(f"<th>{_inline(cell)}</th>" for cell in block["head"])
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{_inline(cell)}</td>" for cell in row) + "</tr>"
        for row in block["rows"]
    )
    title = f"<caption>{_inline(block['title'])}</caption>" if block["title"] else ""
    note = f"<p class=note>{_inline(block['note'])}</p>" if block["note"] else ""
    body = f"<table>{title}<thead><tr>{head}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"
    return f"<div class=wide>{body}</div>{note}"


def _html_figure(block: Block) -> str:
    file, caption = html.escape(block["file"]), _inline(block["caption"])
    picture = f"<a href='{file}'><img src='{file}' alt=''></a>"
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _inline(words: str) -> str:
    """Return words for HTML: escaped, bold where there are two stars around."""
    return re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", html.escape(words))


_BLOCKS_IN_HTML = {
    "text": lambda block: f"<p>{_inline(block['text'])}</p>",
    "claim": _html_claim,
    "table": _html_table,
    "figure": _html_figure,
}
_BLOCKS_IN_MARKDOWN = {
    "text": lambda block: block["text"],
    "claim": _markdown_claim,
    "table": markdown_table,
    "figure": lambda block: f"![{block['file']}]({block['file']})\n\n{block['caption']}",
}
