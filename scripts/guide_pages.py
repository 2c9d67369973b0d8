"""Markdown guides with examples that run, and their output.

``python`` blocks share their names within a page; ``bash`` blocks contain commands of torchrg and
``mkdir``. Both run in a separate folder per page. ``python hidden`` blocks run and are not shown,
and the output of ``python page`` blocks is part of the page. ``script`` blocks name a file of this
folder that is shown. Other blocks (``console``, ``yaml``, ``text``) are only shown. Output lacks
the times and paths of the machine that builds the pages.
"""

import contextlib
import io
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchrg.cli import main

GUIDES = Path(__file__).parent / "guides"
MADE = "made"
"""Folder next to the pages with the files that their examples write."""
BLOCK = re.compile(r"^```(\w+)( hidden| page)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_IMAGE = re.compile(r"(!\[[^\]]*\]\()")
_NAME = re.compile(r"`(torchrg(?:\.\w+)*)`")
_TIMES = re.compile(r", [\d.,]+ s(?= -> )|^[\d,]+ points in .* a second\n?", re.MULTILINE)
"""Run times in one-line summaries, and the speed of a conversion."""
_TIME_COLUMN, _CELLS = re.compile(r"  \S+ \(s\)"), re.compile(r"  [\d., ]+")
"""Head of the first time column of a table, and its cells."""
_MAX_LINES = 40
"""Output lines shown per block."""


def guide_files() -> list[Path]:
    """Return the guides, the index first."""
    return sorted(GUIDES.glob("*.md"), key=lambda path: (path.stem != "index", path))


def make_page(guide: Path, folder: Path) -> Path:
    """Run the examples of a guide and write its page as Markdown for Sphinx.

    Raises:
        RuntimeError: If an example fails; the message names its line.
    """
    made = folder / MADE / guide.stem
    made.mkdir(parents=True, exist_ok=True)
    text, names = guide.read_text(encoding="utf-8"), {"__name__": guide.stem}
    parts, end = [], 0
    for block in BLOCK.finditer(text):
        kind, role, lines = block.groups()
        parts.append(_linked(text[end : block.start()], guide.stem))
        end = block.end()
        printed = ""
        if kind in ("python", "bash"):
            where = f"{guide.name}:{text[: block.start()].count(chr(10)) + 2}"
            with _inside(made):
                printed = _run(kind, lines, names, where)
        if role == " page":
            parts.append(printed)
        elif kind == "script":
            shown = (GUIDES.parent / lines.strip()).read_text(encoding="utf-8")
            parts.append(f"```py\n{shown}```")
        elif role is None:
            parts.append(block[0])
            parts.append(_shown(printed) if printed else "")
    page = folder / guide.name
    page.write_text("".join([*parts, _linked(text[end:], guide.stem)]), encoding="utf-8")
    return page


def _linked(prose: str, stem: str) -> str:
    """Return text with paths of generated images, and with names linked to the API reference.

    Example:
        >>> _linked("`torchrg.Cloud`: ![one](a.png)", "guide")
        '{py:obj}`torchrg.Cloud`: ![one](made/guide/a.png)'
    """
    return _NAME.sub(r"{py:obj}`\1`", _IMAGE.sub(rf"\1{MADE}/{stem}/", prose))


def _shown(printed: str) -> str:
    """Return the output of an example as a code block."""
    lines = printed.splitlines()
    more = [f"... {len(lines) - _MAX_LINES} more lines"] if len(lines) > _MAX_LINES else []
    shown = "\n".join([*lines[:_MAX_LINES], *more])
    return f"\n\n```{{code-block}} text\n:class: printed\n\n{shown}\n```"


def _run(kind: str, lines: str, names: dict[str, Any], where: str) -> str:
    """Run a block and return its output."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            if kind == "python":
                exec(compile(lines, where, "exec"), names)  # noqa: S102 (trusted text)
            else:
                for line in re.sub(r"\\\n\s*", " ", lines).splitlines():
                    _run_command(line)
    except (Exception, SystemExit) as error:
        raise RuntimeError(f"{where}: {type(error).__name__}: {error}") from error
    return _portable(printed.getvalue().rstrip())


def _portable(printed: str) -> str:
    r"""Return output without the times and paths of this machine.

    Example:
        >>> print(_portable("scan  points  read (s)\nroom     500       0.1"))
        scan  points
        room     500
        >>> _portable("room.ply: 7 planes, 0.4 s -> planes.npz")
        'room.ply: 7 planes -> planes.npz'
    """
    lines, end = [], None
    for line in _TIMES.sub("", printed.replace(f"{Path.cwd()}{os.sep}", "")).splitlines():
        if start := _TIME_COLUMN.search(line):
            end = start.start()
        elif end is not None and not _CELLS.fullmatch(line[end:]):
            end = None
        lines.append(line[:end])
    return "\n".join(lines)


def _run_command(line: str) -> None:
    """Run a command of torchrg as a shell does; a line may end in a comment."""
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
    except SystemExit as stop:  # --help exits.
        code = int(stop.code or 0)
    if code:
        raise ValueError(f"exit code {code} of {line!r}")


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """Change the working directory temporarily."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
