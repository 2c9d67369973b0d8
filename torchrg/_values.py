"""Values of settings and options, converted to their annotated types."""

import dataclasses
import numbers
import types
import typing
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import NoneType
from typing import Any, Literal

from torchrg.errors import ConfigError

_BOOLS = dict.fromkeys(("true", "on", "yes"), True) | dict.fromkeys(("false", "off", "no"), False)
"""Words for booleans, as in YAML."""
_TYPE_NAMES = {
    NoneType: "none",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "text",
    Path: "a path",
}


class SettingError(ConfigError):
    """A wrong value: caller or file ("" for a command), name, and a problem as ``>= 3, got 2``."""

    def __init__(self, where: str, name: str = "", problem: str = "") -> None:
        # Unpickling passes the message.
        message = f"{where}{': ' if where else ''}expected {name} {problem}." if name else where
        super().__init__(message)
        self.where, self.name, self.problem = where, name, problem


def expect(config: object, name: str, requirement: str, holds: bool) -> None:
    """Raise if a setting does not meet a requirement."""
    if not holds:
        problem = f"{requirement}, got {getattr(config, name)!r}"
        raise SettingError(type(config).__name__, name, problem)


def convert(value: Any, hint: Any, name: str, where: str = "") -> Any:  # noqa: ANN401
    """Convert a value, or the words for it, to its annotated type.

    This is the only check of types: constructors, keywords, dictionaries, files and commands accept
    the same values. Words are numbers, choices, true, false and none; commas separate them.

    Raises:
        SettingError: If the value is none of the type; ``where`` and ``name`` begin the message.

    Example:
        >>> convert("0.3,3", tuple[float, ...] | None, "strengths")
        (0.3, 3.0)
        >>> convert("no", bool, "absorb"), convert("none", float | None, "max_distance")
        (False, None)
    """
    plain = value.item() if getattr(value, "ndim", None) == 0 else value
    kinds = kinds_of(hint)
    for kind in sorted(kinds, key=lambda kind: kind is not NoneType):
        with suppress(ValueError, OverflowError):
            return _convert_to(kind, plain)
    expected = " or ".join(map(_type_name, kinds))
    raise SettingError(where, name, f"to be {expected}, got {value!r}")


def _convert_to(kind: Any, value: Any) -> Any:  # noqa: ANN401
    """Convert a value to a type without alternatives, or raise ValueError."""
    word = value.strip().lower() if isinstance(value, str) else value
    is_word, items = isinstance(value, str), typing.get_args(kind)
    if kind is NoneType and (value is None or (is_word and word in ("none", "null"))):
        return None
    if kind is bool and (isinstance(value, bool) or (is_word and word in _BOOLS)):
        return _BOOLS.get(word, value)
    if kind in (int, float) and not isinstance(value, bool):
        allowed = numbers.Integral if kind is int else numbers.Real
        if (is_word or isinstance(value, allowed)) and (number := kind(value)) == number:
            return number
    if typing.get_origin(kind) is Literal and is_word:
        return items[items.index(value)]
    if typing.get_origin(kind) is tuple and not isinstance(value, Mapping | bytes | None):
        parts = value.replace(" ", "").split(",") if is_word else value
        parts = tuple(parts) if isinstance(parts, Iterable) else (parts,)
        if ... in items or len(parts) == len(items):
            return tuple(convert(part, items[0], "") for part in parts)
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    if kind is str and is_word:
        return value
    if dataclasses.is_dataclass(kind) and type(value) is kind:
        return value
    raise ValueError


def kinds_of(hint: Any) -> list[Any]:  # noqa: ANN401
    """Return the alternatives of an annotated type.

    Example:
        >>> kinds_of(int | None)
        [<class 'int'>, <class 'NoneType'>]
    """
    is_union = typing.get_origin(hint) in (types.UnionType, typing.Union)
    return [*typing.get_args(hint)] if is_union else [hint]


def _type_name(kind: Any) -> str:  # noqa: ANN401
    """Return the name of a type for messages."""
    items = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return f"one of {', '.join(items)}" if len(items) > 1 else f"{items[0]}"
    if typing.get_origin(kind) is tuple:
        if typing.get_origin(items[0]) is Literal:
            return _type_name(items[0]).replace("one of", "some of")
        noun = {int: "integers", float: "numbers"}.get(items[0], "values")
        return noun if ... in items else f"{len(items)} {noun}"
    return _TYPE_NAMES.get(kind) or f"a {kind.__name__} or a mapping"
