"""One writer at a time in an output directory, by a lock that no crash leaves behind."""

import os
import platform
import time
from collections.abc import Callable
from multiprocessing import reduction
from pathlib import Path
from typing import Any

from torchrg.errors import FormatError

LOCK = ".torchrg.lock"
"""Name of the file that is locked. It stays when the lock goes."""
PATIENCE_SECONDS = 5.0
"""How long a lock that is held is waited for: workers of a command that was killed end by then."""


class DirectoryLock:
    """The right to write into a directory, held until every process that has this object ends.

    The lock is the operating system's own (``flock``) and goes with its last holder, however that
    one ends. It travels to the worker processes, so that what a killed command leaves running
    keeps the next one out.

    Args:
        folder: The directory; it exists.
        patience: Seconds to wait for another holder.

    Raises:
        FormatError: If another process holds the lock.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with DirectoryLock(Path(folder)):
        ...         print("nobody else writes here")
        nobody else writes here
    """

    def __init__(self, folder: Path, *, patience: float = PATIENCE_SECONDS) -> None:
        import fcntl

        self.descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        end = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    holder = os.pread(self.descriptor, 200, 0).decode(errors="replace").strip()
                    os.close(self.descriptor)
                    raise FormatError(
                        f"{folder}: another torchrg convert ({holder or 'unknown'}) writes here; "
                        "wait for it, stop it, or choose another directory."
                    ) from None
                time.sleep(0.05)
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, f"process {os.getpid()} on {platform.node()}".encode(), 0)

    def __enter__(self) -> "DirectoryLock":
        return self

    def __exit__(self, *error: object) -> None:
        os.close(self.descriptor)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return _hold, (reduction.DupFd(self.descriptor),)


def _hold(duplicate: Any) -> DirectoryLock:  # noqa: ANN401
    """Return the lock in a process that was started with it."""
    lock = DirectoryLock.__new__(DirectoryLock)
    lock.descriptor = duplicate.detach()
    return lock
