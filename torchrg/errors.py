"""Exceptions that torchrg raises on purpose.

All are a :class:`TorchrgError`; the message says what was expected, what came, and the repair.
"""


class TorchrgError(Exception):
    """Base of every error raised by torchrg."""


class ShapeError(TorchrgError, ValueError):
    """A tensor has the wrong number of axes, axes that disagree, or the wrong dtype or device."""


class FormatError(TorchrgError, ValueError):
    """A file is missing, damaged, or does not hold what was asked of it."""


class ConfigError(TorchrgError, ValueError):
    """A setting is unknown, or its value is not allowed."""


class MissingDependencyError(TorchrgError, ImportError):
    """An optional package is needed and is not installed."""
