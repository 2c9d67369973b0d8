"""Arguments of commands from the fields of dataclasses: their parser, and what ``--help`` prints.

A field is a flag, and its docstring says what the flag does. A field that is a dataclass is a part,
whose flags are called ``--part.field``. ``--help`` tells what is needed, what is often wanted, the
rest by part, and examples.
"""

import argparse
import ast
import dataclasses
import difflib
import inspect
import os
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NoReturn, TypeVar

from torchrg.errors import ConfigError

Command = TypeVar("Command")
FieldPath = tuple[str, ...]
"""Names of the fields that lead to a value."""

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
_NUMBERS = {int: "a whole number", float: "a number"}
_NONE = "None"
"""How a value that is none is written."""
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


@dataclass(frozen=True)
class Argument:
    """How the field of a command is written, where its name and type do not say it.

    Attributes:
        metavar: What stands for its value.
        text: What it does, where a type that several commands share says it.
        is_positional: Whether it has no flag.
        is_inline: Whether the fields of its dataclass are flags without the name of the part.
    """

    metavar: str | None = None
    text: str | None = None
    is_positional: bool = False
    is_inline: bool = False


@dataclass(frozen=True)
class Flag:
    """An argument of a command.

    Attributes:
        path: The fields that lead to its value.
        name: How it is called: ``--part.field``, or a word for what has no flag.
        spelling: How it is written, with what stands for its value.
        text: What it does.
        part: What the part that it belongs to is about, empty for the command itself.
        hint: Type of its value.
        is_needed: Whether it has to be given.
    """

    path: FieldPath
    name: str
    spelling: str
    text: str
    part: str
    hint: Any
    is_needed: bool

    @property
    def is_positional(self) -> bool:
        """Whether it has no flag."""
        return not self.name.startswith("-")


def parse(
    kind: type[Command],
    arguments: Sequence[str],
    *,
    prog: str,
    default: Mapping[str, Any] | None = None,
) -> Command:
    """Parse arguments into a dataclass; ``--help`` prints and exits.

    Args:
        kind: The dataclass.
        arguments: What stands behind the name of the command.
        prog: The name of the command.
        default: Values of fields in place of those of the dataclass.

    Raises:
        ConfigError: If an argument is wrong, as one line.

    Example:
        >>> from torchrg.cli.sample import Arguments
        >>> parse(Arguments, ["room.npz", "--noise=0.01"], prog="torchrg sample").noise
        0.01
    """
    flags = list(list_flags(kind, default))
    if not {"-h", "--help"}.isdisjoint(arguments):
        print(format_help(kind, flags, prog=prog))
        raise SystemExit(0)
    try:
        given = _read(flags, arguments, prog)
        return typing.cast(Command, _build(kind, default, given))
    except _UsageError as error:
        raise ConfigError(f"{error} See {prog} --help.") from None
    except ConfigError as error:
        # The one setting that stands in no section.
        text = str(error).replace("PipelineConfig: expected chunk_size", "expected --chunk-size")
        where = "" if "--" in text else f" See {prog} --help."
        raise ConfigError(f"{text}{where}") from None


class _UsageError(Exception):
    """What is wrong with some arguments, in a sentence."""


class _Parser(argparse.ArgumentParser):
    """Raises what it would print."""

    def error(self, message: str) -> NoReturn:
        """Raise a message in the words of this program."""
        for pattern, text in (
            (r"argument (--[^:/]*).*: expected .*", r"expected a value for \1"),
            (r"argument (--[^:/]*).*: ignored explicit .*", r"expected no value for \1"),
            (r"the following arguments are required: ", f"Missing from {self.prog}: "),
        ):
            message = re.sub(pattern, text, message)
        raise _UsageError(f"{message}.")


