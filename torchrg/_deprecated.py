"""Deprecation of public names."""

import warnings


def warn_deprecated(old: str, new: str, *, removal: str) -> None:
    """Warn that a public name is deprecated. Call it in the deprecated function itself.

    Args:
        old: The deprecated function or parameter, as users write it.
        new: Its replacement.
        removal: The version without it.
    """
    message = f"{old} is deprecated and will be removed in torchrg {removal}; use {new}."
    warnings.warn(message, DeprecationWarning, stacklevel=3)
