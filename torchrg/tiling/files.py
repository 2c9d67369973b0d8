"""Arrays of a cloud on disk, one a file, written and read in ranges of rows."""

import errno
import json
import mmap
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.io.files import atomic_path, remove_leftovers

_RECORD = "tiles.json"
"""Says of which cloud and settings the arrays are, and which steps are done."""

_RELEASE_SECONDS = 0.005
"""Pages of a file that were read are given back so often: rows that lie apart bring in up to 30 MB
a millisecond, sixteen pages each."""


class TileFiles:
    """The arrays of one run, and which of its steps are done, in a folder that outlives it.

    Every array is an ``.npy`` file of one row a point. Rows are written where they belong, by any
    process that sees the folder, and never through a memory map: a full disk is an error then, not
    the end of the process.

    Args:
        folder: Where the files are; made if it does not exist.
        identity: What decides the results. Work that another identity left there is refused.

    Raises:
        FormatError: If the folder holds the work of another run, or cannot be written.
    """

    def __init__(self, folder: Path, identity: dict[str, Any] | None = None) -> None:
        self.folder = folder
        record = folder / _RECORD
        if identity is None:
            return
        identity = json.loads(json.dumps(identity))
        folder.mkdir(parents=True, exist_ok=True)
        if not record.exists():
            self._write_record({"identity": identity, "done": {}})
        elif self._read_record()["identity"] != identity:
            raise FormatError(
                f"{folder}: holds the work of another cloud, of other settings or of another "
                "version; remove it, or choose another directory."
            )

    def _read_record(self) -> dict[str, Any]:
        try:
            record: dict[str, Any] = json.loads((self.folder / _RECORD).read_bytes())
        except (OSError, ValueError) as error:
            raise FormatError(
                f"{self.folder / _RECORD}: cannot be read: {error}; remove the directory."
            ) from error
        return record

    def _write_record(self, record: dict[str, Any]) -> None:
        with atomic_path(self.folder / _RECORD) as beside:
            beside.write_text(json.dumps(record, sort_keys=True) + "\n", encoding="utf-8")

    def note(self, step: str, **facts: Any) -> None:  # noqa: ANN401 - anything JSON holds
        """Note that a step is done, and what it found."""
        record = self._read_record()
        record["done"][step] = facts
        self._write_record(record)

    @property
    def is_begun(self) -> bool:
        """Whether any step is done."""
        return (self.folder / _RECORD).exists() and bool(self._read_record()["done"])

    def facts(self, step: str) -> dict[str, Any] | None:
        """Return what a step found, None if it is not done."""
        facts: dict[str, Any] | None = self._read_record()["done"].get(step)
        return facts

    def known(self, step: str) -> dict[str, Any]:
        """Return what a step that is done found."""
        facts: dict[str, Any] = self._read_record()["done"][step]
        return facts

    def path(self, name: str) -> Path:
        """Return the file of an array."""
        return self.folder / f"{name}.npy"

    def create(self, name: str, dtype: Any, shape: Sequence[int]) -> None:  # noqa: ANN401
        """Make an array that :meth:`write` fills."""
        with self.writing(self.path(name)), self.path(name).open("wb") as stream:
            header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": tuple(shape)}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.truncate(stream.tell() + int(np.prod(shape)) * np.dtype(dtype).itemsize)

    def write(self, name: str, start: int, values: NDArray[Any] | Tensor) -> None:
        """Write rows of an array from row ``start`` on; other processes may write others."""
        rows = values.numpy() if isinstance(values, Tensor) else values
        with self.writing(self.path(name)), self.path(name).open("rb+") as stream:
            np.lib.format.read_magic(stream)
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
            row_bytes = int(np.prod(shape[1:])) * dtype.itemsize
            stream.seek(start * row_bytes, os.SEEK_CUR)
            stream.write(np.ascontiguousarray(rows, dtype=dtype).data)

    def save(self, name: str, values: NDArray[Any] | Tensor) -> None:
        """Write a whole array."""
        rows = values.numpy() if isinstance(values, Tensor) else values
        self.create(name, rows.dtype, rows.shape)
        self.write(name, 0, rows)

    def map(self, name: str) -> Tensor:
        """Return an array whose pages are read when they are needed; changes stay in memory."""
        return torch.from_numpy(_map(self.path(name)))

    def load(self, name: str) -> Tensor:
        """Return an array in memory."""
        return torch.from_numpy(np.load(self.path(name)))

    def remove(self, *names: str) -> None:
        """Remove arrays that no later step reads."""
        for name in names:
            self.path(name).unlink(missing_ok=True)

    def remove_all(self) -> None:
        """Remove everything of this run, and the folder if nothing else is in it."""
        remove_leftovers(self.folder)
        for pattern in ("*.npy", "*.raw", "*.pt", _RECORD):
            for path in self.folder.glob(pattern):
                path.unlink()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    @contextmanager
    def writing(self, path: Path) -> Iterator[None]:
        """Raise what the system says of a file that cannot be written as a FormatError."""
        try:
            yield
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            repair = "; make room and run the same again, it goes on from here" if full else ""
            raise FormatError(f"{path}: cannot be written: {error.strerror}{repair}.") from error

    def check_space(self, needed: int) -> None:
        """Raise FormatError if the disk has not so many bytes free."""
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise FormatError(
                f"{self.folder}: expected {needed / 1e6:,.1f} MB of free disk for the work, got "
                f"{free / 1e6:,.1f} MB; make room or choose another directory."
            )


@contextmanager
def released(path: Path) -> Iterator[Tensor]:
    """Give an array on disk of which only what was read last stays in memory."""
    values = _map(path)
    if len(values) == 0:
        yield torch.from_numpy(values)
        return
    pages: mmap.mmap = values._mmap  # type: ignore[attr-defined]  # noqa: SLF001 - no public way
    done = Event()

    def release() -> None:
        while not done.wait(_RELEASE_SECONDS):
            pages.madvise(mmap.MADV_DONTNEED)

    thread = Thread(target=release, daemon=True)
    thread.start()
    try:
        yield torch.from_numpy(values)
    finally:
        done.set()
        thread.join()


def _map(path: Path) -> NDArray[Any]:
    """Return an array whose pages are read when they are needed; an empty one has none."""
    try:
        values: NDArray[Any] = np.load(path, mmap_mode="c")
    except ValueError:
        values = np.load(path)
    return values
