"""Arrays of a cloud on disk, one a file, and the record of which files and steps there are.

A folder of work outlives its process and the power of its machine. What keeps the promise that the
same call goes on from there is the record: the name of a file is in it, on the disk, before the
file is made, and a step with the checksums of all that it wrote after it is done. So only what the
work has made is ever written over or removed, and a step of which the disk has lost a byte is done
again. The arrays themselves are never flushed, which would take several times as long.
"""

import errno
import json
import mmap
import os
import shutil
import stat
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from threading import Event, Thread
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import FormatError
from torchrg.io.files import DAMAGES, refusing, sync_folder

_RECORD = "tiles.json"
_BEGIN = b'{"identity"'
"""What every record begins with."""

_CHECKED_AT_ONCE = 2**22
"""Bytes that are read at a time to see whether they are still what was written."""

_RELEASE_SECONDS = 0.005
"""Pages of a file that were read are given back so often: rows that lie apart bring in up to 30 MB
a millisecond, sixteen pages each."""


class Written(NamedTuple):
    """Bytes that a step has written, to tell later whether the disk has kept them.

    Attributes:
        file: Name of the file.
        head: Length of the header that it begins with.
        start: The first of the bytes.
        size: How many they are.
        checksum: CRC-32 of the header and of the bytes.
    """

    file: str
    head: int
    start: int
    size: int
    checksum: int


