"""Large arrays in unnamed scratch files, for clouds larger than memory.

Within :func:`on_disk`, neighbor lists and the large arrays that hold a value per point are memory
maps of temporary files, unlinked once opened. The files are removed when the process exits, even on
a crash. Memory mapping is transparent to callers.
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
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError

__all__ = ["on_disk"]
__dir__ = __all__.copy

_MIN_BYTES = 2**22
"""Minimum size of an array on disk, in bytes; all smaller arrays together take little memory."""
BYTES_PER_NEIGHBOR = 9
"""Maximum bytes per neighbor of a point: four in the neighbor list, and five in the list of
neighbors of the same object (index and mask)."""
BYTES_PER_POINT = 200
"""Maximum bytes of the other arrays per point: coordinates, normals, labels and their copies."""
_RELEASE_SECONDS = 0.01
"""Interval for releasing pages, in seconds. Meanwhile about 20 MB of an array are read."""
_ZEROS = bytes(2**20)
"""Bytes that reserve disk space on systems without posix_fallocate, such as macOS."""
Scalar = TypeVar("Scalar", bound=np.generic)
Stored = TypeVar("Stored", Tensor, NDArray[Any])

_folder: ContextVar[Path | None] = ContextVar("scratch", default=None)
_maps: "weakref.WeakSet[mmap.mmap]" = weakref.WeakSet()
_lock = threading.Lock()


def _renew_lock() -> None:
    """Replace the lock in a forked process, where a thread of the parent may have held it."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew_lock)


@contextmanager
def on_disk(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Move large arrays to the disk of a folder, with identical results and bounded memory.

    Clouds read and segmented in this context have such arrays, and can be used afterwards. See
    :func:`torchrg.batch.memory.scan_memory` for the memory that remains. The folder should be on a
    disk: in a RAM disk, the arrays still take memory.

    Raises:
        FormatError: If the disk is too full, or the folder is not writable.

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
    """Return whether large arrays are moved to disk."""
    return _folder.get() is not None


def empty(shape: Sequence[int], dtype: type[Scalar] | np.dtype[Scalar]) -> NDArray[Scalar]:
    """Return an uninitialized array: ``numpy.empty``, or a map on disk if large and active."""
    folder, size = _folder.get(), math.prod(shape) * np.dtype(dtype).itemsize
    if folder is None or size < max(_MIN_BYTES, 1):
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
            f"{folder}: expected {size / 1e9:,.2f} GB of free disk space, got: {error.strerror}; "
            "free space, or set TMPDIR to a directory on another disk."
        ) from error
    with _lock:
        _maps.add(memory)
    return np.frombuffer(memory, dtype).reshape(shape)


def new_empty(like: Tensor, shape: Sequence[int]) -> Tensor:
    """Return an uninitialized tensor of a shape with the dtype and device of another."""
    if not is_active() or like.device.type != "cpu":
        return like.new_empty(shape)
    # NumPy's dtype, without converting values.
    return torch.from_numpy(empty(shape, like[:0].numpy().dtype))


def join(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Concatenate arrays in native byte order, on disk if the result is large and active."""
    shape = (sum(map(len, parts)), *parts[0].shape[1:])
    return np.concatenate(parts, out=empty(shape, np.result_type(*(part.dtype for part in parts))))


def store(values: Stored) -> Stored:
    """Return a copy on disk of an array or tensor, in its layout; itself if small or not active."""
    if not is_active() or values.nbytes < _MIN_BYTES:
        return values
    if isinstance(values, Tensor):
        return torch.from_numpy(store(values.numpy())) if values.device.type == "cpu" else values
    if values.T.flags.c_contiguous and not values.flags.c_contiguous:
        return store(values.T).T
    stored = empty(values.shape, values.dtype)
    stored[...] = values
    return stored


def _release_until(is_done: threading.Event) -> None:
    """Release the pages of all maps repeatedly; the system can read them again."""
    while not is_done.wait(_RELEASE_SECONDS):
        release()


def release() -> None:
    """Release the pages of all maps; the system can read them again.

    Code with random row access should call this regularly. Each access also maps surrounding pages,
    in a hundredth of a second more than a memory limit may allow.
    """
    with _lock:
        maps = list(_maps)
    for memory in maps:
        memory.madvise(mmap.MADV_DONTNEED)
