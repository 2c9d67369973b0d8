"""File checks, atomic writing and error conversion."""

import codecs
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import struct
import tempfile
import tokenize
import unicodedata
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

from torchrg._limits import system_limit
from torchrg.errors import FormatError
from torchrg.structures.points import FilePath

PARSE_ERRORS = (
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
"""Exceptions that third-party readers raise on corrupt files, in addition to their own classes."""
ARCHIVE_ERRORS = (zipfile.BadZipFile, zlib.error, *PARSE_ERRORS)
"""Exceptions raised on corrupt archives."""
_PROBE_BYTES = 1 << 20
"""Bytes written to test whether a disk is full: more than the buffer of a library."""
_UTF_16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""First bytes of text as Excel and PowerShell write it."""
_CHECKED_END = 1 << 16
"""Bytes checked after the last record. Padding to a page is shorter."""
_MAX_NAME_BYTES = 255
"""Maximum length of a file name on common file systems."""
_URL = re.compile(r"(?:^|/)[A-Za-z][A-Za-z0-9+.-]+:/")
"""A URL, also as a path, which has a single slash. Drives of Windows have one letter."""
_MAX_HEADER_BYTES = 1 << 20
"""Maximum bytes of a header of lines; a longer one counts as corrupt."""
_MAX_DIGITS = 18
"""Maximum digits of a count; larger ones may not fit 64 bits."""
BYTES_PER_READ = 1 << 20
"""Bytes of a file read together, which bounds the memory."""
OUTPUT_MARK = "7472675f6f757470"
"""Mark of the temporary files of the one command that holds the lock of an output directory."""


@contextmanager
def atomic_path(
    path: str | os.PathLike[str], *, within: Path | None = None, mark: str = ""
) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` atomically if the block succeeds.

    The file is written next to its destination, flushed to disk, and renamed in one step; then the
    folder entry is flushed. If the block raises, an existing file is unchanged.

    Args:
        path: Destination. A symbolic link is followed.
        within: Folder on the same file system for the temporary file. Default: that of ``path``.
        mark: 16 hexadecimal digits in its name; see :func:`remove_leftovers`. Default: random.

    Yields:
        The temporary path to write to.

    Raises:
        FormatError: If the folder does not exist, or the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    end = f".{mark or secrets.token_hex(8)}{secrets.token_hex(4)}{target.suffix}"
    stem = os.fsencode(f".{target.stem}")[: _MAX_NAME_BYTES - len(os.fsencode(end))]
    name = f"{os.fsdecode(stem)}{end}"
    temporary = (target.parent if within is None else within) / name
    check_writable(path)
    try:
        with raise_os_error(temporary, OSError):
            yield temporary
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        temporary.replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise FormatError(f"{path}: cannot be written: {error.strerror or error}.") from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path, mark: str = "") -> None:
    """Remove the temporary files with a mark that a killed process left in a folder.

    No other process may write there under the same mark. Default: any mark.
    """
    for path in find_leftovers(folder, mark):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def find_leftovers(folder: Path, mark: str = "") -> list[Path]:
    """Return what :func:`remove_leftovers` would remove; folders only with a mark."""
    name = re.compile(rf"\..*\.{mark or '[0-9a-f]{16}'}[0-9a-f]{{8}}(\.[^.]*)?")
    with os.scandir(folder) as entries:
        return [
            Path(entry.path)
            for entry in entries
            if name.fullmatch(entry.name)
            and (entry.is_file(follow_symlinks=False) or (mark and not entry.is_symlink()))
        ]


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk, if the file system supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def is_unchanged(path: Path, stored: object) -> bool:
    """Return whether a path is a regular file with the stored fingerprint, or any for None."""
    is_regular = path.is_file() and not path.is_symlink()
    if stored is None or not is_regular:
        return is_regular
    has_size = isinstance(stored, dict) and stored.get("bytes") == path.stat().st_size
    return has_size and fingerprint(path) == stored


def fingerprint(path: Path) -> dict[str, Any]:
    """Return the size and the SHA-256 of a file."""
    return {"bytes": path.stat().st_size, "sha256": hash_file(path)}


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a regular file in hexadecimal."""
    check_regular(path)
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(BYTES_PER_READ):
            digest.update(block)
    return digest.hexdigest()


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that a path can be written, before long work.

    The folder exists and is writable. An existing target is a writable file, no device.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise FormatError(f"{path}: expected a file to write, got a directory; name a file in it.")
    if not target.parent.is_dir():
        raise FormatError(f"{path}: folder {target.parent} not found; create it first.")
    if target.exists() and not target.is_file():
        raise FormatError(f"{path}: expected a file to write, got a device; use another path.")
    for item in (target.parent, target):
        if item.exists() and not os.access(item, os.W_OK):
            raise FormatError(
                f"{path}: cannot be written: {item} is read-only; make it writable, or use another."
            )


def create_folder(path: Path) -> None:
    """Create a folder and its parents if missing; raise FormatError on failure."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FormatError(f"{path}: cannot be created: {error.strerror or error}.") from error


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error or one of its causes is a full disk, or an exceeded quota."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__
    return False


def free_space(folder: Path) -> int:
    """Return the free bytes on the disk of a folder, which may not exist yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free


def check_space(folder: Path, needed: int, what: str, *, repair: str = "") -> None:
    """Raise FormatError if the disk of a folder (which may not exist) has too few free bytes.

    ``what`` names the data to be written; ``repair`` is a further fix to suggest.
    """
    free = free_space(folder)
    if needed > free:
        ways = ["free some space", "choose another directory", *([repair] if repair else [])]
        raise FormatError(
            f"{folder}: expected {needed / 1e6:,.1f} MB of free disk for {what}, got "
            f"{free / 1e6:,.1f} MB; {', '.join(ways[:-1])}, or {ways[-1]}."
        )


def local_path(source: FilePath) -> Path:
    """Return the path of a local file or folder; raise FormatError for URLs and open files."""
    if isinstance(source, bytes | bytearray) or hasattr(source, "read"):
        raise FormatError(
            f"expected the path of a local file, got {type(source).__name__}; write its content to "
            "a temporary file with the suffix of its format."
        )
    path = Path(source)
    if _URL.search(str(source)) and not os.path.lexists(path):
        raise FormatError(
            f"{source}: expected a local path, got a URL; copy it first, for example with "
            "fsspec.open_local('simplecache::' + url, simplecache={'same_names': True})."
        )
    return path


def check_regular(path: Path) -> os.stat_result:
    """Return the status of a file or folder; raise FormatError for pipes and devices.

    Call it before opening a file: reading a pipe or a device may never end.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
        raise FormatError(f"{path}: expected a regular file, got a pipe or a device; remove it.")
    return status


def check_file(path: Path) -> int:
    """Check that a path is a non-empty regular file, and return its size in bytes."""
    try:
        status = check_regular(path)
    except FileNotFoundError as error:
        raise FormatError(f"{path}: file not found; check the path.") from error
    except FormatError:
        raise
    except (OSError, ValueError) as error:  # ValueError: not a valid file name.
        raise FormatError(
            f"{path}: cannot be read: {getattr(error, 'strerror', error)}."
        ) from error
    if stat.S_ISDIR(status.st_mode):
        raise FormatError(
            f"{path}: expected a file, got a directory; name a file in it, or run convert folder."
        )
    if status.st_size == 0:
        raise FormatError(f"{path}: byte 0: the file is empty; copy or write it again.")
    return status.st_size


def find_encoding(path: Path) -> str:
    """Return the encoding of a text file: UTF-16 with a byte order mark, else UTF-8."""
    with path.open("rb") as stream:
        return "utf-16" if stream.read(2) in _UTF_16_MARKS else "utf-8-sig"


def decode_file(path: Path) -> str:
    """Return the UTF-8 text of a file, without a byte order mark."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}.") from error
    try:
        byte = content.find(b"\0")  # Never in UTF-8 text, always in UTF-16 text.
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        byte = error.start
    if byte >= 0:
        found = "UTF-16" if content[:2] in _UTF_16_MARKS else repr(content[byte : byte + 1])
        raise FormatError(f"{path}: byte {byte}: expected UTF-8, got {found}; save it as UTF-8.")
    return text


