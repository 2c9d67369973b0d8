"""Imports of optional packages, made where they are used."""

import importlib
from types import ModuleType

from torchrg.errors import MissingDependencyError


def require(module: str, *, extra: str, purpose: str) -> ModuleType:
    """Import an optional module, or say how to install it.

    Args:
        module: Dotted name of the module.
        extra: The extra of torchrg that brings it.
        purpose: What the caller wanted, to complete "... is needed to <purpose>".

    Returns:
        The imported module.

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
