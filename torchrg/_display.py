"""Hook for displaying results in notebooks.

The display functions live in a higher layer, and are loaded on first use.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

_loaders: list[Callable[[], ModuleType]] = []


def register(load: Callable[[], ModuleType]) -> None:
    """Register the loader of the module with the display functions."""
    _loaders[:] = [load]


def call(name: str, *arguments: Any, **settings: Any) -> Any:  # noqa: ANN401
    """Call a function of the registered module by name."""
    return getattr(_loaders[0](), name)(*arguments, **settings)
