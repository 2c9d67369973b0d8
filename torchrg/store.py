"""Where the arrays of a run are: in memory, or one a file in a folder that outlives the process.

Both stores know arrays by name, write rows of them where they belong, and tell which steps are
done. In memory there is one block of rows, the whole cloud, and nothing is copied.

A folder of work outlives its process and the power of its machine. What keeps the promise that the
same call goes on from there is the record: the name of a file is in it, on the disk, before the
file is made, and a step with the checksums of all that it wrote after it is done. So only what the
work has made is ever written over or removed, and a step of which the disk has lost a byte is done
again. The arrays themselves are never flushed, which would take several times as long.
"""

import io
import itertools
import json
import os
import stat
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import ROWS_IN_CACHE, chunks_of, return_freed_memory
from torchrg.errors import ConfigError, FormatError
from torchrg.io.files import DAMAGES, is_disk_full, refusing, sync_folder
from torchrg.structures import Cloud, PlaneAdjacency, Planes, origin_of_box

TILE_SIZE = 300_000
"""Points of a tile unless the caller says. With 150,000 ``classic`` takes 0.05 less time and
``consensus``, which looks farther, 0.15 more; larger ones leave the cache of freed memory."""

_RECORD = "tiles.json"
_BEGIN = b'{"identity"'
"""What every record begins with."""

_RAW = "coordinates.raw"
_POINTS_AT_ONCE = 2**20
"""Points of a stream that are moved to their origin at a time."""

_CHECKED_AT_ONCE = 2**22
"""Bytes that are read at a time to see whether they are still what was written."""

_PAGE_BYTES = 4096
"""Bytes that a disk and its cache hold together: rows that lie apart are read with their page."""


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


Engine = Callable[[Sequence[Any]], Iterable[tuple[Any, Sequence[Written]]]]
"""Runs tasks, in any order and anywhere, and yields each when it is done, and what it has written.
"""


def run_in_turn(tasks: Sequence[Any]) -> Iterator[tuple[Any, Sequence[Written]]]:
    """Run tasks one after the other, each on as many threads as torch may use."""
    for task in tasks:
        yield task, task.run()


