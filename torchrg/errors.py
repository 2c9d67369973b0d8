"""Exceptions and warnings of torchrg.

All exceptions derive from :class:`TorchrgError`; messages contain requirement, value and fix.
"""

import sys
import warnings

__all__ = [
    "CloudWarning",
    "ConfigError",
    "DepthWarning",
    "FormatError",
    "MissingDependencyError",
    "PrecisionWarning",
    "ShapeError",
    "TorchrgError",
    "UnitWarning",
]
__dir__ = __all__.copy


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


class CloudWarning(UserWarning):
    """A cloud has few points, or seems to have another up axis than assumed."""


class UnitWarning(PrecisionWarning):
    """The axes of a cloud seem to have different units, such as degrees and meters."""


class DepthWarning(UserWarning):
    """A camera or depth scale is assumed, or does not fit its depth image."""


MAX_SHOWN = 100
"""Maximum length of a value in a message or a result that prints, in characters."""
_LIBRARIES = {"torchrg", "torch", "contextlib", "functools"}
"""Packages between a warning and the code of the user: decorators and ``nn.Module`` calls."""


def shown(value: object) -> str:
    """Return a value as text for a message: tensors and arrays by shape, other long values cut."""
    if getattr(value, "ndim", 0):
        return f"{type(value).__name__} of shape {tuple(getattr(value, 'shape', ()))}"
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user that called torchrg."""
    level, frame = 2, sys._getframe(1)  # noqa: SLF001
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _LIBRARIES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