def open_lines(path: Path, last: bytes) -> BinaryIO:
    r"""Open a file with a header; lines that end in ``\r`` alone end in ``\n`` in a copy.

    ``last`` begins the last line of the header. All lines of ASCII files are changed.
    """
    stream = path.open("rb")
    first = stream.readline(_CHECKED_END)
    stream.seek(0)
    if b"\r" not in first[:-2] or not first.partition(b"\r")[0].isascii():
        return stream
    with stream:
        content = stream.read()
    end = content.find(b"\r", content.find(last)) + 1
    end = len(content) if re.search(rb"(format|DATA) ascii", content[:end]) else end
    copy = cast(BinaryIO, tempfile.TemporaryFile())  # noqa: SIM115 The caller closes it.
    copy.write(content[:end].replace(b"\r", b"\n") + content[end:])
    copy.seek(0)
    return copy


def check_available(
    path: Path, byte: int, needed: int, content: str, *, available: int, at_least: bool = False
) -> None:
    """Check that the bytes which a header announces at a position can be in the file.

    Call it before allocating, so that a corrupt header cannot exhaust the memory. With
    ``at_least``, ``needed`` is a lower bound.
    """
    if needed > available:
        prefix = "at least " if at_least else ""
        raise FormatError(
            f"{path}: byte {byte}: expected {prefix}{needed:,} bytes for {content}, got "
            f"{available:,}; the file is truncated or its header is wrong, write or copy it again."
        )


