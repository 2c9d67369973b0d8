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


_LIBRARIES = {"torchrg", "torch", "contextlib", "functools"}
"""Packages between a warning and the code of the user: decorators and ``nn.Module`` calls."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user that called torchrg."""
    level, frame = 2, sys._getframe(1)  # noqa: SLF001
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _LIBRARIES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