class _Record:
    """What is known of the work: lines of JSON that only become more, each flushed to the disk.

    The first line is the ``identity`` of the work. Others name files that are ``made`` next, files
    that are ``gone``, and a step that is ``done`` with what it ``found`` and ``wrote``. Each ends
    with its CRC-32. A last line that is not whole was being written when the process or the power
    went; it does not count, and the next line takes its place.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.identity: Any = None
        self.files: set[str] = set()
        self.done: dict[str, dict[str, Any]] = {}
        self._length = 0
        try:
            with _open(path, os.O_RDONLY) as stream:
                content = stream.read()
        except FileNotFoundError:
            return
        except OSError as error:
            raise FormatError(
                f"{path}: cannot be read: {error.strerror}; move it away, or choose another "
                "directory."
            ) from error
        if not _BEGIN.startswith(content[: len(_BEGIN)].rstrip(b"\0")):
            raise FormatError(
                f"{path}: is in the way, it is no record of torchrg; move it away, or choose "
                "another directory."
            )
        *lines, rest = content.split(b"\n")
        for number, line in enumerate(lines, 1):
            entry = _parsed(line)
            if entry is not None:
                self._take(entry)
                self._length += len(line) + 1
            elif number < len(lines) or rest:
                raise FormatError(
                    f"{path}: line {number} is damaged; remove {path.parent} and run the same "
                    "again."
                )

    def append(self, **entry: Any) -> None:  # noqa: ANN401 - anything JSON holds
        """Write a line; it is on the disk when this returns."""
        text = json.dumps(entry).encode()
        with _writing(self.path), _open(self.path, os.O_RDWR | os.O_CREAT) as stream:
            stream.seek(self._length)
            stream.write(b"%s %08x\n" % (text, zlib.crc32(text)))
            length = stream.tell()
            stream.truncate()
            stream.flush()
            os.fsync(stream.fileno())
        if self._length == 0:
            sync_folder(self.path.parent)
        self._length = length
        self._take(json.loads(text))

    def _take(self, entry: dict[str, Any]) -> None:
        self.identity = entry.get("identity", self.identity)
        self.files.update(entry.get("made", ()))
        self.files.difference_update(entry.get("gone", ()))
        if "done" in entry:
            self.done[entry["done"]] = entry


def _parsed(line: bytes) -> dict[str, Any] | None:
    """Return what a line of a record says, None if it is not whole."""
    text, _, checksum = line.rpartition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        return None
    entry: dict[str, Any] = json.loads(text)
    return entry


class TileFiles:
    """The arrays of one run, and which of its steps are done, in a folder that outlives it.

    Every array is an ``.npy`` file of one row a point. Rows are written where they belong, by any
    process that sees the folder, and never through a memory map: a full disk is an error then, not
    the end of the process. One process at a time may make files and note steps.

    Args:
        folder: Where the files are. It is made if it does not exist, and may hold nothing but
            hidden files otherwise.
        identity: What decides the results. Work that another identity left there is refused.

    Raises:
        FormatError: If the folder holds the work of another run or something else, or cannot be
            written.
    """

    def __init__(self, folder: Path, identity: dict[str, Any] | None = None) -> None:
        self.folder = folder
        self.written: list[Written] = []
        if identity is None:
            return
        make_folder(folder)
        identity = json.loads(json.dumps(identity))
        if self._record.identity is None:
            self._record.append(identity=identity)
        elif self._record.identity != identity:
            raise FormatError(
                f"{folder}: holds the work of another cloud, of other settings or of another "
                "version; remove it, or choose another directory."
            )

    @cached_property
    def _record(self) -> _Record:
        return _Record(self.folder / _RECORD)

    def note(self, step: str, written: Sequence[Written] = (), **found: Any) -> None:  # noqa: ANN401
        """Note that a step is done, and what it found.

        What another process has ``written`` for it comes with it, what this one has is known.
        """
        parts = [*self.written, *written]
        self.written.clear()
        self._record.append(done=step, found=found, wrote=parts)

    @property
    def is_begun(self) -> bool:
        """Whether any step is done."""
        return bool(self._record.done)

    def is_done(self, step: str) -> bool:
        """Return whether a step is done, and the disk still has what it wrote."""
        if step not in self._record.done:
            return False
        return all(self._has(Written(*part)) for part in self._record.done[step]["wrote"])

    def _has(self, part: Written) -> bool:
        """Return whether a file still has bytes that were written to it."""
        try:
            with (self.folder / part.file).open("rb") as stream:
                checksum = zlib.crc32(stream.read(part.head))
                stream.seek(part.start)
                for start in range(0, part.size, _CHECKED_AT_ONCE):
                    some = stream.read(min(part.size - start, _CHECKED_AT_ONCE))
                    checksum = zlib.crc32(some, checksum)
        except OSError:
            return False
        return checksum == part.checksum

    def facts(self, step: str) -> dict[str, Any] | None:
        """Return what a step found, None if it has never been done."""
        facts: dict[str, Any] | None = self._record.done.get(step, {}).get("found")
        return facts

    def known(self, step: str) -> dict[str, Any]:
        """Return what a step that is done found."""
        facts: dict[str, Any] = self._record.done[step]["found"]
        return facts

    def path(self, name: str) -> Path:
        """Return the file of an array."""
        return self.folder / f"{name}.npy"

    def reserve(self, *files: str) -> None:
        """Make files that the work has not made yet, empty; their names are in the record before.

        Raises:
            FormatError: If a file is there that is not in the record.
        """
        new = [file for file in files if file not in self._record.files]
        for file in new:
            if os.path.lexists(self.folder / file):
                raise FormatError(
                    f"{self.folder / file}: is in the way, this work has not made it; move it "
                    "away, or choose another directory."
                )
        if new:
            self._record.append(made=new)
        for file in new:
            with _writing(self.folder / file):
                (self.folder / file).touch(exist_ok=False)

    @contextmanager
    def opened(self, file: str) -> Iterator[IO[bytes]]:
        """Give a reserved file to write to; no link is followed."""
        path = self.folder / file
        with _writing(path), _open(path, os.O_RDWR | os.O_CREAT) as stream:
            yield stream

    def create(self, name: str, dtype: Any, shape: Sequence[int]) -> None:  # noqa: ANN401
        """Make an array that :meth:`write` fills; rows of an earlier one stay."""
        file = self.path(name).name
        self.reserve(file)
        with self.opened(file) as stream:
            header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": tuple(shape)}
            np.lib.format.write_array_header_1_0(stream, header)
            stream.truncate(stream.tell() + int(np.prod(shape)) * np.dtype(dtype).itemsize)

    def write(self, name: str, start: int, values: NDArray[Any] | Tensor) -> None:
        """Write rows of an array from row ``start`` on; other processes may write others."""
        file = self.path(name).name
        with self.opened(file) as stream:
            with reading(self.path(name)):
                np.lib.format.read_magic(stream)
                shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
            head = stream.tell()
            row_bytes = int(np.prod(shape[1:])) * dtype.itemsize
            given = values.numpy() if isinstance(values, Tensor) else values
            rows = np.ascontiguousarray(given, dtype=dtype)
            self._put(file, stream, head, head + start * row_bytes, rows)

    def _put(self, file: str, stream: IO[bytes], head: int, start: int, rows: NDArray[Any]) -> None:
        """Write bytes behind a header, and remember what has been written."""
        stream.seek(0)
        checksum = zlib.crc32(rows.data, zlib.crc32(stream.read(head)))
        stream.seek(start)
        stream.write(rows.data)
        self.written.append(Written(file, head, start, rows.nbytes, checksum))

    def save(self, name: str, values: NDArray[Any] | Tensor) -> None:
        """Write a whole array."""
        rows = values.numpy() if isinstance(values, Tensor) else values
        self.create(name, rows.dtype, rows.shape)
        self.write(name, 0, rows)

    def save_bytes(self, file: str, content: bytes) -> None:
        """Write a file that is no array."""
        self.reserve(file)
        with self.opened(file) as stream:
            stream.truncate(0)
            self._put(file, stream, 0, 0, np.frombuffer(content, np.uint8))

    def map(self, name: str) -> Tensor:
        """Return an array whose pages are read when they are needed; changes stay in memory."""
        return torch.from_numpy(_map(self.path(name)))

    def load(self, name: str) -> Tensor:
        """Return an array in memory."""
        with reading(self.path(name)):
            return torch.from_numpy(np.load(self.path(name)))

    def remove(self, *files: str) -> None:
        """Remove files that no other step reads."""
        self._unlink(*files)
        self._record.append(gone=files)
        self.written = [part for part in self.written if part.file not in files]

    def remove_all(self) -> None:
        """Remove every file that the work has made, and the folder if nothing else is in it."""
        self._unlink(*self._record.files)
        self._unlink(_RECORD)
        with suppress(OSError):
            self.folder.rmdir()

    def _unlink(self, *files: str) -> None:
        """Remove files of the work; what has taken the place of one is not of the work."""
        for path in (self.folder / file for file in files):
            with suppress(FileNotFoundError):
                if stat.S_ISREG(path.lstat().st_mode):
                    path.unlink()
        # What the record no longer knows must not come back with the power.
        sync_folder(self.folder)

    def check_space(self, needed: int) -> None:
        """Raise FormatError if the disk has not so many bytes free."""
        free = shutil.disk_usage(self.folder).free
        if needed > free:
            raise FormatError(
                f"{self.folder}: expected {needed / 1e6:,.1f} MB of free disk for the work, got "
                f"{free / 1e6:,.1f} MB; make room or choose another directory."
            )


def make_folder(folder: Path) -> None:
    """Make a folder for work; one that exists has to hold work, or nothing but hidden files.

    Raises:
        FormatError: If something else is there, or the folder cannot be made.
    """
    if folder.is_symlink():
        raise FormatError(
            f"{folder}: expected a directory, got a symbolic link; name what it leads to, or "
            "choose another directory."
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir() if path.name[0] != ".")
    except OSError as error:
        raise FormatError(f"{folder}: cannot be made: {error.strerror or error}.") from error
    if _RECORD in names:
        _Record(folder / _RECORD)
    elif names:
        raise FormatError(
            f"{folder}: expected an empty directory or the work of an earlier call, got a "
            f"directory with {names[0]}; choose another."
        )


def _open(path: Path, flags: int) -> IO[bytes]:
    """Open a file, but not where a symbolic link leads to."""
    mode = "rb" if flags == os.O_RDONLY else "rb+"
    return os.fdopen(os.open(path, flags | os.O_NOFOLLOW, 0o666), mode)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise what the system says of a file that cannot be written as a FormatError."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        repair = "; make room and run the same again, it goes on from here" if full else ""
        raise FormatError(f"{path}: cannot be written: {error.strerror}{repair}.") from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise what is found wrong with a file of the work as a FormatError."""
    repair = f"; run the same again, or remove {path.parent} and begin anew"
    with refusing(f"{path}: is damaged: ", *DAMAGES, OSError, repair=repair):
        yield


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
    with reading(path):
        try:
            values: NDArray[Any] = np.load(path, mmap_mode="c")
        except ValueError:
            values = np.load(path)
    return values
