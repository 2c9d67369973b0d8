"""Exceptions and warnings of torchrg.

All exceptions derive from :class:`TorchrgError`; messages contain the requirement, the value and
the fix.
"""

import sys
import warnings

__all__ = [
    "ConfigError",
    "DepthWarning",
    "FormatError",
    "MissingDependencyError",
    "PrecisionWarning",
    "ShapeError",
    "TorchrgError",
]
__dir__ = __all__.copy

OUT_OF_MEMORY = "out of memory; use a machine with more memory, or a smaller part of the data."
"""Message of any out-of-memory error."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means out of memory; torch raises a RuntimeError.

    Example:
        >>> is_out_of_memory(MemoryError()), is_out_of_memory(RuntimeError("shape mismatch"))
        (True, False)
    """
    words = ("can't allocate memory", "not enough memory", "out of memory")
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(word in str(error) for word in words)
    )


class TorchrgError(Exception):
    """Base of every error raised by torchrg."""


class ShapeError(TorchrgError, ValueError):
    """A tensor has an invalid or inconsistent shape, dtype or device."""


class FormatError(TorchrgError, ValueError):
    """A file is missing, corrupt, or lacks the requested data."""


class ConfigError(TorchrgError, ValueError):
    """A setting is unknown, or its value is invalid."""


class MissingDependencyError(TorchrgError, ImportError):
    """A required optional package is not installed."""


class PrecisionWarning(UserWarning):
    """The rounding step of coordinates is coarse, or many points stand for missing ones."""


class DepthWarning(UserWarning):
    """A camera or depth scale is assumed, or does not fit its depth image."""


_LIBRARIES = {"torchrg", "torch", "contextlib", "functools"}
"""Packages between a warning and the code of the user: decorators and ``nn.Module`` calls."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user that called torchrg."""
    level, frame = 2, sys._getframe(1)  # noqa: SLF001
    while frame.f_back and frame.f_globals["__name__"].partition(".")[0] in _LIBRARIES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
