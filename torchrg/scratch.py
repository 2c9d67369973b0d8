"""Large arrays in a file without a name, for clouds that are larger than memory.

Of the memory that a point takes while its planes are found, most is in the lists of neighbours.
Within :func:`on_disk` these are shared maps of temporary files that are unlinked as soon as they
are open: they leave with the process, however it ends, and nothing can be left behind, be locked or
be damaged. Whoever reads or writes such an array does not know.
"""

import math
import mmap
import os
import tempfile
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError

_MIN_BYTES = 2**24
"""Bytes of the smallest array that goes to the disk; all smaller ones together are few."""
BYTES_PER_NEIGHBOR = 9
"""Bytes that a neighbour of a point takes at most: four in its list, and four and a mark in that of
the neighbours of the same object."""
_RELEASE_SECONDS = 0.01
"""How often pages go back to the system. In that time some 20 MB of an array are read."""
_ZEROS = bytes(2**20)
"""Bytes that reserve a disk where the system has no call for that, as on macOS."""

Scalar = TypeVar("Scalar", bound=np.generic)

_folder: ContextVar[Path | None] = ContextVar("scratch", default=None)
_maps: "weakref.WeakSet[mmap.mmap]" = weakref.WeakSet()
_lock = threading.Lock()


def _renew_lock() -> None:
    """Give a forked process a lock of its own; a thread that it lacks may hold the other."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


@contextmanager
def on_disk(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep large arrays on the disk of a folder: results are the same, and memory is bounded.

    Segmenting a cloud then takes about 350 bytes of memory a point, with the pages of the files
    that the system has not yet taken back, and up to nine bytes of disk for each neighbor of a
    point.
    Inside a result there is no such array, so it can be used afterwards. The folder should be on a
    disk, as some ``/tmp`` is not.

    Raises:
        FormatError: If the disk has no room, or the folder cannot be written; before the array is
            used.

    Example:
        >>> import torchrg
        >>> room = torchrg.scenes.make_room(num_points=3_000, seed=0)
        >>> with on_disk("."):
        ...     seg = torchrg.segment_planes(room.points, "classic")
        >>> bool((seg.labels == torchrg.segment_planes(room.points, "classic").labels).all())
        True
    """
    token, is_done = _folder.set(Path(folder)), threading.Event()
    releaser = threading.Thread(target=_release_until, args=(is_done,), daemon=True)
    releaser.start()
    try:
        yield
    finally:
        is_done.set()
        releaser.join()
        _folder.reset(token)


def is_active() -> bool:
    """Return whether large arrays go to a disk."""
    return _folder.get() is not None


def empty(shape: Sequence[int], dtype: type[Scalar]) -> NDArray[Scalar]:
    """Return an array without values: ``numpy.empty``, but a large one on the disk if that is on.

    Example:
        >>> with on_disk("."):
        ...     empty((3, 2), np.int32).shape
        (3, 2)
    """
    folder, size = _folder.get(), math.prod(shape) * np.dtype(dtype).itemsize
    if folder is None or size < _MIN_BYTES:
        return np.empty(shape, dtype)
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                for start in range(0, size, len(_ZEROS)):
                    file.write(_ZEROS[: size - start])
            memory = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise FormatError(
            f"{folder}: expected {size / 1e9:,.2f} GB of disk for the work, got: {error.strerror}; "
            "make room, or set TMPDIR to a directory that has it."
        ) from error
    with _lock:
        _maps.add(memory)
    return np.frombuffer(memory, dtype).reshape(shape)


def _release_until(is_done: threading.Event) -> None:
    """Let the system take back the pages of all maps again and again; it can read them again."""
    while not is_done.wait(_RELEASE_SECONDS):
        release()


def release() -> None:
    """Let the system take back the pages of all maps, which it can read again.

    What reads rows here and there should ask for it now and then: with each of them a system maps
    the pages around it too, more in a hundredth of a second than a limit may leave room for.
    """
    with _lock:
        maps = list(_maps)
    for memory in maps:
        memory.madvise(mmap.MADV_DONTNEED)
