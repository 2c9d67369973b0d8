"""Modules that are loaded where they are used: optional packages, and what draws results.

A segmentation shows itself in a notebook through what draws, which stands far above it: that
registers itself here, and is loaded only then.
"""

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any

from torchrg.errors import MissingDependencyError

_displays: list[Callable[[], ModuleType]] = []


def require(module: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or say how to install it.

    ``extra`` of torchrg brings it; ``purpose`` completes "... is needed to <purpose>".

    Raises:
        MissingDependencyError: If the module is not installed.

    Example:
        >>> require("math", extra="las", purpose="read LAS files").pi > 3
        True
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"{module} is needed to {purpose}; install it with: pip install 'torchrg[{extra}]'"
        ) from error


def register_display(load: Callable[[], ModuleType]) -> None:
    """Let results be shown by the functions of the module that is loaded by a call."""
    _displays[:] = [load]


def display(name: str, *arguments: object, **settings: object) -> Any:  # noqa: ANN401
    """Call a function of the registered module by its name."""
    return getattr(_displays[0](), name)(*arguments, **settings)
