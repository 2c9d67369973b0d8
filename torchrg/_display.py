"""How results show themselves in a notebook: called here, and registered from above.

A segmentation shows itself through what draws, which stands far above it and is loaded only then.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

_loaders: list[Callable[[], ModuleType]] = []


def register(load: Callable[[], ModuleType]) -> None:
    """Let results be shown by the functions of the module that is loaded by a call."""
    _loaders[:] = [load]


def call(name: str, *arguments: Any, **settings: Any) -> Any:  # noqa: ANN401
    """Call a function of the registered module by its name."""
    return getattr(_loaders[0](), name)(*arguments, **settings)
