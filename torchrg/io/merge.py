"""Several files as one cloud: the points of one after those of the other."""

import copy
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import WIDEN
from torchrg.io.stream import CloudStream, Extent
from torchrg.structures import Cloud

_SUSPICIOUS_RATIO = 100
"""Of two boxes; tiles of one survey differ less, centimetres and metres by this much."""
_LARGEST_INTEGER = 2**31 - 1
"""Of the coordinates of a LAS file, in steps of its scale."""
_PROJECTION = "LASF_Projection"
"""Whose records say in which coordinates a LAS file is."""


class Merged(NamedTuple):
    """Several clouds as one.

    Attributes:
        stream: The cloud.
        notes: What the clouds do not share, a line each, for people.
    """

    stream: CloudStream
    notes: list[str]


class _Kept(NamedTuple):
    """The types of the merged cloud: of coordinates, and of fields with the shape of a row."""

    coordinates: np.dtype[Any]
    fields: dict[str, tuple[np.dtype[Any], tuple[int, ...]]]

    def cast(self, chunk: Cloud) -> Cloud:
        """Return a chunk in these types, without its other fields; what it lacks is zero."""
        fields = {
            name: _cast(name, chunk.fields[name], dtype)
            if name in chunk.fields
            else np.zeros((len(chunk), *row_shape), dtype)
            for name, (dtype, row_shape) in self.fields.items()
        }
        points = chunk.coordinates.astype(self.coordinates, copy=False)
        return replace(chunk, coordinates=points, fields=fields)


def merge_streams(streams: Sequence[CloudStream]) -> Merged:
    """Put the points of several clouds one after the other, with the fields that they share.

    Convention:
        A field is kept if every cloud has it with as many columns, numbers all or text all, or is a
        LAS file in which it is zero and therefore left out; it has the type that holds all of them,
        and colours of 8 bits become such of 16 where another cloud has these. Coordinates are
        float64 if any are. Of LAS files the header of the first is kept with the finest scale, if
        their point formats are the same and its grid reaches all points; of E57 files all scans
        are, numbered on in ``scan``.

    Args:
        streams: The clouds, at least one; their coordinates are taken to be of one frame and unit.

    Returns:
        The cloud and what was left out. Nothing but the first chunk and the extent of each cloud
        has been read.

    Raises:
        FormatError: If there are no clouds, if a file is damaged, or if LAS files name different
            coordinate reference systems.

    Example:
        >>> clouds = [Cloud(np.eye(3), {"labels": np.arange(3)}), Cloud(np.zeros((1, 3)))]
        >>> merged = merge_streams([CloudStream.of(cloud) for cloud in clouds])
        >>> merged.stream.count, merged.notes
        (4, ['field labels is left out: not all files have it'])
    """
    if not streams:
        raise FormatError("merge: expected at least one cloud, got none; name a file.")
    if len(streams) == 1:
        return Merged(streams[0], [])
    kept, notes = _kept([_without_points(next(iter(stream))) for stream in streams])
    times = Counter(stream.source for stream in streams if stream.source)
    notes += [f"{name} is taken {count} times" for name, count in times.items() if count > 1]
    notes += _note_sizes(streams)
    header, header_notes = _joined_header(streams)
    first_scans = _first_scans(streams) if "scans" in header else None
    if first_scans is not None:
        kept.fields.pop("scan", None)
        notes = [note for note in notes if not note.startswith("field scan ")]

    def chunks() -> Iterator[Cloud]:
        for number, stream in enumerate(streams):
            for chunk in stream:
                cast = replace(kept.cast(chunk), header=header)
                if first_scans is not None:
                    scan = chunk.fields.get("scan", np.zeros(len(chunk), np.int32))
                    fields = {**cast.fields, "scan": scan.astype(np.int32) + first_scans[number]}
                    cast = replace(cast, fields=fields)
                yield cast

    def measure() -> Extent:
        extent = streams[0].extent
        for stream in streams[1:]:
            extent |= stream.extent
        return extent

    counts = [stream.num_points for stream in streams]
    known = [count for count in counts if count is not None]
    total = sum(known) if len(known) == len(counts) else None
    source = f"{streams[0].source} and {len(streams) - 1} more"
    merged = CloudStream(chunks, total, None, source, header, measure)
    return Merged(merged, notes + header_notes)


def _without_points(cloud: Cloud) -> Cloud:
    """Return a cloud with all but its points: chunks of many files would fill the memory."""
    fields = {name: values[:0].copy() for name, values in cloud.fields.items()}
    return Cloud(cloud.coordinates[:0].copy(), fields, header=cloud.header)


