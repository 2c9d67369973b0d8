"""Command-line parser and help texts generated from dataclasses.

Each field is an option; its docstring is the help text. A field that holds settings stands for
words ``--section.name VALUE``, passed unparsed to :mod:`torchrg.config`, and for options without a
section. ``--help`` lists common options, ``--help-all`` all options, ``torchrg settings`` settings.
"""

import ast
import dataclasses
import functools
import inspect
import itertools
import os
import re
import shutil
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType
from typing import Any, Literal, NamedTuple, TypeVar

from torchrg._synonyms import advice_on, nearest_name
from torchrg.config import SettingError, convert, kinds_of, settings_of
from torchrg.errors import ConfigError

Command = TypeVar("Command")

ADVANCED = (
    *("--pages", "--level", "--layout", "--columns", "--viewpoint", "--within", "--merge"),
    *("--config", "--angle-deg", "--sort", "--chunk-size", "--engine"),
    *("--ignore", "--boundary-distance", "--azimuth-deg"),
)
"""Command flags that appear only in ``--help-all``."""
RESOURCES = (*("--workers", "--threads", "--limit-memory", "--chunk-size", "--engine"),)
"""Flags that set where and how fast a command runs, and do not change its result."""
_STARTS = ("--preset", "--config", "--angle-deg")
"""Flags that set several settings."""
ALIASES = {
    "--superpoints": ("--superpoint",),
    "--out": ("--output", "-o"),
    "--verbose": ("-v",),
}
"""Alternative spellings of flags, accepted but not listed."""
REQUIRED = "required"
"""Title of the required arguments."""
_SETTINGS = "settings"
_PERFORMANCE = "performance (does not change the result)"
_EXAMPLES = "\n\nExamples:\n"
_MAX_WIDTH = 100
_COLUMN = 28
"""Terminal column at which the texts of the short help start."""
_MAX_LENGTH = 40
"""Maximum length of a default listed in the short help, in characters."""
_METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH", bool: "{true,false}"}
_NUMBER = re.compile(r"-?\d*\.?\d+(e-?\d+)?")
_COUNTS = re.compile(r"\d+(,\d+)*")
_ROLE = re.compile(r":\w+:`~?([^`]+)`")


@dataclass(frozen=True)
class Argument:
    """Properties of a field that its name and type do not determine.

    Attributes:
        metavar: Placeholder for the value.
        text: Help text, for types that several commands share.
        is_positional: Whether the argument has no flag.
        numbers: Path of the setting for numbers after a switch.
        base: Function that returns the settings that words override, from the options by field;
            the words are then without the name of the field.
    """

    metavar: str | None = None
    text: str | None = None
    is_positional: bool = False
    numbers: str = ""
    base: Callable[[Mapping[str, Any]], object] | None = None


class Flag(NamedTuple):
    """A command-line argument."""

    path: str
    """Name of the field; for settings, a dot and their dotted name follow."""
    name: str
    """Name: ``--section.name``, or a word for a positional argument."""
    spelling: str
    """Name with the placeholder for its value, as in the help."""
    describe: Callable[[], str]
    """Returns the text."""
    section: str
    """Section of a setting, as in its name; empty for options."""
    hint: object
    is_required: bool
    numbers: str = ""

    @property
    def text(self) -> str:
        """Text of the help, from the source: reading it takes a tenth of a second."""
        return self.describe()

    @property
    def is_positional(self) -> bool:
        """Whether the argument has no flag."""
        return not self.name.startswith("-")

    @property
    def is_switch(self) -> bool:
        """Whether the option takes no value."""
        return self.hint is bool and not self.section


def parse(kind: type[Command], arguments: Sequence[str], *, prog: str) -> Command:
    """Parse arguments into a dataclass; ``--help`` and ``--help-all`` print and exit.

    Raises:
        ConfigError: If an argument is invalid, with a one-line message.
    """
    flags = list(list_flags(kind))
    if not {"-h", "--help", "--help-all"}.isdisjoint(arguments):
        print(format_help(kind, flags, prog=prog, complete="--help-all" in arguments))
        raise SystemExit(0)
    try:
        words = _read(flags, arguments)
        _check_required(flags, words, kind)
        return _build(kind, flags, words)
    except ConfigError as error:
        raise ConfigError(f"{error} See {prog} --help.") from None


