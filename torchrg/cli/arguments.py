"""Command-line parser and help texts generated from dataclasses.

Each field is a flag, unless its metadata is ``torchrg.config.NO_FLAG``; its docstring is the help
text. The fields of a nested dataclass become ``--part.field`` flags. ``--help`` lists required and
common flags; ``--help-all`` lists all flags by group.
"""

import argparse
import ast
import dataclasses
import difflib
import functools
import inspect
import itertools
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
from typing import Any, Literal, NamedTuple, NoReturn, TypeVar

from torchrg.errors import ConfigError

Command = TypeVar("Command")

COMMON = (
    *("--normals.method", "--normals.k"),
    *("--growing.max-angle-deg", "--growing.min-size", "--growing.max-distance", "--up"),
    *("--depth.noise", "--depth.max-depth", "--depth.min-size"),
)
"""Common flags of nested parts; the others appear only in ``--help-all``."""
ADVANCED = (
    *("--pages", "--level", "--layout", "--columns", "--viewpoint", "--within", "--merge"),
    *("--config", "--angle-deg", "--sort", "--chunk-size", "--engine", "--ray-address"),
    *("--growing.max-distance", "--ignore", "--boundary-distance", "--azimuth-deg"),
)
"""Command flags that appear only in ``--help-all``."""
RESOURCES = (
    *("--workers", "--threads", "--limit-memory", "--chunk-size", "--engine", "--ray-address"),
)
"""Flags that set where and how fast a command runs, and do not change its result."""
ALIASES = {"--superpoints": ("--superpoint",), "--out": ("--output", "-o")}
"""Alternative spellings of flags, accepted but not listed."""
REQUIRED = "required"
"""Title of the required arguments."""
_PERFORMANCE = "performance (does not change the result)"
_EXAMPLES = "\n\nExamples:\n"
_MAX_WIDTH = 100
_COLUMN = 28
"""Terminal column at which the texts of the short help start."""
_MAX_LENGTH = 40
"""Maximum length of a default listed in the short help, in characters."""
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
_NUMBERS = {int: "an integer", float: "a number"}
_NONE = "None"
"""Spelling of a None value."""
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


@dataclass(frozen=True)
class Argument:
    """Properties of a field that its name and type do not determine.

    Attributes:
        metavar: Placeholder for the value.
        text: Help text, for types that several commands share.
        is_positional: Whether the argument has no flag.
        is_inline: Whether the fields of a dataclass become flags without the name of the part.
    """

    metavar: str | None = None
    text: str | None = None
    is_positional: bool = False
    is_inline: bool = False


class Flag(NamedTuple):
    """A command-line argument."""

    path: str
    """Dotted path of the field."""
    name: str
    """Name: ``--part.field``, or a word for a positional argument."""
    spelling: str
    """Name with the placeholder for its value, as in the help."""
    text: str
    part: str
    """Title of its part, empty for flags of the command itself."""
    hint: object
    is_required: bool

    @property
    def is_positional(self) -> bool:
        """Whether the argument has no flag."""
        return not self.name.startswith("-")


def parse(
    kind: type[Command],
    arguments: Sequence[str],
    *,
    prog: str,
    default: Mapping[str, object] | None = None,
) -> Command:
    """Parse arguments into a dataclass; ``--help`` and ``--help-all`` print and exit.

    ``default`` overrides defaults of the dataclass by field name; ``prog`` is the command.

    Raises:
        ConfigError: If an argument is invalid, with a one-line message.

    Example:
        >>> from torchrg.cli.sample import Arguments
        >>> parse(Arguments, ["room.npz", "--noise=0.01"], prog="torchrg sample").noise
        0.01
    """
    flags = list(list_flags(kind, default))
    if not {"-h", "--help", "--help-all"}.isdisjoint(arguments):
        print(format_help(kind, flags, prog=prog, complete="--help-all" in arguments))
        raise SystemExit(0)
    try:
        example = "".join(f" Example: {line}." for line in example_lines(kind)[:1])
        values = _read(flags, arguments, prog, example)
        return typing.cast(Command, _build(kind, default, values))
    except ConfigError as error:
        text = _use_flag_name(str(error), flags)
        raise ConfigError(f"{text} See {prog} --help.") from None


