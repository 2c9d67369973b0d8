"""Points of a file chunk by chunk: what a codec gives, and the clouds that come of it.

A codec gives a :class:`Table`: what the header says, and the columns when asked for. Names, the
range of colours and which dimensions are empty depend on all points, so a survey of the whole file
is made first where the columns leave them open; a file that is read as one needs none.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import (
    Columns,
    Naming,
    Span,
    assemble_cloud,
    color_spans,
    note_on_names,
    put_results,
)
from torchrg.structures import Cloud, origin_of_box

POINTS_A_CHUNK = 1 << 20
"""Points of a chunk. They take tens of megabytes, and calls for each chunk cost next to nothing."""
SILENT: dict[str, Any] = {"over": "ignore", "invalid": "ignore"}
"""Files may hold any bits as numbers: values that overflow or signal are kept, not reported."""


Fronts = tuple[NDArray[np.float32] | None, tuple[str, ...]]
"""The front of each point of a cloud, as :attr:`torchrg.Cloud.front`, and notes on it."""


class Table(NamedTuple):
    """The points of a file as columns by its own names, read when asked for.

    Attributes:
        read: Reads all points from the beginning, in chunks of at most so many, none of them empty
            unless the file is. Holds no file open before its first chunk or after its last.
        num_points: How many there are by the header; None where only reading tells.
        at_once: How many are read together where all are wanted; None for all.
        naming: How columns get their names where the values decide; None where the names stand.
        coordinates: Name of the column that holds all three; None where they are ``x y z``.
        grid_shape: That of the cloud.
        header: That of the cloud.
        notes: Those of the cloud but for names that the values decide.
        fronts: Finds on which side the points were seen, of the whole cloud; None where the file
            says nothing about it.
    """

    read: Callable[[int], Iterator[Columns]]
    num_points: int | None
    at_once: int | None = None
    naming: Naming | None = None
    coordinates: str | None = None
    grid_shape: tuple[int, int] | None = None
    header: Mapping[str, Any] = {}
    notes: tuple[str, ...] = ()
    fronts: Callable[[Cloud], Fronts] | None = None

    def assemble(
        self,
        path: Path,
        columns: Columns,
        facts: Collection[str],
        spans: Mapping[str, Span] | None = None,
    ) -> Cloud:
        """Return the cloud of a chunk of columns, or with no ``spans`` of all of them."""
        notes = self.notes
        if self.naming is not None:
            names = self.naming.names(columns, facts)
            notes += (note_on_names(names),) if self.naming.is_guess else ()
            columns = {new: columns[old] for new, old in names.items()}
            if spans is not None:
                spans = {new: spans[old] for new, old in names.items() if old in spans}
        cloud = assemble_cloud(
            path, columns, coordinates=self.coordinates, spans=spans, header=self.header
        )
        return replace(cloud, notes=notes)


class _Survey(NamedTuple):
    """What all columns of a table show; see :class:`torchrg.io.fields.Naming` and ``Span``."""

    facts: frozenset[str]
    spans: Mapping[str, Span]


def _survey(table: Table, chunk_size: int) -> _Survey:
    """Look at all columns of a table, or only at the first chunk if that leaves nothing open."""
    facts, spans = set[str](), dict[str, Span]()
    for columns in table.read(chunk_size):
        for name, span in color_spans(columns).items():
            spans[name] = spans[name] | span if name in spans else span
        if table.naming is not None:
            facts |= table.naming.facts(columns)
        elif all(columns[name].dtype == np.uint8 for name in spans):
            break
    return _Survey(frozenset(facts), spans)


@dataclass(frozen=True, eq=False)
class CloudStream:
    """A cloud in chunks, one after the other, from the beginning each time it is iterated.

    Convention:
        The chunks put one after the other are the cloud as :func:`torchrg.read_cloud` gives it:
        the same coordinates and fields, bit for bit, in the same dtypes. A chunk has no
        ``grid_shape``, and its ``origin`` is its own: for points about that of the whole cloud,
        ``chunk.about(stream.origin)``.

    Args:
        chunks: Gives the chunks anew. None is empty.
        num_points: How many points there are; None for text, where only reading tells.
        grid_shape: That of the whole cloud.
        source: The file, for messages.
        header: That of the cloud, and of each chunk.
        measure: Gives the extent where it is known already; None to look at all chunks for it.

    Example:
        >>> cloud = Cloud(np.arange(30.0).reshape(10, 3))
        >>> [len(chunk) for chunk in CloudStream.of(cloud, chunk_size=4)]
        [4, 4, 2]
    """

    chunks: Callable[[], Iterator[Cloud]]
    num_points: int | None = None
    grid_shape: tuple[int, int] | None = None
    source: str = ""
    header: Mapping[str, Any] = field(default_factory=dict)
    measure: Callable[[], "Extent"] | None = None

    @classmethod
    def of(cls, cloud: Cloud, *, chunk_size: int = POINTS_A_CHUNK) -> "CloudStream":
        """Cut a cloud into chunks, which are views of it."""

        def cut() -> Iterator[Cloud]:
            for rows in slices(len(cloud), chunk_size):
                fields = {name: values[rows] for name, values in cloud.fields.items()}
                points = cloud.coordinates[rows]
                front = None if cloud.front is None else cloud.front[rows]
                yield replace(
                    cloud, coordinates=points, fields=fields, grid_shape=None, front=front
                )

        return cls(cut, len(cloud), cloud.grid_shape, cloud.source, cloud.header)

    def __iter__(self) -> Iterator[Cloud]:
        return self.chunks()

    def read(self) -> Cloud:
        """Return all chunks as one cloud in memory."""
        chunks = list(self)
        columns = join_columns([{**chunk.fields, "": chunk.coordinates} for chunk in chunks])
        fields = dict(columns)
        points = fields.pop("")
        notes, front = chunks[0].notes, None
        if any(chunk.front is not None for chunk in chunks):
            fronts = [
                np.zeros((len(c), 3), np.float32) if c.front is None else c.front for c in chunks
            ]
            front = np.concatenate(fronts)
        return Cloud(points, fields, self.grid_shape, self.source, self.header, notes, front)

    @cached_property
    def extent(self) -> "Extent":
        """Number of points and box of the finite ones; found by one pass over the chunks."""
        return self.measure() if self.measure else reduce(Extent.__or__, map(Extent.of, self))

    @property
    def count(self) -> int:
        """Number of points; where the file does not say, found by one pass over the chunks."""
        return self.extent.num_points if self.num_points is None else self.num_points

    @property
    def origin(self) -> NDArray[np.float64]:
        """Origin of the whole cloud, as :attr:`torchrg.Cloud.origin`, shape ``(3,)``."""
        return origin_of_box(self.extent.low, self.extent.high)

    def each(self, change: Callable[[Cloud, slice], Cloud]) -> "CloudStream":
        """Change each chunk, of which the rows in the whole cloud are told.

        Its points may only change if nobody asks for the extent or the count.
        """

        def changed() -> Iterator[Cloud]:
            start = 0
            for chunk in self:
                yield change(chunk, slice(start, start + len(chunk)))
                start += len(chunk)

        return replace(self, chunks=changed, measure=lambda: self.extent)

    def with_results(self, give: Callable[[slice], Columns]) -> "CloudStream":
        """Add a result, given for the rows of each chunk; own fields of its names are put aside.

        See :func:`torchrg.io.fields.put_results`.

        Example:
            >>> stream = CloudStream.of(Cloud(np.eye(3), {"labels": np.full(3, 7)}), chunk_size=2)
            >>> labels = np.array([0, 0, -1])
            >>> labelled = stream.with_results(lambda rows: {"labels": labels[rows]})
            >>> [chunk.fields["labels"].tolist() for chunk in labelled]
            [[0, 0], [-1]]
            >>> [chunk.fields["label_input"].tolist() for chunk in labelled]
            [[7, 7], [7]]
        """
        return self.each(
            lambda chunk, rows: replace(chunk, fields=put_results(chunk.fields, give(rows)))
        )


class Extent(NamedTuple):
    """How many points there are and where.

    Attributes:
        num_points: Number of points.
        num_finite: Number of those with three finite coordinates.
        low: Least finite coordinates, shape ``(3,)``, float64; infinite if there are none.
        high: Largest ones, likewise; minus infinite.
    """

    num_points: int
    num_finite: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, cloud: Cloud) -> "Extent":
        """Return the extent of a cloud."""
        kept = cloud.coordinates if cloud.finite.all() else cloud.coordinates[cloud.finite]
        low = kept.min(axis=0, initial=np.inf).astype(np.float64)
        high = kept.max(axis=0, initial=-np.inf).astype(np.float64)
        return cls(len(cloud), len(kept), low, high)

    def __or__(self, other: "Extent") -> "Extent":
        """Return the extent of the points of both."""
        return Extent(
            self.num_points + other.num_points,
            self.num_finite + other.num_finite,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )


def read_table(path: Path, table: Table) -> Cloud:
    """Read all points of a table as one cloud."""
    at_once = table.at_once or table.num_points or 1
    with np.errstate(**SILENT):
        columns = join_columns(list(table.read(at_once)))
        facts = table.naming.facts(columns) if table.naming is not None else ()
        cloud = table.assemble(path, columns, facts)
        front, notes = (None, ()) if table.fronts is None else table.fronts(cloud)
    notes = cloud.notes + notes
    return replace(cloud, grid_shape=table.grid_shape, front=front, notes=notes)


def stream_table(path: Path, table: Table, chunk_size: int) -> CloudStream:
    """Return the points of a table in chunks of at most so many."""

    @cache
    def survey() -> _Survey:
        return _survey(table, chunk_size)

    def assembled() -> Iterator[Cloud]:
        facts, spans = survey()
        for columns in table.read(chunk_size):
            yield table.assemble(path, columns, facts, spans)

    def chunks() -> Iterator[Cloud]:
        reading = assembled()
        while True:
            # Not around the loop, where it would hold for whoever takes the chunks, too.
            with np.errstate(**SILENT), reporting_unreadable(path):
                chunk = next(reading, None)
            if chunk is None:
                return
            yield chunk

    return CloudStream(chunks, table.num_points, table.grid_shape, str(path), table.header)


@contextmanager
def reporting_unreadable(path: Path) -> Iterator[None]:
    """Raise errors of the operating system, and of memory, as a FormatError that names the file."""
    try:
        yield
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}.") from error
    except MemoryError as error:
        raise FormatError(
            f"{path}: its points do not fit into memory; use a machine with more, or cut the cloud "
            "into parts."
        ) from error


def join_columns(chunks: Sequence[Columns]) -> Columns:
    """Put columns of the same names one after the other."""
    if len(chunks) == 1:
        return chunks[0]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def slices(num_points: int, chunk_size: int) -> Iterator[slice]:
    """Cut so many points into chunks; none are one chunk that is empty."""
    for start in range(0, max(num_points, 1), chunk_size):
        yield slice(start, min(start + chunk_size, num_points))
