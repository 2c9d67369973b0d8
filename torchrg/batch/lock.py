"""The right to write into a directory, which one command has at a time."""

import os
import platform
import re
import time
import zlib
from collections.abc import Callable
from multiprocessing import reduction
from pathlib import Path
from typing import Any

from torchrg.errors import FormatError
from torchrg.io.files import make_mark, sync_folder

LOCK = ".torchrg.lock"
"""Name of the file that is locked."""
_HELD = re.compile(r"(?:([0-9a-f]{16}) )?(process \d+ on .*)?", re.DOTALL)
"""What is in it: a mark, which older versions did not write, and who holds it or did last."""
_PATIENCE_SECONDS = 5.0
"""Seconds to wait for another holder: the workers of a command that was killed end by then."""
_BEAT_SECONDS = 0.05
"""Seconds between two tries to take it."""


class DirectoryLock:
    """The right to write into a directory, held until every process that has this object ends.

    The lock is the operating system's own (``flock``) and goes with its last holder, however that
    one ends. It travels to the worker processes, so that what a killed command leaves running
    keeps the next one out.

    Args:
        folder: The directory; it exists.
        patience: Seconds to wait for another holder.

    Attributes:
        mark: Part of the names that holders of this lock write under before files have their own,
            the same for all of them; see :func:`torchrg.io.files.marked_parts`.

    Raises:
        FormatError: If another process holds the lock, or the file of the lock is another one.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with DirectoryLock(Path(folder)):
        ...         print("nobody else writes here")
        nobody else writes here
    """

    def __init__(self, folder: Path, *, patience: float = _PATIENCE_SECONDS) -> None:
        self.path = folder / LOCK
        end = time.monotonic() + patience
        self._open()
        try:
            while not self._take():
                if time.monotonic() >= end:
                    _, holder = self._read()
                    raise FormatError(
                        f"{folder}: another torchrg command ({holder or 'unknown'}) writes here; "
                        "wait for it, stop it, or choose another directory."
                    )
                time.sleep(_BEAT_SECONDS)
            mark, _ = self._read()
        except FormatError:
            os.close(self.descriptor)
            raise
        self.mark = mark or make_mark()
        text = f"{self.mark} process {os.getpid()} on {platform.node()}".encode()
        os.pwrite(self.descriptor, text, 0)
        os.ftruncate(self.descriptor, len(text))
        os.fsync(self.descriptor)
        sync_folder(folder)

    def mark_of(self, name: str) -> str:
        """Return the mark for one of several tasks that write into the directory side by side."""
        return f"{self.mark}{zlib.crc32(os.fsencode(name)):08x}"

    def remove(self) -> None:
        """Remove the file of the lock, which stays otherwise; nobody has the lock from here on."""
        self.path.unlink(missing_ok=True)

    def _open(self) -> None:
        """Open the file of the lock; one that is not there is made."""
        try:
            self.descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except OSError as error:
            raise FormatError(f"{self.path}: cannot be written: {error.strerror}.") from error

    def _read(self) -> tuple[str | None, str | None]:
        """Return the mark in the file of the lock, and who holds the lock or did last."""
        text = os.pread(self.descriptor, 400, 0).decode(errors="replace").rstrip("\0")
        held = _HELD.fullmatch(text)
        if held is None:
            raise FormatError(
                f"{self.path}: is in the way, it is no lock of torchrg; move it away, or choose "
                "another directory."
            )
        return held[1], held[2]

    def _take(self) -> bool:
        """Return whether the lock could be had."""
        import fcntl

        self._read()
        try:
            fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        if os.fstat(self.descriptor).st_nlink:
            return True
        # The last holder has removed it, and others will lock another one.
        removed = self.descriptor
        self._open()
        os.close(removed)
        return False

    def __enter__(self) -> "DirectoryLock":
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self.descriptor)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _hold, (reduction.DupFd(self.descriptor), self.mark)


def _hold(duplicate: Any, mark: str) -> DirectoryLock:  # noqa: ANN401
    """Return the lock in a process that was started with it."""
    lock = DirectoryLock.__new__(DirectoryLock)
    lock.descriptor, lock.mark = duplicate.detach(), mark
    return lock