def _use_flag_name(message: str, flags: Sequence[Flag]) -> str:
    """Replace the setting in a message by its flag, if the flag has no part."""
    named = re.fullmatch(r"\w+Config: expected (\w+) (.*)", message, re.DOTALL)
    name = f"--{named[1].replace('_', '-')}" if named else ""
    is_flag = any(flag.name == name for flag in flags)
    return f"expected {name} {named[2]}" if named and is_flag else message


class _Parser(argparse.ArgumentParser):
    """Parser that raises instead of printing."""

    def error(self, message: str) -> NoReturn:
        """Raise the message, reworded."""
        for pattern, text in (
            (r"argument (--[^:/]*).*: expected .*", r"expected a value for \1"),
            (r"argument (--[^:/]*).*: ignored explicit .*", r"expected no value for \1"),
        ):
            message = re.sub(pattern, text, message)
        raise ConfigError(f"{message}.")


def _read(
    flags: Sequence[Flag], arguments: Sequence[str], prog: str, example: str
) -> dict[str, object]:
    """Return the parsed values by field path."""
    parser = _Parser(prog, add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for flag in flags:
        nargs = "*" if any(map(_is_list, _kinds(flag.hint))) else None
        if flag.is_positional:
            parser.add_argument(flag.path, nargs=nargs or "?", metavar=flag.name)
            continue
        switches = zip(_switches(flag.name), (True, False), strict=True)
        for name, const in switches if flag.hint is bool else [(flag.name, None)]:
            # Underscores are accepted too.
            underscored = f"--{name[2:].replace('-', '_')}"
            spellings = dict.fromkeys((name, underscored, *ALIASES.get(name, ())))
            takes: dict[str, Any] = {"nargs": nargs}
            if const is not None:
                takes = {"action": "store_const", "const": const}
            parser.add_argument(*spellings, dest=flag.path, **takes)
    namespace, left = parser.parse_known_args(_join_dashed_values(flags, arguments))
    if left:
        raise ConfigError(_describe_unknown(left[0], flags, arguments))
    values = vars(namespace)
    missing = [
        flag.name for flag in flags if flag.is_required and values.get(flag.path) in (None, [])
    ]
    if missing:
        inputs = [values[flag.path] for flag in flags if flag.is_positional and flag.path in values]
        words = " ".join(" ".join(words) if isinstance(words, list) else words for words in inputs)
        purpose = f" for {words}" if words else ""
        raise ConfigError(f"missing required {' and '.join(missing)}{purpose}.{example}")
    return {flag.path: _to_value(flag, values[flag.path]) for flag in flags if flag.path in values}


def _describe_unknown(word: str, flags: Sequence[Flag], arguments: Sequence[str]) -> str:
    """Return a message about an unknown flag or argument, with a fix."""
    if os.path.lexists(word):  # A file name that starts like a flag.
        return f"unrecognized option {word}. Did you mean ./{word}?"
    if not word.startswith("-"):
        start = list(arguments).index(word)
        before = [index for index in range(start) if arguments[index].startswith("-")]
        if not before:
            return f"unrecognized argument {word}."
        words = [*itertools.takewhile(lambda x: x[:1] != "-", arguments[before[-1] + 1 :])]
        flag_name = arguments[before[-1]]
        takes_one = any(flag.name == flag_name and flag.hint is not bool for flag in flags)
        if len(words) == 1 or not takes_one:
            return f"unrecognized argument {word}."
        return (
            f"expected one value for {flag_name}, got {' '.join(words)}; separate values with "
            f"commas: {flag_name} {','.join(words)}."
        )
    unknown = word.partition("=")[0].replace("_", "-")
    names = {flag.name: flag.name for flag in flags if not flag.is_positional}
    # The first flag of a tail wins; settings of superpoints, which are rarely changed, come last.
    ordered = sorted(names, key=lambda name: name.startswith("--partition."))
    tails = {f"--{name.lstrip('-').rpartition('.')[2]}": name for name in reversed(ordered)}
    near = difflib.get_close_matches(unknown, [*tails, *names], n=1)
    tail = f"--{unknown.lstrip('-').rpartition('.')[2]}"
    name = tails.get(tail) or next((names.get(word) or tails[word] for word in near), "")
    return f"unrecognized option {unknown}.{f' Did you mean {name}?' if name else ''}"


def _join_dashed_values(flags: Sequence[Flag], arguments: Sequence[str]) -> list[str]:
    """Join each flag with a value that starts with a dash.

    Example:
        >>> up = Flag("up", "--up", "--up {z,-z}", "", "", Literal["z", "-z"], False)
        >>> _join_dashed_values([up], ["--up", "-z", "--up", "z"])
        ['--up=-z', '--up', 'z']
    """
    choices = {
        flag.name: {word for kind in _kinds(flag.hint) for word in typing.get_args(kind)}
        for flag in flags
    }
    joined: list[str] = []
    for argument in arguments:
        if joined and argument.startswith("-") and argument in choices.get(joined[-1], ()):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _switches(name: str) -> tuple[str, str]:
    """Return the flags that turn a setting on and off.

    Example:
        >>> _switches("--growing.absorb")
        ('--growing.absorb', '--growing.no-absorb')
    """
    section, dot, last = name[2:].rpartition(".")
    return name, f"--{section}{dot}no-{last}"


def _kinds(hint: object) -> list[Any]:
    """Return the types allowed for a value, without None."""
    kinds = typing.get_args(hint)
    is_union = typing.get_origin(hint) not in (None, tuple, Literal)
    return [kind for kind in kinds if kind is not NoneType] if is_union else [hint]


def _is_list(kind: object) -> bool:
    """Return whether a value takes several arguments; choices are one, separated by commas."""
    return typing.get_origin(kind) is tuple and not _choices(kind)


def _choices(kind: object) -> tuple[str, ...]:
    """Return the choices for the items of a tuple; empty for other types."""
    items = typing.get_args(kind)[:1] if typing.get_origin(kind) is tuple else ()
    return typing.get_args(items[0]) if items and typing.get_origin(items[0]) is Literal else ()


def _to_value(flag: Flag, typed: bool | str | list[str]) -> object:
    """Convert the text of a flag to its value."""
    if isinstance(typed, bool):
        return typed
    words = [typed] if isinstance(typed, str) else typed
    if words == [_NONE] and NoneType in typing.get_args(flag.hint):
        return None
    kind, *others = _kinds(flag.hint)
    if words_of_items := _choices(kind):
        chosen = tuple(words[0].replace(" ", "").split(","))
        if not set(chosen) <= set(words_of_items):
            some = ", ".join(words_of_items)
            raise ConfigError(f"expected {flag.name} to be some of {some}, got {words[0]!r}.")
        return chosen
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        choices = [choice for literal in (kind, *others) for choice in typing.get_args(literal)]
        if words[0] not in choices:
            raise ConfigError(
                f"expected {flag.name} to be one of {', '.join(choices)}, got {words[0]!r}."
            )
        return words[0]
    if parts and ... not in parts and len(words) != len(parts):
        raise ConfigError(f"expected {len(parts)} values for {flag.name}, got {len(words)}.")
    kind, values = parts[0] if parts else kind, []
    for word in words:
        try:
            values.append(kind(word))
        except ValueError:
            raise ConfigError(f"expected {_NUMBERS[kind]} for {flag.name}, got {word!r}.") from None
    return tuple(values) if parts else values[0]


def _build(kind: Any, default: Any, typed: Mapping[str, object], prefix: str = "") -> Any:  # noqa: ANN401
    """Build a dataclass from the parsed values and the defaults."""
    values, hints = {}, typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        value, path = _default_of(field, default), f"{prefix}{field.name}"
        if any(name.startswith(f"{path}.") for name in typed):
            value = _build(hints[field.name], value, typed, f"{path}.")
        values[field.name] = typed.get(path, () if value is dataclasses.MISSING else value)
    return kind(**values)


def format_help(kind: type, flags: Sequence[Flag], *, prog: str, complete: bool = True) -> str:
    """Format the help of a command, complete or on one screen.

    The class docstring is the description; its "Examples" section comes last. The short help shows
    only the first sentence of each common option.
    """
    common = [flag for flag in flags if complete or _is_common(flag)]
    groups = group_flags(common)
    needed = (flag.spelling for flag in groups.get(REQUIRED, ()))
    usage = " ".join(["usage:", prog, *needed, "[options]"])
    paragraphs = describe(kind).split("\n\n")
    blocks = [usage, *map(_wrap, paragraphs if complete else paragraphs[:1])]
    for title, members in groups.items():
        entries = [_long_entry(flag) if complete else _short_entry(flag) for flag in members]
        blocks.append("\n".join([title if ":" in title else f"{title}:", *entries]))
    if len(common) < len(flags):
        blocks.append(f"{prog} --help-all explains these and {len(flags) - len(common)} more.")
    if examples := example_lines(kind):
        blocks.append("\n".join(["examples:", *(f"  {line}" for line in examples)]))
    return "\n\n".join(blocks)


def _is_common(flag: Flag) -> bool:
    """Return whether the short help lists a flag."""
    return flag.is_required or (
        flag.name not in ADVANCED and (not flag.part or flag.name in COMMON)
    )


def _long_entry(flag: Flag) -> str:
    """Format a flag with its complete help text."""
    return f"  {flag.spelling}\n{_wrap(flag.text, indent=6)}"


def _short_entry(flag: Flag) -> str:
    """Format a flag with its first sentence and its default."""
    sentences = re.split(r"(?<=[.]) (?=[A-Z])", flag.text)
    default = [s for s in sentences[1:] if s.startswith("Default:") and len(s) < _MAX_LENGTH]
    text = _wrap(" ".join([sentences[0], *default]), indent=_COLUMN)
    head = f"  {flag.spelling}"
    return f"{head:<{_COLUMN}}{text.lstrip()}" if len(head) < _COLUMN - 1 else f"{head}\n{text}"


def group_flags(flags: Sequence[Flag]) -> dict[str, list[Flag]]:
    """Group arguments by title: required, options, performance, then each part."""
    groups: dict[str, list[Flag]] = {title: [] for title in (REQUIRED, "options", _PERFORMANCE)}
    for flag in flags:
        if flag.is_required:
            group = REQUIRED
        elif flag.name in RESOURCES:
            group = _PERFORMANCE
        elif not flag.part or flag.name in COMMON:
            group = "options"
        else:
            group = f"advanced: {flag.part}"
        groups.setdefault(group, []).append(flag)
    # Positional arguments come first, in their order.
    groups[REQUIRED].sort(key=lambda flag: not flag.is_positional)
    groups[_PERFORMANCE].sort(key=lambda flag: RESOURCES.index(flag.name))
    return {title: members for title, members in groups.items() if members}


def describe(kind: type) -> str:
    """Return the docstring of a command without its examples."""
    return plain((inspect.getdoc(kind) or "").partition(_EXAMPLES)[0])


def example_lines(kind: type) -> list[str]:
    """Return the lines of the "Examples" section of a docstring."""
    _, _, lines = (inspect.getdoc(kind) or "").partition(_EXAMPLES)
    return textwrap.dedent(lines).splitlines()


def list_flags(
    kind: Any,  # noqa: ANN401
    default: object = None,
    path: str = "",
    prefix: str = "--",
    part: str = "",
) -> Iterator[Flag]:
    """Yield the arguments defined by the fields of a dataclass, in order.

    ``default`` is an instance, or a mapping of values by field name, that overrides the class
    defaults. Nested dataclasses are parts: ``path`` is the path of the part, ``prefix`` the start
    of its flags, and ``part`` its title.
    """
    texts, hints = _field_docstrings(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        if not field.metadata.get("is_flag", True):
            continue
        hint, argument = hints[field.name], Argument()
        if typing.get_origin(hint) is typing.Annotated:
            hint, argument = typing.get_args(hint)
        value, field_path = _default_of(field, default), f"{path}{field.name}"
        front, subject = prefix, part
        if not field.metadata.get("has_part", True):
            front, subject = "--", ""
        if dataclasses.is_dataclass(hint):
            inner = (prefix, part)
            if not argument.is_inline:
                inner = (f"{prefix}{field.name}.", _summary(hint))
            yield from list_flags(hint, value, f"{field_path}.", *inner)
            continue
        text = plain(argument.text or texts.get(field.name, ""))
        if "Default:" not in text:
            text = f"{text} {_default_sentence(value, is_setting=front != '--')}".strip()
        name = f"{front}{field.name}".replace("_", "-")
        if argument.is_positional:
            name = argument.metavar or field.name.upper()
            spelling = name + "..." * (typing.get_origin(hint) is tuple)
        elif hint is bool:
            # Only settings can be on by default, and need a flag to turn them off.
            spelling = ", ".join(_switches(name)) if value or subject else name
        else:
            spelling = f"{name} {argument.metavar or _metavar(hint)}"
        needed = argument.is_positional or value is dataclasses.MISSING
        yield Flag(field_path, name, spelling, text, subject, hint, needed)


def plain(text: str) -> str:
    """Strip markup from a docstring.

    Example:
        >>> plain("With ``absorb``; see :func:`torchrg.segment_planes`.")
        'With absorb; see torchrg.segment_planes.'
    """
    return _ROLE.sub(r"\1", text).replace("`", "")


@functools.cache
def _field_docstrings(kind: type) -> dict[str, str]:
    """Return the docstrings of the fields of a dataclass and its bases."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = getattr(node, "body", [])
        for field, below in pairwise(body):
            is_field = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if is_field and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                texts[field.target.id] = " ".join(str(below.value.value).split())
    return texts


def _default_of(field: "dataclasses.Field[Any]", default: object) -> object:
    """Return the value of a field if no flag sets it."""
    if isinstance(default, Mapping) and field.name in default:
        return default[field.name]
    if default is not None and not isinstance(default, Mapping):
        return getattr(default, field.name)
    factory = field.default_factory
    return field.default if factory is dataclasses.MISSING else factory()


def _default_sentence(value: object, *, is_setting: bool) -> str:
    """Return the sentence about a default; empty for command flags that are off."""
    is_off = value is None or value is False or value == ()
    if value is dataclasses.MISSING or (is_off and not is_setting):
        return ""
    if isinstance(value, bool):
        return f"Default: {'on' if value else 'off'}."
    words = map(str, value) if isinstance(value, tuple) else (str(value),)
    return f"Default: {' '.join(words)}."


def _metavar(hint: object) -> str:
    """Return the placeholder for a value of a type; None is left to the text."""
    choices = [choice for choice in typing.get_args(hint) if choice not in (NoneType, None)]
    if typing.get_origin(hint) is Literal:
        return "{" + ",".join(map(str, choices)) + "}"
    if typing.get_origin(hint) is tuple:
        if words := _choices(hint):
            return f"{{{','.join(words)}}},..."
        return f"{_metavar(choices[0])}..." if ... in choices else " ".join(map(_metavar, choices))
    return " or ".join(map(_metavar, choices)) if choices else _METAVARS[typing.cast(type, hint)]


def _summary(kind: object) -> str:
    """Return the first sentence of a docstring, in lower case."""
    first = re.split(r"[.;] |\.$", plain(inspect.getdoc(kind) or ""))[0].replace("\n", " ")
    return first[:1].lower() + first[1:]


def _wrap(text: str, *, indent: int = 0) -> str:
    """Wrap a paragraph to the width of the terminal."""
    width = min(shutil.get_terminal_size().columns, _MAX_WIDTH)
    return textwrap.fill(
        " ".join(text.split()),
        width,
        initial_indent=" " * indent,
        subsequent_indent=" " * indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
