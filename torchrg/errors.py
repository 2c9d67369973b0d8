"""Exceptions and warnings of torchrg.

All exceptions derive from :class:`TorchrgError`; messages contain the requirement, the value and
the fix.
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

OUT_OF_MEMORY = "out of memory; use a machine with more memory, or a smaller part of the data."
"""Message of any out-of-memory error."""


OUT_OF_THREADS = (
    "no further thread can be started; raise the limit of processes, or set OMP_NUM_THREADS=1."
)
"""Message of any error at a limit of threads."""
_LIMITS = {
    "can't allocate memory": OUT_OF_MEMORY,
    "not enough memory": OUT_OF_MEMORY,
    "out of memory": OUT_OF_MEMORY,
    "failed to map segment": OUT_OF_MEMORY,
    "can't start new thread": OUT_OF_THREADS,
}
"""Messages by words in errors of Python, torch and the loader of libraries."""


def system_limit(error: BaseException) -> str:
    """Return the message of an error at a limit of the system, or "" for other errors.

    Example:
        >>> system_limit(MemoryError()) == OUT_OF_MEMORY
        True
        >>> system_limit(RuntimeError("can't start new thread"))[:24]
        'no further thread can be'
        >>> system_limit(RuntimeError("shape mismatch"))
        ''
    """
    if isinstance(error, MemoryError):
        return OUT_OF_MEMORY
    found = [message for words, message in _LIMITS.items() if words in str(error)]
    return found[0] if found and isinstance(error, RuntimeError | ImportError | SystemError) else ""


def add_note(error: BaseException, note: str) -> None:
    """Add a line to an error; to its message in Python 3.10, which has no notes.

    Example:
        >>> import traceback
        >>> error = ValueError("expected a floor")
        >>> add_note(error, "This was room 3.")
        >>> "room 3" in "".join(traceback.format_exception(error))
        True
    """
    if sys.version_info >= (3, 11):
        error.add_note(note)
    else:
        error.args = (f"{error} {note}",)


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