def _read(flags: Sequence[Flag], arguments: Sequence[str], prog: str) -> dict[FieldPath, Any]:
    """Return the values that are given."""
    parser = _Parser(prog, add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for number, flag in enumerate(flags):
        dest, nargs = str(number), "*" if _has_words(flag.hint) else None
        if flag.is_positional:
            parser.add_argument(dest, nargs=nargs, metavar=flag.name)
        elif flag.hint is bool:
            for name, value in zip(_switches(flag.name), (True, False), strict=True):
                names = _spellings(name)
                parser.add_argument(*names, dest=dest, action="store_const", const=value)
        else:
            needed = flag.is_needed
            parser.add_argument(*_spellings(flag.name), dest=dest, nargs=nargs, required=needed)
    given, left = parser.parse_known_args(arguments)
    if left:
        raise _UsageError(f"Unrecognized options: {', '.join(left)}.{_nearest(left[0], flags)}")
    values = {flags[int(number)]: value for number, value in vars(given).items()}
    return {flag.path: _value_of(flag, value) for flag, value in values.items()}


def _switches(name: str) -> tuple[str, str]:
    """Return the flags that turn something on and off.

    Example:
        >>> _switches("--growing.absorb")
        ('--growing.absorb', '--growing.no-absorb')
    """
    section, dot, last = name[2:].rpartition(".")
    return name, f"--{section}{dot}no-{last}"


def _spellings(name: str) -> list[str]:
    """Return a flag with hyphens, and with the underscores of its field."""
    return list(dict.fromkeys((name, f"--{name[2:].replace('-', '_')}")))


def _nearest(wrong: str, flags: Sequence[Flag]) -> str:
    """Return a question where something that is no flag is much like one, or is a file."""
    names = [flag.name for flag in flags] if wrong.startswith("--") else []
    found = difflib.get_close_matches(wrong, names, n=1)
    if os.path.lexists(wrong):  # A file whose name begins as a flag does.
        found = [f"./{wrong}"]
    return f" Did you mean {found[0]}?" if found else ""


def _kinds_of(hint: Any) -> list[Any]:  # noqa: ANN401
    """Return the types that a value may have; None is not among them."""
    kinds = typing.get_args(hint)
    is_union = typing.get_origin(hint) not in (None, tuple, Literal)
    return [kind for kind in kinds if kind is not NoneType] if is_union else [hint]


def _has_words(hint: Any) -> bool:  # noqa: ANN401
    """Return whether a value of a type may be several words."""
    return any(typing.get_origin(kind) is tuple for kind in _kinds_of(hint))


def _value_of(flag: Flag, given: bool | str | list[str]) -> Any:  # noqa: ANN401
    """Return the value that is written for a flag."""
    if isinstance(given, bool):
        return given
    words = [given] if isinstance(given, str) else given
    if words == [_NONE] and NoneType in typing.get_args(flag.hint):
        return None
    kinds = _kinds_of(flag.hint)
    choices = [c for kind in kinds for c in typing.get_args(kind) if isinstance(c, str)]
    if choices:
        if words[0] not in choices:
            known = ", ".join(choices)
            raise _UsageError(f"expected {flag.name} to be one of {known}, got {words[0]!r}.")
        return words[0]
    if typing.get_origin(kinds[0]) is not tuple:
        return _converted(flag, kinds[0], words[0])
    parts = typing.get_args(kinds[0])
    if Ellipsis not in parts and len(words) != len(parts):
        raise _UsageError(f"expected {len(parts)} values for {flag.name}, got {len(words)}.")
    return tuple(_converted(flag, parts[0], word) for word in words)


def _converted(flag: Flag, kind: Any, word: str) -> Any:  # noqa: ANN401
    """Return a word as a value of a type."""
    try:
        return kind(word)
    except ValueError:
        message = f"expected {_NUMBERS[kind]} for {flag.name}, got {word!r}."
        raise _UsageError(message) from None


def _build(kind: Any, default: Any, given: Mapping[FieldPath, Any]) -> Any:  # noqa: ANN401
    """Return a dataclass with the values that are given, and otherwise those that it has."""
    values: dict[str, Any] = {}
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value = _default_of(field, default)
        below = {path[1:]: found for path, found in given.items() if path[0] == field.name}
        if dataclasses.is_dataclass(hints[field.name]):
            value = _build(hints[field.name], value, below) if below else value
        elif () in below:
            value = below[()]
        values[field.name] = () if value is dataclasses.MISSING else value
    return kind(**values)


def format_help(kind: type, flags: Sequence[Flag], *, prog: str) -> str:
    """Return what a command that is parsed into a dataclass says about itself.

    The docstring of the class is the description; the lines of its section "Examples" come last.
    """
    description, _, examples = (inspect.getdoc(kind) or "").partition(_EXAMPLES)
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
    groups["needed"].sort(key=lambda flag: not flag.is_positional)
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
    path: FieldPath = (),
    prefix: str = "",
    part: str = "",
) -> Iterator[Flag]:
    """Yield the arguments that the fields of a dataclass become, in their order.

    Args:
        kind: The dataclass; fields that are dataclasses are parts.
        default: An instance, or values of fields by name, in place of the defaults of the class.
        path: The fields that lead to the dataclass.
        prefix: What stands before the names of flags.
        part: What the flags are about, empty for the command itself.
    """
    texts, hints = _texts(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, argument = hints[field.name], Argument()
        if typing.get_origin(hint) is typing.Annotated:
            hint, argument = typing.get_args(hint)
        value, own = _default_of(field, default), (*path, field.name)
        if dataclasses.is_dataclass(hint):
            inner = prefix if argument.is_inline else f"{prefix}{field.name}."
            about = part if argument.is_inline else _first_line(hint)
            yield from list_flags(hint, value, own, inner, about)
            continue
        text = plain(argument.text or texts.get(field.name, ""))
        if "Default:" not in text:
            text = f"{text} {_said(value, is_setting=bool(prefix))}".strip()
        if argument.is_positional:
            name = argument.metavar or field.name.upper()
            dots = "..." if typing.get_origin(hint) is tuple else ""
            yield Flag(own, name, f"{name}{dots}", text, part, hint, is_needed=True)
        else:
            name = f"--{prefix}{field.name}".replace("_", "-")
            spelling = _spelled(name, hint, argument.metavar, value)
            needed = value is dataclasses.MISSING
            yield Flag(own, name, spelling, text, part, hint, is_needed=needed)


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


def _default_of(field: "dataclasses.Field[Any]", default: Any) -> Any:  # noqa: ANN401
    """Return what a field is where no flag says otherwise."""
    if isinstance(default, Mapping) and field.name in default:
        return default[field.name]
    if default is not None and not isinstance(default, Mapping):
        return getattr(default, field.name)
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def _said(value: Any, *, is_setting: bool) -> str:  # noqa: ANN401
    """Return the sentence on a default; flags of the command have none for what is off."""
    is_off = value is None or value is False or value == ()
    if value is dataclasses.MISSING or (is_off and not is_setting):
        return ""
    if isinstance(value, bool):
        return f"Default: {'on' if value else 'off'}."
    words = map(str, value) if isinstance(value, tuple) else (str(value),)
    return f"Default: {' '.join(words)}."


def _spelled(name: str, hint: Any, metavar: str | None, value: Any) -> str:  # noqa: ANN401
    """Return a flag as one writes it."""
    if hint is not bool:
        return f"{name} {metavar or _words(hint)}"
    return name if value is False and "." not in name else ", ".join(_switches(name))


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