def check_end(path: Path, stream: BinaryIO, record_bytes: int = 0) -> tuple[str, ...]:
    """Check that no records follow the last one of a file, and return notes.

    Trailing text is skipped with a note. In a binary file, trailing bytes of at least a record are
    an error, because the types in the header may be wrong. Zeros are allowed: PCL pads files.
    """
    start = stream.tell()
    is_padding = not stream.read(_CHECKED_END).strip(b"\0 \t\r\n")
    num_bytes = os.fstat(stream.fileno()).st_size - start
    if is_padding or num_bytes < record_bytes:
        return ()
    if not record_bytes:
        return (f"{num_bytes:,} bytes after its last point are ignored, beyond its header's count",)
    raise FormatError(
        f"{path}: byte {start}: expected the end of the file by its header, got {num_bytes:,} more "
        "bytes; correct the count or the types in the header, or write the file again."
    )


@contextmanager
def raise_os_error(path: Path, *errors: type[BaseException]) -> Iterator[None]:
    """Raise the system's OSError if a library hides it while writing.

    On a full disk, or at a limit of the file size, writing a few extra bytes raises it.
    """
    try:
        yield
    except errors as error:
        if getattr(error, "errno", None) is not None:
            raise
        with path.open("ab") as stream:
            stream.write(bytes(_PROBE_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        raise


@contextmanager
def wrap_errors(message: str, *errors: type[BaseException], repair: str = "") -> Iterator[None]:
    """Convert library errors to FormatError: the message, the error's first line, the repair.

    A FormatError, which is a ValueError, is raised unchanged.
    """
    try:
        yield
    except FormatError:
        raise
    except errors as error:
        if limit := system_limit(error):
            raise FormatError(f"{message}{limit}") from error
        raise FormatError(f"{message}{first_line(error)}{repair}.") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message without a full stop, or its class name."""
    return (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")


def list_some(names: Sequence[str], max_names: int) -> str:
    """List names for a message of one line, at most ``max_names``."""
    more = f" and {len(names) - max_names:,} more" if len(names) > max_names else ""
    return f"{', '.join(names[:max_names])}{more}"


def normalize_file_name(name: str) -> str:
    """Normalize a name so that names which collide on some file systems become equal.

    macOS and Windows ignore case and the composition of accented letters.
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())


def header_lines(path: Path, stream: BinaryIO, last: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and words of each line of a header, up to one that begins with ``last``.

    The stream is then at the first data byte.
    """
    number, words = 0, list[str]()
    while words[:1] != [last]:
        number += 1
        raw = stream.readline(_MAX_HEADER_BYTES)
        if not raw.endswith(b"\n") or stream.tell() > _MAX_HEADER_BYTES:
            raise FormatError(
                f"{path}: line {number}: expected the header to end with {last!r}; the file "
                "is truncated or of another format, write or copy it again."
            )
        words = split_words(raw)
        yield number, words


def parse_count(word: str) -> int | None:
    """Parse a count of points or records; return None for any other word."""
    is_count = word.isascii() and word.isdecimal() and len(word) <= _MAX_DIGITS
    return int(word) if is_count else None


def split_words(raw: bytes) -> list[str]:
    r"""Split a header line into words, decoded as UTF-8, or as Latin-1 from some programs."""
    try:
        return [word.decode() for word in raw.split()]
    except UnicodeDecodeError:
        return [word.decode("latin-1") for word in raw.split()]
