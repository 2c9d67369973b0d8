"""What is checked about a file before anything is read from it."""

import struct
from pathlib import Path

from torchrg.errors import FormatError

# What libraries raise on damaged files beside their own errors, found by flipping bytes.
DAMAGES = (
    ValueError,
    LookupError,
    ArithmeticError,
    EOFError,
    RuntimeError,
    TypeError,
    AttributeError,
    AssertionError,
    MemoryError,
    struct.error,
)


def check_file(path: Path) -> int:
    """Check that a path is a file with something in it.

    Args:
        path: The file.

    Returns:
        Its size in bytes.

    Raises:
        FormatError: If there is no such file, it is a directory, or it is empty.
    """
    if path.is_dir():
        raise FormatError(f"{path}: expected a file, got a directory; name a file inside it.")
    try:
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise FormatError(f"{path}: no such file; check the spelling.") from error
    if size == 0:
        raise FormatError(f"{path}: byte 0: the file is empty; fetch or write it again.")
    return size


def check_promise(
    path: Path, *, byte: int, promised: int, available: int, content: str, at_least: bool = False
) -> None:
    """Compare a size that a header promises with what the file can hold.

    This comes before memory is taken, so that a damaged header cannot ask for all of it.

    Args:
        path: The file.
        byte: Where the content begins.
        promised: Bytes that the header asks for.
        available: Bytes that are there.
        content: What is promised, for the message.
        at_least: Whether ``promised`` is a lower bound of what is needed.

    Raises:
        FormatError: If more is promised than available.
    """
    if promised > available:
        least = "at least " if at_least else ""
        raise FormatError(
            f"{path}: byte {byte}: expected {least}{promised:,} bytes for {content}, got "
            f"{available:,}; the file is cut off or its header is wrong, fetch it again."
        )


def first_line(error: BaseException) -> str:
    r"""Return the first line of an error's message, or its name if it has none.

    Example:
        >>> first_line(ValueError("no points.\nSee the manual."))
        'no points'
    """
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
