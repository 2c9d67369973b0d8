"""Files: checked before they are read, and written whole or not at all."""

import errno
import os
import re
import secrets
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrg.errors import FormatError

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
"""What libraries raise on damaged files beside their own errors, found by flipping bytes."""
_BESIDE = re.compile(r"\..*\.[0-9a-f]{8}(\.[^.]*)?")
"""Names that :func:`atomic_path` writes under."""


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a path to write to that takes the place of ``path`` once the block has ended well.

    The file is written beside its final place, flushed to the disk, and moved there in one step. If
    the block raises, nothing is left behind and an older file stays as it was. The suffix is kept.

    Args:
        path: Where the file shall be. A symbolic link is followed.

    Yields:
        The path to write to, in the same folder.

    Raises:
        FormatError: If the folder does not exist, or the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.txt"
        ...     with atomic_path(path) as beside:
        ...         _ = beside.write_text("whole")
        ...         print(path.exists())
        ...     print(path.read_text())
        False
        whole
    """
    target = Path(os.path.realpath(path))
    beside = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    check_place(path)
    try:
        yield beside
        with beside.open("rb+") as stream:
            os.fsync(stream.fileno())
        beside.replace(target)
    except OSError as error:
        # NumPy's error of a short write comes without its number; it is a full disk's.
        if error.errno is None and "requested and" in str(error):
            error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise FormatError(f"{path}: cannot be written: {error.strerror or error}.") from error
    finally:
        beside.unlink(missing_ok=True)


def remove_leftovers(folder: Path, *, of: str | None = None) -> None:
    """Remove what :func:`atomic_path` left in a folder when its process was killed.

    Nothing else may be writing there, or not to the file ``of`` a name, where only its leftovers
    are to go. Folders in it are left alone.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     Path(folder, ".a.0123abcd.txt").touch()
        ...     Path(folder, "a.txt").touch()
        ...     remove_leftovers(Path(folder))
        ...     [path.name for path in Path(folder).iterdir()]
        ['a.txt']
    """
    for path in folder.iterdir():
        is_of = of is None or path.name.startswith(f".{Path(of).stem}.")
        if is_of and _BESIDE.fullmatch(path.name):
            path.unlink(missing_ok=True)


def check_place(path: str | os.PathLike[str]) -> None:
    """Check that a file can be put at a path, so that this is not found out after long work.

    Its folder exists and takes files, and what is there already is a file that may be replaced: not
    a directory or device, and not read-only.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise FormatError(f"{path}: expected a file to write, got a directory; name a file in it.")
    if not target.parent.is_dir():
        raise FormatError(f"{path}: there is no folder {target.parent}; make it first.")
    if target.exists() and not target.is_file():
        raise FormatError(f"{path}: expected a file to write, got a device; name another.")
    for place in (target.parent, target):
        if place.exists() and not os.access(place, os.W_OK):
            raise FormatError(
                f"{path}: cannot be written: {place} is read-only; write to another place, or make "
                "it writable."
            )


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, if it is not there; raise FormatError if it cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"{path}: cannot be made: {error.strerror or error}.") from error


def check_file(path: Path) -> int:
    """Return the size of a file in bytes; it is there, no directory, and not empty."""
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
    path: Path, byte: int, promised: int, content: str, *, available: int, at_least: bool = False
) -> None:
    """Compare the bytes that a header promises from a place on with those that can be there.

    This comes before memory is taken, so that a damaged header cannot ask for all of it. With
    ``at_least``, ``promised`` is a lower bound of what is needed.
    """
    if promised > available:
        least = "at least " if at_least else ""
        raise FormatError(
            f"{path}: byte {byte}: expected {least}{promised:,} bytes for {content}, got "
            f"{available:,}; the file is cut off or its header is wrong, fetch it again."
        )


@contextmanager
def refusing(message: str, *errors: type[BaseException], repair: str = "") -> Iterator[None]:
    """Raise errors of a library as a FormatError: the message, the error's first line, the repair.

    A FormatError passes as it is, though it is a ValueError.
    """
    try:
        yield
    except FormatError:
        raise
    except errors as error:
        raise FormatError(f"{message}{first_line(error)}{repair}.") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its name if it has none; no full stop."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
