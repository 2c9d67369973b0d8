"""Exceptions that torchrg raises on purpose, and warnings that have a class of their own.

All exceptions are a :class:`TorchrgError`; the message says what was expected, what came, and the
repair.
"""

OUT_OF_MEMORY = "out of memory; use a machine with more, or a smaller part of the data."
"""Message where memory could not be had, whatever for."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that memory ran out; torch raises a RuntimeError.

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
    """A tensor has the wrong number of axes, axes that disagree, or the wrong dtype or device."""


class FormatError(TorchrgError, ValueError):
    """A file is missing, damaged, or does not hold what was asked of it."""


class ConfigError(TorchrgError, ValueError):
    """A setting is unknown, or its value is not allowed."""


class MissingDependencyError(TorchrgError, ImportError):
    """An optional package is needed and is not installed."""


class PrecisionWarning(UserWarning):
    """Coordinates have lost digits that the spacing of their points needs."""


class DepthWarning(UserWarning):
    """A camera or a depth scale is assumed, or hardly belongs to its depth image."""