def _read(flags: Sequence[Flag], arguments: Sequence[str]) -> dict[str, Any]:
    """Return the words of the arguments by path."""
    named = {name: flag for flag in flags for name in _names(flag)}
    words, inputs, waiting = dict[str, Any](), list[str](), [*reversed(arguments)]
    while waiting:
        name, equals, word = (argument := waiting.pop()).partition("=")
        flag = named.get(name.replace("_", "-")) if name.startswith("-") else None
        if argument == "--":
            inputs += reversed(waiting)
            break
        if flag is None:
            if name.startswith("-"):
                raise ConfigError(_describe_unknown(argument, flags))
            inputs.append(argument)
        elif flag.is_switch:
            words[flag.path] = True
            if flag.numbers and (equals or (waiting and _COUNTS.fullmatch(waiting[-1]))):
                words[flag.numbers] = word if equals else waiting.pop()
            elif equals:
                raise ConfigError(f"expected no value for {flag.name}.")
        elif equals or (waiting and not _is_name(waiting[-1])):
            values = [word if equals else waiting.pop()]
            while waiting and _continues(values, flag.hint, waiting[-1]):
                values.append(waiting.pop())
            earlier = [words[flag.path]] if flag.path in words and _is_list(flag.hint) else []
            words[flag.path] = ",".join([*earlier, *values])
        else:
            example = f", as in {flag.name} true" if flag.hint is bool else ""
            raise ConfigError(f"expected a value for {flag.name}{example}.")
    for flag in flags:
        if flag.is_positional and inputs and flag.path not in words:
            is_list = typing.get_origin(flag.hint) is tuple
            words[flag.path], inputs = (inputs, []) if is_list else (inputs[0], inputs[1:])
    if inputs:
        raise ConfigError(_describe_extra(inputs[0], named, arguments))
    return words


def _names(flag: Flag) -> list[str]:
    """Return the spellings of an argument; one without a flag may also follow its own name."""
    name = f"--{flag.path.replace('_', '-')}" if flag.is_positional else flag.name
    return [flag.name, name, *ALIASES.get(name, ())]


def _is_name(argument: str) -> bool:
    """Return whether an argument is an option rather than a value, such as -y or -3."""
    return argument.startswith("--") or argument in itertools.chain(*ALIASES.values())


def _is_list(hint: object) -> bool:
    """Return whether an argument takes any number of values, so that repeating it adds to them."""
    return any(... in typing.get_args(kind) for kind in kinds_of(hint))


def _continues(values: Sequence[str], hint: object, argument: str) -> bool:
    """Return whether an argument is a further value of a list: a number, a text, or a choice."""
    kinds = [kind for kind in kinds_of(hint) if typing.get_origin(kind) is tuple]
    items = typing.get_args(kinds[0]) if kinds else ()
    if not items or (... not in items and len(values) == len(items)):
        return False
    is_text = argument in typing.get_args(items[0]) or (items[0] is str and not _is_name(argument))
    return is_text or (items[0] in (int, float) and _NUMBER.fullmatch(argument) is not None)


def _check_required(flags: Sequence[Flag], words: Mapping[str, Any], kind: type) -> None:
    """Raise if a required argument is missing."""
    if missing := [flag.name for flag in flags if flag.is_required and flag.path not in words]:
        inputs = [words[flag.path] for flag in flags if flag.is_positional and flag.path in words]
        typed = " ".join(" ".join(each) if isinstance(each, list) else each for each in inputs)
        purpose = f" for {typed}" if typed else ""
        example = "".join(f" Example: {line}." for line in example_lines(kind)[:1])
        raise ConfigError(f"missing required {' and '.join(missing)}{purpose}.{example}")


def _describe_extra(word: str, named: Mapping[str, Flag], arguments: Sequence[str]) -> str:
    """Return a message about an argument too many, with a fix if it follows an option."""
    before = [*itertools.takewhile(lambda argument: argument != word, arguments)]
    names = [argument.partition("=")[0].replace("_", "-") for argument in before]
    starts = [index for index, name in enumerate(names) if name in named]
    name, *values = before[starts[-1] :] if starts else [""]
    if not values or named[names[starts[-1]]].is_switch:
        return f"unrecognized argument {word}."
    return (
        f"expected one value for {name}, got {' '.join([*values, word])}; separate values with "
        f"commas: {name} {','.join([*values, word])}."
    )


def _describe_unknown(word: str, flags: Sequence[Flag]) -> str:
    """Return a message about an unknown option, with a fix."""
    if os.path.lexists(word):  # A file name that starts like an option.
        return f"unrecognized option {word}. Did you mean ./{word}?"
    unknown = word.partition("=")[0].replace("_", "-")
    key = unknown.lstrip("-").replace("-", "_")
    names = {flag.name[2:].replace("-", "_"): flag for flag in flags if not flag.is_positional}
    if near := names.get(nearest_name(key.replace("no_", ""), names)):
        value = " false" if near.section and near.hint is bool and "no_" in key else ""
        return f"unrecognized option {unknown}. Did you mean {near.name}{value}?"
    advice = advice_on(key)
    return f"unrecognized option {unknown}{f': {advice}' if advice else ''}."


def _build(kind: type[Command], flags: Sequence[Flag], words: Mapping[str, Any]) -> Command:
    """Build a dataclass: convert the options, and load the settings with their words."""
    values = {
        flag.path: convert(words[flag.path], flag.hint, flag.name)
        for flag in flags
        if flag.path in words and "." not in flag.path
    }
    names = {flag.path: flag.name for flag in flags}
    for field, hint, argument in _fields(kind):
        if dataclasses.is_dataclass(hint):
            start = f"{field.name}."
            changes = {
                path.removeprefix(start): words[path] for path in words if path.startswith(start)
            }
            try:
                base = argument.base(values) if argument.base else None
                values[field.name] = settings_of("", typing.cast(type, hint), base, changes)
            except SettingError as error:
                if error.where:  # A file.
                    raise
                name = names.get(f"{start}{error.name}") or names.get(error.name, error.name)
                raise SettingError("", name, error.problem) from None
    return kind(**values)


