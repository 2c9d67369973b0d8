"""Files: checked before they are read, and written whole or not at all."""

import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import struct
import tokenize
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from torchrg.errors import OUT_OF_MEMORY, FormatError, is_out_of_memory

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
    SyntaxError,
    tokenize.TokenError,
    struct.error,
)
"""Errors that libraries raise of damaged files beside their own, as where bytes are flipped."""
ARCHIVE_DAMAGES = (zipfile.BadZipFile, zlib.error, *DAMAGES)
"""Errors that reading a damaged archive raises."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a full disk, and of a user who may not fill it further."""
_MORE_BYTES = 1 << 20
"""Bytes that are tried on a disk that may be full. They are more than a library writes at a time,
and do not fit where its last ones did not."""
_CHECKED_END = 1 << 16
"""Bytes after the last record that are looked at. Padding up to a page is shorter."""
_mark: ContextVar[str | None] = ContextVar("_mark", default=None)
"""Mark in the names that :func:`atomic_path` writes under here."""


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, within: Path | None = None) -> Iterator[Path]:
    """Give a path to write to that takes the place of ``path`` once the block has ended well.

    The file is written beside its final place, flushed to the disk, and moved there in one step;
    then its name is flushed too. If the block raises, nothing is left behind and an older file
    stays as it was. The suffix is kept.

    Args:
        path: Where the file shall be. A symbolic link is followed.
        within: Folder on the same disk in which it is written before. Default: that of ``path``.

    Yields:
        The path to write to.

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
    name = f".{target.stem}.{_mark.get() or make_mark()}{secrets.token_hex(4)}{target.suffix}"
    beside = (target.parent if within is None else within) / name
    check_place(path)
    try:
        yield beside
        with beside.open("rb+") as stream:
            os.fsync(stream.fileno())
        beside.replace(target)
        sync_folder(target.parent)
    except OSError as error:
        # NumPy's error of a short write comes without its number; it is a full disk's.
        if error.errno is None and "requested and" in str(error):
            error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        raise FormatError(f"{path}: cannot be written: {error.strerror or error}.") from error
    finally:
        beside.unlink(missing_ok=True)


def make_mark() -> str:
    """Return a mark for the names of one run, which no other file bears."""
    return secrets.token_hex(8)


@contextmanager
def marked_parts(mark: str) -> Iterator[None]:
    """Let :func:`atomic_path` write under names that bear a mark in this block, in this thread.

    Whoever knows the mark can then remove what a process left that was killed; without one, nobody
    can tell whose such a file is.
    """
    token = _mark.set(mark)
    try:
        yield
    finally:
        _mark.reset(token)


def remove_leftovers(folder: Path, mark: str) -> None:
    """Remove what :func:`atomic_path` left in a folder under a mark when its process was killed.

    Nothing may be writing there under the same mark.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("a.txt", ".a.0123456789abcdef01234567.txt", ".a.other.txt"):
        ...         Path(folder, name).touch()
        ...     remove_leftovers(Path(folder), "0123456789abcdef")
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['.a.other.txt', 'a.txt']
    """
    for path in find_leftovers(folder, mark):
        path.unlink(missing_ok=True)


def find_leftovers(folder: Path, mark: str) -> list[Path]:
    """Return the files that :func:`remove_leftovers` removes."""
    name = re.compile(rf"\..*\.{mark}[0-9a-f]{{8}}(\.[^.]*)?")
    with os.scandir(folder) as entries:
        return [
            Path(entry.path)
            for entry in entries
            if name.fullmatch(entry.name) and entry.is_file(follow_symlinks=False)
        ]


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, where its file system has a way to do so."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


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


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or what caused it, is a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return True
        error = error.__cause__
    return False


def free_space(folder: Path) -> int:
    """Return the free bytes of the disk on which a folder is, or would be made."""
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    return shutil.disk_usage(existing).free


def check_space(folder: Path, needed: int, what: str, *, repair: str = "") -> None:
    """Raise FormatError if the disk of a folder, which need not exist, has not so many bytes free.

    ``what`` takes the bytes; ``repair`` is a way out beside more room and another directory.
    """
    free = free_space(folder)
    if needed > free:
        ways = ["make room", "choose another directory", *([repair] if repair else [])]
        raise FormatError(
            f"{folder}: expected {needed / 1e6:,.1f} MB of free disk for {what}, got "
            f"{free / 1e6:,.1f} MB; {', '.join(ways[:-1])}, or {ways[-1]}."
        )


def check_file(path: Path) -> int:
    """Return the size of a file in bytes; it is there, no directory, and not empty."""
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise FormatError(f"{path}: no such file; check the spelling.") from error
    except (OSError, ValueError) as error:  # A name that no file can have.
        raise FormatError(
            f"{path}: cannot be read: {getattr(error, 'strerror', error)}."
        ) from error
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(f"{path}: expected a file, got a directory; name a file inside it.")
    if status.st_size == 0:
        raise FormatError(f"{path}: byte 0: the file is empty; copy or write it again.")
    return status.st_size


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, without the mark that some programs begin it with."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}.") from error
    try:
        place = content.find(b"\0")  # No text has it in UTF-8, and all have it in UTF-16.
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        place = error.start
    if place >= 0:
        raise FormatError(
            f"{path}: byte {place}: expected text in UTF-8, got {content[place : place + 1]!r}; "
            "save it as UTF-8."
        )
    return text


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
            f"{available:,}; the file is cut off or its header is wrong, write or copy it again."
        )


def check_end(path: Path, stream: BinaryIO, record_bytes: int = 0) -> tuple[str, ...]:
    """Check that the last record of a file has been read, and return notes.

    Text after it is left out with a note. Further bytes of a binary file, as many as a record or
    more, are an error: the header may give other types than the points have. Zeros may follow, as
    PCL fills files up to a page.
    """
    start = stream.tell()
    is_padding = not stream.read(_CHECKED_END).strip(b"\0 \t\r\n")
    num_bytes = os.fstat(stream.fileno()).st_size - start
    if is_padding or num_bytes < record_bytes:
        return ()
    if not record_bytes:
        return (f"{num_bytes:,} bytes after its last point left out, as its header counts no more",)
    raise FormatError(
        f"{path}: byte {start}: expected the end of the file, as its header says, got "
        f"{num_bytes:,} more bytes; correct the number or the types in the header, or write the "
        "file again."
    )


@contextmanager
def asking_system(path: Path, *errors: type[BaseException]) -> Iterator[None]:
    """Raise the operating system's error where that of a library, met while it wrote, hides it.

    What is in the way of a library, a full disk, is in the way of a few more bytes, too. The file
    is spoilt by them; nobody wants it any more.
    """
    try:
        yield
    except errors:
        with path.open("ab") as stream:
            stream.write(bytes(_MORE_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        raise


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
        if is_out_of_memory(error):
            raise FormatError(f"{message}{OUT_OF_MEMORY}") from error
        raise FormatError(f"{message}{first_line(error)}{repair}.") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its name if it has none; no full stop."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def mark_of(name: str) -> str:
    """Return the mark of the files that are being written for a scan in an output directory.

    It is the same in every run, so that each removes what one that was killed has left; see
    :func:`torchrg.io.files.marked_parts`.

    Example:
        >>> mark_of("Area_1/office_1")
        '65d1ec9889e61d51'
    """
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:16]


def folded_name(name: str) -> str:
    """Return what names have in common that some file systems take for the same.

    Those of macOS and Windows do not tell case apart, nor how letters with accents are put
    together, and what is written on others is carried there.

    Example:
        >>> folded_name("B\u00fcro") == folded_name("bu\u0308RO")
        True
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def words_of(raw: bytes) -> list[str]:
    r"""Return the words of a line of a header: UTF-8, or Latin-1, which some programs write.

    Example:
        >>> words_of("property float höhe".encode())
        ['property', 'float', 'höhe']
        >>> words_of(b"property float h\xf6he")
        ['property', 'float', 'höhe']
    """
    try:
        return [word.decode() for word in raw.split()]
    except UnicodeDecodeError:
        return [word.decode("latin-1") for word in raw.split()]
