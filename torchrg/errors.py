"""Exceptions and warnings of torchrg.

All exceptions derive from :class:`TorchrgError`; messages contain the requirement, the value and
the fix.
"""

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
    """The rounding step of coordinates is coarse for the spacing of the points."""


class CloudWarning(UserWarning):
    """A cloud has few points, or seems to have another up axis than assumed."""


class UnitWarning(PrecisionWarning):
    """The axes of a cloud seem to have different units, such as degrees and meters."""


class DepthWarning(UserWarning):
    """A camera or depth scale is assumed, or does not fit its depth image."""
