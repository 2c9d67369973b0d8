"""What ``--help`` prints: what is needed, what is often wanted, the rest by part, examples."""

import ast
import dataclasses
import inspect
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import tyro

OFTEN = frozenset(
    {
        "--normals.method",
        "--normals.k",
        "--growing.max-angle-deg",
        "--growing.min-size",
        "--growing.max-distance",
        "--planes.up",
        "--depth.noise",
        "--depth.max-depth",
        "--depth.min-size",
    }
)
"""Settings of parts that are often changed; the others come after everything else."""
RESOURCES = (
    "--workers",
    "--threads",
    "--limit-memory",
    "--workdir",
    "--chunk-size",
    "--engine",
    "--ray-address",
)
"""What decides where and how fast a command runs, never what it finds."""
_RUNNING = "how it runs, without effect on what is found"
_EXAMPLES = "\n\nExamples:\n"
_WIDEST = 100
_INDENT = " " * 6
_WORDS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


@dataclass(frozen=True)
class Flag:
    """An argument of a command: how it is written, what it does, the part it belongs to."""

    spelling: str
    text: str
    part: str
    is_needed: bool

    @property
    def name(self) -> str:
        """The flag alone, or the name of what has none."""
        return self.spelling.split(" ")[0].rstrip(",")


def format_help(kind: type, *, prog: str, default: Any = None) -> str:  # noqa: ANN401
    """Return what a command that is parsed into a dataclass says about itself.

    The docstring of the class is the description; the lines of its section "Examples" come last.
    Defaults are those of the class, or of the instance that is given.
    """
    description, _, examples = (inspect.getdoc(kind) or "").partition(_EXAMPLES)
    flags = list(list_flags(kind, default))
    groups: dict[str, list[Flag]] = {title: [] for title in ("needed", "options", _RUNNING)}
    for flag in flags:
        if flag.is_needed:
            group = "needed"
        elif flag.name in RESOURCES:
            group = _RUNNING
        elif not flag.part or flag.name in OFTEN:
            group = "options"
        else:
            group = f"seldom needed: {flag.part}"
        groups.setdefault(group, []).append(flag)
    # What has no flag comes first, in the order in which it is written.
    groups["needed"].sort(key=lambda flag: flag.name.startswith("-"))
    groups[_RUNNING].sort(key=lambda flag: RESOURCES.index(flag.name))
    usage = " ".join(["usage:", prog, *(f.spelling for f in groups["needed"]), "[options]"])
    blocks = [usage, *(_wrap(paragraph) for paragraph in plain(description).split("\n\n"))]
    for title, members in groups.items():
        if members:
            entries = [f"  {f.spelling}\n{_wrap(f.text, _INDENT)}" for f in members]
            blocks.append("\n".join([f"{title}:", *entries]))
    if examples:
        blocks.append("\n".join(["examples:", *(f"  {line}" for line in example_lines(kind))]))
    return "\n\n".join(blocks)


def example_lines(kind: type) -> list[str]:
    """Return the lines of the section "Examples" of a docstring."""
    _, _, lines = (inspect.getdoc(kind) or "").partition(_EXAMPLES)
    return textwrap.dedent(lines).splitlines()


def list_flags(
    kind: Any,  # noqa: ANN401
    default: Any = None,  # noqa: ANN401
    prefix: str = "",
    part: str = "",
) -> Iterator[Flag]:
    """Yield the arguments that the fields of a dataclass become, in their order.

    Args:
        kind: The dataclass; fields that are dataclasses are parts.
        default: Values instead of the defaults of the class.
        prefix: What stands before the names of flags.
        part: What the flags are about, empty for the command itself.
    """
    texts, hints = _texts(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, *notes = [hints[field.name]]
        if typing.get_origin(hint) is typing.Annotated:
            hint, *notes = typing.get_args(hint)
        metavar, help_text, name = (
            next((found for note in notes if (found := getattr(note, key, None)) is not None), None)
            for key in ("metavar", "help", "name")
        )
        value = _value(field, default)
        if dataclasses.is_dataclass(hint):
            inner = prefix if name == "" else f"{prefix}{field.name}."
            about = part if name == "" else _first_line(hint)
            yield from list_flags(hint, value, inner, about)
            continue
        text = plain(help_text or texts.get(field.name, ""))
        if "Default:" not in text:
            text = f"{text} {_said(value, is_setting=bool(prefix))}".strip()
        if tyro.conf.Positional in notes:
            dots = "..." if typing.get_origin(hint) is tuple else ""
            yield Flag(f"{metavar or field.name.upper()}{dots}", text, part, True)
        else:
            spelling = _spelled(f"{prefix}{field.name}", hint, metavar, value)
            yield Flag(spelling, text, part, _is_missing(value))


def plain(text: str) -> str:
    """Return a docstring without markup.

    Example:
        >>> plain("With ``absorb``; see :func:`torchrg.segment_planes`.")
        'With absorb; see torchrg.segment_planes.'
    """
    return _ROLE.sub(r"\1", text).replace("`", "")


def _texts(kind: type) -> dict[str, str]:
    """Return the docstrings below the fields of a dataclass and of its bases."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = getattr(node, "body", [])
        for field, below in pairwise(body):
            is_field = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if is_field and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                texts[field.target.id] = " ".join(str(below.value.value).split())
    return texts


def _value(field: "dataclasses.Field[Any]", default: Any) -> Any:  # noqa: ANN401
    """Return what a field is where no flag says otherwise."""
    if default is not None:
        return getattr(default, field.name)
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def _is_missing(value: Any) -> bool:  # noqa: ANN401
    """Return whether a value has to be given."""
    return value is dataclasses.MISSING or value is tyro.MISSING


def _said(value: Any, *, is_setting: bool) -> str:  # noqa: ANN401
    """Return the sentence on a default; flags of the command have none for what is off."""
    if _is_missing(value) or (not is_setting and (value is None or value is False or value == ())):
        return ""
    if isinstance(value, bool):
        return f"Default: {'on' if value else 'off'}."
    words = map(str, value) if isinstance(value, tuple) else (str(value),)
    return f"Default: {' '.join(words)}."


def _spelled(name: str, hint: Any, metavar: str | None, value: Any) -> str:  # noqa: ANN401
    """Return a flag as one writes it."""
    flag = f"--{name.replace('_', '-')}"
    if hint is not bool:
        return f"{flag} {metavar or _words(hint)}"
    if value is False and "." not in name:
        return flag
    section, dot, last = flag[2:].rpartition(".")
    return f"{flag}, --{section}{dot}no-{last}"


def _words(hint: Any) -> str:  # noqa: ANN401
    """Return what stands for a value of a type; that None may be given is left to the text."""
    choices = [choice for choice in typing.get_args(hint) if choice not in (NoneType, None)]
    if typing.get_origin(hint) is Literal:
        return "{" + ",".join(map(str, choices)) + "}"
    if typing.get_origin(hint) is tuple:
        return f"{_words(choices[0])}..." if ... in choices else " ".join(map(_words, choices))
    return _WORDS[hint] if hint in _WORDS else " or ".join(map(_words, choices))


def _first_line(kind: Any) -> str:  # noqa: ANN401
    """Return the first sentence of a docstring, to stand within one."""
    first = re.split(r"[.;] |\.$", plain(inspect.getdoc(kind) or ""))[0].replace("\n", " ")
    return first[:1].lower() + first[1:]


def _wrap(text: str, indent: str = "") -> str:
    """Return a paragraph in lines that fit the terminal."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    return textwrap.fill(
        " ".join(text.split()),
        width,
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
