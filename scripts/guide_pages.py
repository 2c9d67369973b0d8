"""Guides: pages of Markdown whose examples run while the page is made, with what they print.

Blocks of ``python`` share their names within a page; blocks of ``bash`` hold commands of torchrg,
and ``mkdir``. Both run in a folder of the page alone. Blocks called ``python hidden`` only run, and
what those called ``python page`` print is a part of the page. Blocks of another kind (``console``,
``yaml``, ``text``) are only shown.
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
"""Folder beside the pages that holds what the examples of each of them write."""
BLOCK = re.compile(r"^```(\w+)( hidden| page)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PICTURE = re.compile(r"(!\[[^\]]*\]\()")
_NAME = re.compile(r"`(torchrg(?:\.\w+)*)`")
_MAX_LINES = 40
"""Lines of what a block prints that a page shows."""


def guide_files() -> list[Path]:
    """Return the guides; that of the index comes first."""
    return sorted(GUIDES.glob("*.md"), key=lambda path: (path.stem != "index", path))


def make_page(guide: Path, folder: Path) -> Path:
    """Run the examples of a guide, and write its page, Markdown for Sphinx, into a folder.

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
        elif role is None:
            parts.append(block[0])
            parts.append(_shown(printed) if printed else "")
    page = folder / guide.name
    page.write_text("".join([*parts, _linked(text[end:], guide.stem)]), encoding="utf-8")
    return page


def _linked(prose: str, stem: str) -> str:
    """Return text whose pictures are those that were made, and whose names lead to the reference.

    Example:
        >>> _linked("`torchrg.Cloud`: ![one](a.png)", "guide")
        '{py:obj}`torchrg.Cloud`: ![one](made/guide/a.png)'
    """
    return _NAME.sub(r"{py:obj}`\1`", _PICTURE.sub(rf"\1{MADE}/{stem}/", prose))


def _shown(printed: str) -> str:
    """Return what an example prints as a block below it."""
    lines = printed.splitlines()
    more = [f"... {len(lines) - _MAX_LINES} more lines"] if len(lines) > _MAX_LINES else []
    shown = "\n".join([*lines[:_MAX_LINES], *more])
    return f"\n\n```{{code-block}} text\n:class: printed\n\n{shown}\n```"


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
    return printed.getvalue().rstrip()


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
        os.chdir(before)
