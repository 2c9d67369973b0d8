"""Lazy imports of optional packages."""

import importlib
from types import ModuleType

from torchrg.errors import MissingDependencyError


def require(module: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or raise with the install command.

    ``extra`` is the extra of torchrg with the module; ``purpose`` completes "... is needed to
    <purpose>".

    Raises:
        MissingDependencyError: If the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"{module} is needed to {purpose}; install it with: pip install 'torchrg[{extra}]'"
        ) from error
