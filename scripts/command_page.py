"""Reference page of the commands, generated from their parsers; see ``guides/commands.md``."""

import dataclasses
import importlib
import re
from collections.abc import Iterator

from torchrg.cli import COMMANDS, convert
from torchrg.cli.arguments import REQUIRED, Flag, describe, example_lines, group_flags, list_flags
from torchrg.cli.flags import PlaneSettings

PROGS: dict[str, type] = {
    f"torchrg {name}": importlib.import_module(f"torchrg.cli.{name}").Arguments
    for name in COMMANDS
    if name != "convert"
} | {f"torchrg convert {name}": kind for name, kind in convert.KINDS.items()}
"""Arguments class of each command."""


def command_page() -> str:
    """Return a section for each command: description, examples, and arguments."""
    return "\n\n".join(line for prog, kind in PROGS.items() for line in _section(prog, kind))


def flags_of(kind: type) -> list[Flag]:
    """Return the arguments of a command; defaults of settings come from the preset."""
    start = None
    if "settings" in {field.name for field in dataclasses.fields(kind)}:
        start = {"settings": PlaneSettings.from_arguments([])}
    return list(list_flags(kind, start))


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
        for flag in flags:
            yield f"```{{option}} {flag.spelling}\n\n{_escaped(flag.text)}\n```"


def _escaped(text: str) -> str:
    """Escape plain text for Markdown."""
    return re.sub(r"([\\*_`<>\[\]#])", r"\\\1", text)