def _kept(clouds: Sequence[Cloud]) -> tuple[_Kept, list[str]]:
    """Return the types of the merged cloud, and why fields are left out."""
    fields: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
    notes = []
    for name in dict.fromkeys(name for cloud in clouds for name in cloud.fields):
        own = [cloud.fields[name] for cloud in clouds if name in cloud.fields]
        kinds = {"number" if values.dtype.kind in "biuf" else values.dtype.kind for values in own}
        if not all(name in cloud.fields or _is_zero(cloud, name) for cloud in clouds):
            notes.append(f"field {name} is left out: not all files have it")
        elif len({values.shape[1:] for values in own}) > 1 or len(kinds) > 1:
            notes.append(f"field {name} is left out: it differs in shape or kind between files")
        else:
            dtype = np.result_type(*(values.dtype for values in own))
            fields[name] = (dtype, own[0].shape[1:])
    coordinates = np.result_type(*(cloud.coordinates.dtype for cloud in clouds))
    return _Kept(coordinates, fields), notes


def _is_zero(cloud: Cloud, name: str) -> bool:
    """Whether a field that is not there is a dimension of the LAS file that is zero everywhere."""
    header = cloud.header.get("las")
    known = () if header is None else set(header.point_format.standard_dimension_names)
    return ("red" if name == "color" else name) in known


def _cast(name: str, values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a field in another type; a colour keeps its meaning."""
    if name == "color" and values.dtype == np.uint8 and dtype == np.uint16:
        return values.astype(dtype) * WIDEN
    return values.astype(dtype, copy=False)


def _note_sizes(streams: Sequence[CloudStream]) -> list[str]:
    """Say which clouds differ so much in size that their units may, too."""
    sizes = [float((stream.extent.high - stream.extent.low).max()) for stream in streams]
    known = [(size, stream.source) for size, stream in zip(sizes, streams, strict=True) if size > 0]
    if not known:
        return []
    (small, smallest), (large, largest) = min(known), max(known)
    if large < _SUSPICIOUS_RATIO * small:
        return []
    return [
        f"{largest} is {large / small:,.0f} times as large as {smallest}; expected coordinates of "
        "one unit"
    ]


def _first_scans(streams: Sequence[CloudStream]) -> NDArray[np.int32]:
    """Return the number that the first scan of each file gets."""
    counts = [len(stream.header["scans"]) for stream in streams]
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int32)


def _joined_header(streams: Sequence[CloudStream]) -> tuple[Mapping[str, Any], list[str]]:
    """Return the header of the merged cloud, and what of the headers is not kept."""
    headers = [stream.header for stream in streams]
    if all("scans" in header for header in headers):
        return {"scans": tuple(scan for header in headers for scan in header["scans"])}, []
    if all("las" in header for header in headers):
        return _joined_las(streams)
    viewpoints = {tuple(header.get("viewpoint", ())) for header in headers}
    if len(viewpoints) == 1 and viewpoints != {()}:
        return {"viewpoint": headers[0]["viewpoint"]}, []
    return {}, []


def _joined_las(streams: Sequence[CloudStream]) -> tuple[Mapping[str, Any], list[str]]:
    """Return a header whose grid holds the points of all files, or none."""
    headers = [stream.header["las"] for stream in streams]
    systems = [_system(header) for header in headers]
    named = [(system, s.source) for system, s in zip(systems, streams, strict=True) if system]
    for system, source in named[1:]:
        if system != named[0][0]:
            raise FormatError(
                f"{source}: expected the coordinate reference system of {named[0][1]}, got "
                "another; reproject one of them."
            )
    notes = []
    if 0 < len(named) < len(streams):
        notes.append(f"only {len(named)} of {len(streams)} files name a coordinate system")
    joined = copy.deepcopy(headers[0])
    joined.scales = np.min([header.scales for header in headers], axis=0)
    extents = [stream.extent for stream in streams]
    reach = np.max([np.abs([e.low - joined.offsets, e.high - joined.offsets]) for e in extents])
    formats = {header.point_format.id for header in headers}
    if len(formats) > 1 or reach > _LARGEST_INTEGER * joined.scales.min():
        why = "point formats differ" if len(formats) > 1 else "its grid does not reach all points"
        return {}, [*notes, f"the header of {streams[0].source} is not kept: {why}"]
    return {"las": joined}, notes


def _system(header: Any) -> frozenset[tuple[int, bytes]]:  # noqa: ANN401
    """Return the records that say in which coordinate reference system a LAS file is."""
    records = [*header.vlrs, *(header.evlrs or ())]
    return frozenset(
        (record.record_id, record.record_data_bytes())
        for record in records
        if record.user_id == _PROJECTION
    )
