"""Reference page of the commands, generated from their parsers; see ``guides/commands.md``."""

import importlib
import re
from collections.abc import Iterator

from torchrg.cli import COMMANDS, convert
from torchrg.cli.arguments import REQUIRED, Flag, describe, example_lines, group_flags, list_flags
from torchrg.cli.settings import flags_by_section
from torchrg.config import load_config

PROGS: dict[str, type] = {
    f"torchrg {name}": importlib.import_module(f"torchrg.cli.{name}").Arguments
    for name in COMMANDS
    if name != "convert"
} | {f"torchrg convert {name}": kind for name, kind in convert.KINDS.items()}
"""Arguments class of each command."""


def command_page() -> str:
    """Return a section for each command: description, examples, options; then the settings."""
    blocks = [line for prog, kind in PROGS.items() for line in _section(prog, kind)]
    blocks.append("## Settings")
    for section, flags in flags_by_section(load_config()).items():
        program = f"```{{program}} torchrg settings {section}\n```"
        blocks += [f"### {section}", program, *map(_option, flags)]
    return "\n\n".join(blocks)


def flags_of(kind: type) -> list[Flag]:
    """Return the options of a command, without settings."""
    return [flag for flag in list_flags(kind) if not flag.section]


def _section(prog: str, kind: type) -> Iterator[str]:
    """Yield the paragraphs on a command; its arguments can be searched and linked."""
    groups = group_flags(flags_of(kind))
    needed = " ".join(flag.spelling for flag in groups.get(REQUIRED, ()))
    yield f"## {prog}"
    yield _escaped(describe(kind))
    yield f"```text\n{prog} {needed} [options]\n```"
    yield "\n".join(["Examples:", "", "```console", *example_lines(kind), "```"])
    yield f"```{{program}} {prog}\n```"
    for title, flags in groups.items():
        yield f"```{{rubric}} {title[0].upper()}{title[1:]}\n```"
        yield from map(_option, flags)


def _option(flag: Flag) -> str:
    """Return an option or setting with its text."""
    return f"```{{option}} {flag.spelling}\n\n{_escaped(flag.text)}\n```"


def _escaped(text: str) -> str:
    """Escape plain text for Markdown."""
    return re.sub(r"([\\*_`<>\[\]#])", r"\\\1", text)