def format_help(kind: type, flags: Sequence[Flag], *, prog: str, complete: bool = True) -> str:
    """Format the help of a command, complete or on one screen.

    The class docstring is the description; its "Examples" section comes last. The short help shows
    only the first sentence of each common option.
    """
    options = [flag for flag in flags if not flag.section]
    common = [flag for flag in options if complete or flag.is_required or flag.name not in ADVANCED]
    groups = group_flags(common)
    needed = (flag.spelling for flag in groups.get(REQUIRED, ()))
    usage = " ".join(["usage:", prog, *needed, "[options]"])
    paragraphs = describe(kind).split("\n\n")
    blocks = [usage, *map(_wrap, paragraphs if complete else paragraphs[:1])]
    for title, members in groups.items():
        entries = [format_flag(flag) if complete else _short_entry(flag) for flag in members]
        blocks.append("\n".join([f"{title}:", *entries]))
    if sections := dict.fromkeys(f"--{flag.section}.NAME" for flag in flags if flag.section):
        blocks.append(_wrap(f"torchrg settings lists more settings: {', '.join(sections)}."))
    if len(common) < len(options):
        blocks.append(f"{prog} --help-all explains these and {len(options) - len(common)} more.")
    if examples := example_lines(kind):
        blocks.append("\n".join(["examples:", *(f"  {line}" for line in examples)]))
    return "\n\n".join(blocks)


def format_flag(flag: Flag) -> str:
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
    """Group arguments by title: required, options, settings, performance."""
    groups: dict[str, list[Flag]] = {REQUIRED: [], "options": [], _SETTINGS: [], _PERFORMANCE: []}
    for flag in flags:
        title = _SETTINGS if "." in flag.path or flag.name in _STARTS else "options"
        title = _PERFORMANCE if flag.name in RESOURCES else title
        groups[REQUIRED if flag.is_required else title].append(flag)
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
    section: str = "",
) -> Iterator[Flag]:
    """Yield the arguments defined by the fields of a dataclass, in order.

    ``default`` has the default values. ``path`` and ``section`` are prefixes of path and name.
    """
    for field, hint, argument in _fields(kind):
        value = field.default if default is None else getattr(default, field.name)
        if default is None and field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        if dataclasses.is_dataclass(hint):
            inner = "" if argument.base else field.name
            yield from list_flags(hint, value, f"{path}{field.name}.", inner)
            continue
        front = "" if field.metadata.get("is_short") else section
        text = functools.partial(
            _describe_field, kind, field.name, argument.text, value, is_setting=front != ""
        )
        name = f"--{front}{'.' if front else ''}{field.name}".replace("_", "-")
        if argument.is_positional:
            name = argument.metavar or field.name.upper()
            spelling = name + "..." * (typing.get_origin(hint) is tuple)
        elif hint is bool and not front:
            spelling = name
        else:
            spelling = f"{name} {argument.metavar or _metavar(hint)}"
        is_required = value is dataclasses.MISSING
        dotted = f"{path}{field.name}"
        yield Flag(dotted, name, spelling, text, front, hint, is_required, argument.numbers)


def _fields(kind: Any) -> Iterator[tuple["dataclasses.Field[Any]", object, Argument]]:  # noqa: ANN401
    """Yield the fields of a dataclass with their types and properties."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, argument = hints[field.name], Argument()
        if typing.get_origin(hint) is typing.Annotated:
            hint, argument = typing.get_args(hint)
        yield field, hint, argument


def plain(text: str) -> str:
    """Strip markup from a docstring."""
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


def _describe_field(
    kind: type, name: str, text: str | None, value: object, *, is_setting: bool
) -> str:
    """Return the help text of a field with its default; ``text`` replaces its docstring."""
    text = plain(text or _field_docstrings(kind).get(name, ""))
    if "Default:" in text:
        return text
    return f"{text} {_default_sentence(value, is_setting=is_setting)}".strip()


def _default_sentence(value: object, *, is_setting: bool) -> str:
    """Return the sentence about a default; empty for command flags that are off."""
    is_off = value is None or value is False or value == ()
    if value is dataclasses.MISSING or (is_off and not is_setting):
        return ""
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f"Default: {','.join(map(str, value)) if isinstance(value, tuple) else text}."


def _metavar(hint: object) -> str:
    """Return the placeholder for a value of a type; None is left to the text."""
    choices = [choice for choice in typing.get_args(hint) if choice not in (NoneType, None)]
    if typing.get_origin(hint) is Literal:
        return "{" + ",".join(map(str, choices)) + "}"
    if typing.get_origin(hint) is tuple:
        if typing.get_origin(choices[0]) is Literal:
            return f"{_metavar(choices[0])},..."
        return f"{_metavar(choices[0])}..." if ... in choices else " ".join(map(_metavar, choices))
    return " or ".join(map(_metavar, choices)) if choices else _METAVARS[typing.cast(type, hint)]


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
