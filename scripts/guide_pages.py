"""Guides: pages of Markdown whose examples run while the page is made, with what they print.

Blocks of ``python`` share their names within a page; blocks of ``bash`` hold commands of torchrg,
and ``mkdir``. Both run in the folder in which the page is made, so that it shows the pictures that
they draw. Blocks of another kind (``console``, ``yaml``, ``text``) are only shown, and those called
``python hidden`` only run.
"""

import contextlib
import html
import io
import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pdoc

from torchrg.cli import main

GUIDES = Path(__file__).parent / "guides"
_BLOCK = re.compile(r"^```(\w+)( hidden)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_MOST_LINES = 40
"""Lines of what a block prints that a page shows."""
_SHELL = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 52rem; margin: 2rem auto; }}
img {{ max-width: 100%; }} table {{ border-collapse: collapse; }}
td, th {{ border: 1px solid #ccc; padding: .2rem .6rem; text-align: left; vertical-align: top; }}
pre {{ background: #f6f6f4; padding: .6rem; overflow-x: auto; }} code {{ font-size: 90%; }}
pre.printed {{ background: none; border-left: 3px solid #ccc; margin-top: -.6rem; }}
</style></head><body><nav><a href="{home}">torchrg</a></nav>
{body}
</body></html>
"""


def guide_files() -> list[Path]:
    """Return the guides in the order of the index."""
    order = re.findall(r"\]\(guides/([\w-]+)\.html", (GUIDES / "index.md").read_text("utf-8"))
    return [GUIDES / f"{name}.md" for name in order]


def make_guide(guide: Path, folder: Path, modules: set[str]) -> Path:
    """Run the examples of a guide in a folder, and write its page there.

    Args:
        guide: The Markdown.
        folder: Where the page goes, and where the examples run.
        modules: Names of the modules that have a page in the folder above; names in them become
            links.

    Raises:
        RuntimeError: If an example fails; the message names its line.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text, names = guide.read_text(encoding="utf-8"), {"__name__": guide.stem}
    parts, end = [], 0
    for block in _BLOCK.finditer(text):
        kind, lines = block[1], block[3]
        parts.append(text[end : block.start() if block[2] else block.end()])
        end = block.end()
        if kind in ("python", "bash"):
            where = f"{guide.name}:{text[: block.start()].count(chr(10)) + 2}"
            with _inside(folder):
                printed = _run(kind, lines, names, where)
            if printed:
                parts.append(f'\n\n<pre class="printed">{html.escape(printed)}</pre>\n')
    page = folder / f"{guide.stem}.html"
    page.write_text(render("".join([*parts, text[end:]]), modules, home="../"), encoding="utf-8")
    return page


def names_in(markdown: str) -> list[str]:
    """Return the dotted names of torchrg in backquotes, which become links."""
    return re.findall(r"`(torchrg(?:\.\w+)*)`", _BLOCK.sub("", markdown))


def render(markdown: str, modules: set[str], *, home: str = "") -> str:
    """Return a page of Markdown; names of torchrg in backquotes lead to the reference."""
    title = markdown.partition("\n")[0].lstrip("# ")
    body = str(pdoc.render_helpers.to_html(markdown))

    def link(match: re.Match[str]) -> str:
        place = place_of(match[1], modules)
        return f'<a href="{home}{place}">{match[0]}</a>' if place else match[0]

    body = re.sub(r"<code>(torchrg(?:\.\w+)*)</code>", link, body)
    return _SHELL.format(title=html.escape(title), body=body, home=f"{home}index.html")


def place_of(name: str, modules: set[str]) -> str:
    """Return page and anchor of a dotted name in the reference; empty if it has none.

    Example:
        >>> place_of("torchrg.config.NormalsConfig.k", {"torchrg", "torchrg.config"})
        'torchrg/config.html#NormalsConfig.k'
    """
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        module = ".".join(parts[:count])
        if module in modules:
            anchor = ".".join(parts[count:])
            return f"{module.replace('.', '/')}.html" + (f"#{anchor}" if anchor else "")
    return ""


def _run(kind: str, lines: str, names: dict[str, Any], where: str) -> str:
    """Run a block and return what it prints."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            if kind == "python":
                exec(compile(lines, where, "exec"), names)  # noqa: S102 (our own text)
            else:
                for line in re.sub(r"\\\n\s*", " ", lines).splitlines():
                    _run_command(line)
    except (Exception, SystemExit) as error:
        raise RuntimeError(f"{where}: {type(error).__name__}: {error}") from error
    shown = printed.getvalue().rstrip().splitlines()
    more = [f"... {len(shown) - _MOST_LINES} more lines"] if len(shown) > _MOST_LINES else []
    return "\n".join([*shown[:_MOST_LINES], *more])


def _run_command(line: str) -> None:
    """Run a command of torchrg as a shell would; a line may end in a comment."""
    words = shlex.split(line, comments=True)
    if words[:1] == ["mkdir"]:
        for name in words[1:]:
            Path(name).mkdir(parents=True, exist_ok=True)
    if not words or words[0] == "mkdir":
        return
    if words[0] != "torchrg":
        raise ValueError(f"expected a command of torchrg, got {line!r}")
    try:
        code = main(words[1:])
    except SystemExit as stop:  # As --help does.
        code = int(stop.code or 0)
    if code:
        raise ValueError(f"exit code {code} of {line!r}")


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """Work in a folder for a while."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.chdir(before)