class FolderStore:
    """The arrays of one run, and which of its steps are done, in a folder that outlives it.

    Every array is an ``.npy`` file of one row a point. Rows are written where they belong, by any
    process that sees the folder, and never through a memory map: a full disk is an error then, not
    the end of the process. One process at a time may make files and note steps.

    Args:
        folder: Where the files are, about 500 bytes a point, ten neighbours less or more 40. It is
            made if it does not exist, and may hold nothing but hidden files otherwise.
        identity: What decides the results beside the settings, ready for JSON: of which files the
            points are. Work that another identity left there is refused.
        tile_size: Points of a tile.
        run: Runs the tasks of a stage, in other processes perhaps.
        on_progress: Called with the name of each stage, how many of its tiles are done, and of how
            many; with 0 and 1 for stages of the whole cloud.

    Raises:
        ConfigError: If ``tile_size`` is not positive.
    """

    def __init__(
        self,
        folder: str | Path,
        identity: Mapping[str, Any] | None = None,
        *,
        tile_size: int = TILE_SIZE,
        run: Engine = run_in_turn,
        on_progress: Callable[[str, int, int], None] | None = None,
    ) -> None:
        if tile_size < 1:
            raise ConfigError(f"FolderStore: expected tile_size >= 1, got {tile_size}.")
        self.folder = Path(folder)
        self.tile_size = tile_size
        self.run = run
        self.on_progress = on_progress or (lambda stage, done, of: None)
        self.written: list[Written] = []
        self._identity = identity or {}

    def begin(self, **identity: Any) -> None:  # noqa: ANN401
        """Make the folder, or go on with the work there.

        Raises:
            FormatError: If the folder holds the work of another run or something else, or cannot be
                written.
        """
        folder = self.folder
        make_folder(folder)
        identity = json.loads(json.dumps({**identity, **self._identity}))
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

    def once(self, step: str, work: Callable[[], None]) -> None:
        """Do a step on the whole cloud unless it is done; the work notes that it is."""
        self.on_progress(step, 0, 1)
        if not self.is_done(step):
            # Beside the arrays of the whole cloud, what tiles have freed would be too much.
            return_freed_memory()
            work()

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

    def known(self, step: str) -> dict[str, Any]:
        """Return what a step found, nothing if it has never been done."""
        found: dict[str, Any] = self._record.done.get(step, {}).get("found", {})
        return found

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

    def save_points(self, points: Tensor | Iterable[Cloud]) -> None:
        """Write points, those of chunks about the origin that the whole cloud has."""
        if isinstance(points, Tensor):
            self._check_known(num_points=len(points))
            self.save("points", points)
            self.note("points", num_points=len(points))
            return
        low, high, num_points, narrow = np.full(3, np.inf), np.full(3, -np.inf), 0, True
        self.reserve(_RAW)
        with self.opened(_RAW) as stream:
            stream.truncate(0)
            for chunk in points:
                coordinates = chunk.coordinates
                num_points += len(coordinates)
                narrow &= coordinates.dtype == np.float32
                stream.write(coordinates.astype(np.float64).tobytes())
                kept = coordinates[chunk.finite]
                if len(kept):
                    low, high = (
                        np.minimum(low, kept.min(axis=0)),
                        np.maximum(high, kept.max(axis=0)),
                    )
        origin = origin_of_box(low, high)
        found = {"num_points": num_points, "origin": origin.tolist()}
        self._check_known(**found)
        self.create("points", np.float32, (num_points, 3))
        dtype = np.float32 if narrow else np.float64
        for rows in chunks_of(num_points, _POINTS_AT_ONCE):
            count = (rows.stop - rows.start) * 3
            some = np.fromfile(self.folder / _RAW, np.float64, count, offset=rows.start * 24)
            self.write("points", rows.start, Cloud(some.reshape(-1, 3).astype(dtype)).about(origin))
        self.remove_files(_RAW)
        self.note("points", **found)

    def _check_known(self, **found: Any) -> None:  # noqa: ANN401
        """Refuse other points than those that were there."""
        if self.known("points") not in ({}, found):
            raise FormatError(
                f"{self.path('points')}: is damaged, and the points that are given now are others; "
                f"give the same again, or remove {self.folder}."
            )

    def save_planes(self, name: str, planes: Planes) -> None:
        """Write a table of planes."""
        adjacency = None if planes.adjacency is None else tuple(planes.adjacency)
        content = io.BytesIO()
        torch.save({**planes._asdict(), "adjacency": adjacency}, content)
        file = f"{name}.pt"
        self.reserve(file)
        with self.opened(file) as stream:
            stream.truncate(0)
            self._put(file, stream, 0, 0, np.frombuffer(content.getvalue(), np.uint8))

    def load_planes(self, name: str) -> Planes:
        """Return a table of planes."""
        path = self.folder / f"{name}.pt"
        with reading(path):
            values = torch.load(path, weights_only=True)
        adjacency = values.pop("adjacency")
        return Planes(**values, adjacency=None if adjacency is None else PlaneAdjacency(*adjacency))

    def get(self, name: str) -> Tensor:
        """Return an array in memory."""
        with reading(self.path(name)):
            return torch.from_numpy(np.load(self.path(name)))

    def read(self, name: str) -> Any:  # noqa: ANN401 - FileRows in the place of an array
        """Return an array that stays on disk: only its rows can be had, as arrays in memory."""
        return FileRows(self.path(name))

    def lazy(self, name: str) -> Tensor:
        """Return an array that stays on disk: only its rows can be had, as tensors in memory."""
        return RowsOnDisk(FileRows(self.path(name)))

    def map(self, name: str) -> Tensor:
        """Return an array whose pages are read when they are needed; changes stay in memory."""
        with reading(self.path(name)):
            try:
                values = np.load(self.path(name), mmap_mode="c")
            except ValueError:  # An empty one has no pages.
                values = np.load(self.path(name))
        return torch.from_numpy(values)

    def remove(self, *names: str) -> None:
        """Remove arrays that no other step reads."""
        self.remove_files(*(self.path(name).name for name in names))

    def remove_files(self, *files: str) -> None:
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
        again = "; make room and run the same again, it goes on from here"
        repair = again if is_disk_full(error) else ""
        raise FormatError(f"{path}: cannot be written: {error.strerror}{repair}.") from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise what is found wrong with a file of the work as a FormatError."""
    repair = f"; run the same again, or remove {path.parent} and begin anew"
    with refusing(f"{path}: is damaged: ", *DAMAGES, OSError, repair=repair):
        yield


class FileRows:
    """The rows of an array in an ``.npy`` file, read anew each time they are asked for."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path):
            self._file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
            weakref.finalize(self, os.close, self._file)
            with os.fdopen(os.dup(self._file), "rb") as stream:
                np.lib.format.read_magic(stream)
                self.shape, _, self.dtype = np.lib.format.read_array_header_1_0(stream)
                self._head = stream.tell()
        self._row_bytes = int(np.prod(self.shape[1:])) * self.dtype.itemsize
        self._rows_at_once = max(_PAGE_BYTES // self._row_bytes, 1)

    def __len__(self) -> int:
        return int(self.shape[0])

    def __getitem__(self, rows: slice | NDArray[np.integer]) -> NDArray[Any]:
        """Return a run of rows, or those of any numbers, in their order."""
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(len(self))
            found = np.empty((max(stop - start, 0), *self.shape[1:]), self.dtype)
            self._read(found, start)
            return found
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for chunk in chunks_of(len(rows), ROWS_IN_CACHE):
            some = rows[chunk]
            if some[-1] - some[0] == len(some) - 1 and bool((np.diff(some) == 1).all()):
                self._read(found[chunk], int(some[0]))
            else:
                self._gather(some, found[chunk])
        return found

    def _gather(self, rows: NDArray[np.integer], found: NDArray[Any]) -> None:
        """Read the pages that rows are on, those in a row at a time, and take the rows of these."""
        pages = rows // self._rows_at_once
        first = int(pages.min())
        place = np.zeros(int(pages.max()) - first + 1, dtype=np.int32)
        place[pages - first] = 1
        needed = np.flatnonzero(place)
        place[needed] = np.arange(len(needed))
        buffer = np.empty((len(needed) * self._rows_at_once, *self.shape[1:]), self.dtype)
        cuts = np.flatnonzero(np.diff(needed, prepend=-2) > 1)
        for begin, end in itertools.pairwise([*cuts.tolist(), len(needed)]):
            start = (first + int(needed[begin])) * self._rows_at_once
            count = min((end - begin) * self._rows_at_once, len(self) - start)
            into = begin * self._rows_at_once
            self._read(buffer[into : into + count], start)
        places = place[pages - first] * self._rows_at_once + rows % self._rows_at_once
        np.take(buffer, places, axis=0, out=found, mode="clip")

    def _read(self, into: NDArray[Any], start: int) -> None:
        """Fill rows from row ``start`` on."""
        left = into.reshape(-1).view(np.uint8)
        place = self._head + start * self._row_bytes
        while len(left):
            with reading(self._path):
                count = os.preadv(self._file, [left.data], place)
                if count == 0:
                    raise EOFError(f"it ends before row {start + len(into):,}")
            left, place = left[count:], place + count


class RowsOnDisk(Tensor):
    """A tensor in a file: its rows are tensors in memory, and nothing else can be done with it.

    Rows are copies, so what is written into them changes neither the file nor other rows.
    """

    _rows: FileRows
    _columns: slice
    # As torch documents it: what is not defined here goes to __torch_dispatch__.
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment] # noqa: SLF001

    @staticmethod
    def __new__(
        cls: type["RowsOnDisk"], rows: FileRows, columns: slice = slice(None)
    ) -> "RowsOnDisk":
        """Return the tensor, or some columns of it."""
        dtype = torch.from_numpy(np.empty(0, rows.dtype)).dtype
        shape = torch.Size(rows.shape)
        if len(shape) > 1:
            shape = torch.Size([shape[0], len(range(shape[1])[columns]), *shape[2:]])
        tensor: RowsOnDisk = Tensor._make_wrapper_subclass(cls, shape, dtype=dtype)  # noqa: SLF001
        tensor._rows, tensor._columns = rows, columns
        return tensor

    def __getitem__(self, rows: Any) -> Tensor:  # noqa: ANN401
        """Return a run of rows, or those of any numbers; of all rows, columns that stay on disk."""
        if isinstance(rows, tuple):
            rows, columns = rows
            if rows == slice(None) and isinstance(columns, slice):
                return RowsOnDisk(self._rows, columns)
            return self[rows][:, columns]
        numbers = rows if isinstance(rows, slice) else np.asarray(rows)
        found = torch.from_numpy(self._rows[numbers])
        return found if self._columns == slice(None) else found[:, self._columns]

    def __setitem__(self, rows: Any, values: Any) -> None:  # noqa: ANN401
        raise TypeError("expected rows of an array on disk to be read; write them by its store")

    @classmethod
    def __torch_dispatch__(cls, function: Any, *_: Any) -> Any:  # noqa: ANN401
        raise TypeError(f"{function}: expected rows of an array on disk; take those you need")
