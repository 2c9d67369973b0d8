"""Several files as one cloud: the points of one after those of the other."""

import copy
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.e57 import SYSTEM
from torchrg.io.fields import WIDEN
from torchrg.io.las import LARGEST_INTEGER
from torchrg.io.pcd import DEFAULT_VIEWPOINT
from torchrg.io.stream import CloudStream, Extent
from torchrg.structures import Cloud

_SUSPICIOUS_RATIO = 100
"""Ratio of the sizes of two clouds from which on the user is warned. Tiles of one survey differ
less, and a cloud in centimetres differs from one in metres by this much."""
_PROJECTION = "LASF_Projection"
"""Owner of the records that say in which coordinates a LAS file is."""
_OWN_RECORDS = (_PROJECTION, "laszip encoded")
"""Owners of records that are compared by themselves, or that say how the points lie in the file."""
_EXTRA_DIMENSIONS = ("LASF_Spec", 4)
"""Owner and number of the record of the extra dimensions, which are compared as fields."""
_ORIGIN_FACTS = ("system_identifier", "generating_software", "file_source_id", "uuid")
"""What a LAS header says of where one file comes from."""
_KINDS = {
    "las": "header",
    "scans": "list of scans, with poses,",
    SYSTEM: "coordinate system",
    "viewpoint": "viewpoint",
}
"""What is in the header of a cloud, for people."""


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
        are, numbered on in ``scan``. What else the headers say and the merged one does not is
        noted.

    Args:
        streams: The clouds, at least one; their coordinates are taken to be of one frame and unit.

    Returns:
        The cloud and what was left out, with the notes of the clouds. Nothing but the first chunk
        and the extent of each has been read.

    Raises:
        FormatError: If there are no clouds, if a file is damaged, or if LAS or E57 files name
            different coordinate reference systems, or LAS files count GPS times differently.

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
    clouds = [_without_points(next(iter(stream))) for stream in streams]
    kept, notes = _kept(clouds)
    notes += [f"{cloud.source}: {note}" for cloud in clouds for note in cloud.notes]
    times = Counter(stream.source for stream in streams if stream.source)
    notes += [f"{name} is taken {count} times" for name, count in times.items() if count > 1]
    notes += _note_sizes(streams)
    header, header_notes = _joined_header(streams, clouds)
    first_scans = _first_scans(streams) if "scans" in header else None
    if first_scans is not None:
        kept.fields.pop("scan", None)
        notes = [note for note in notes if not note.startswith("field scan ")]

    def chunks() -> Iterator[Cloud]:
        for number, stream in enumerate(streams):
            for chunk in stream:
                cast = replace(kept.cast(chunk), header=header, notes=())
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
    return replace(cloud, coordinates=cloud.coordinates[:0].copy(), fields=fields, front=None)


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


def _joined_header(
    streams: Sequence[CloudStream], clouds: Sequence[Cloud]
) -> tuple[Mapping[str, Any], list[str]]:
    """Return the header of the merged cloud, and what of the headers is not kept."""
    named = [(cloud, system) for cloud in clouds if (system := _system(cloud.header))]
    for kind in ("las", SYSTEM):
        own = [(cloud.source, system) for cloud, system in named if kind in cloud.header]
        _check_equal(own, "coordinate reference system", "reproject one of them")
    times = [
        (cloud.source, cloud.header["las"].global_encoding.gps_time_type)
        for cloud in clouds
        if "las" in cloud.header and "gps_time" in cloud.fields
    ]
    _check_equal(times, "kind of GPS times", "convert one of them, or leave gps_time out")
    notes = []
    if 0 < len(named) < len(clouds):
        notes.append(f"only {len(named)} of {len(clouds)} files name a coordinate system")
    joined: dict[str, Any] = {}
    why = dict.fromkeys(_KINDS, "not all files have one")
    if all("scans" in cloud.header for cloud in clouds):
        joined["scans"] = tuple(scan for cloud in clouds for scan in cloud.header["scans"])
        if named:
            joined[SYSTEM] = named[0][1]
    if all("las" in cloud.header for cloud in clouds):
        why["las"] = _reason_to_drop(streams, clouds)
        if not why["las"]:
            joined["las"], las_notes = _joined_las(clouds)
            notes += las_notes
    if times and "las" in joined:
        encoding = joined["las"].global_encoding
        # Before laspy 2.7, to set what it is already would change it.
        if encoding.gps_time_type != times[0][1]:
            encoding.gps_time_type = times[0][1]
    viewpoints = {tuple(cloud.header.get("viewpoint", DEFAULT_VIEWPOINT)) for cloud in clouds}
    if len(viewpoints) > 1:
        why["viewpoint"] = "it differs between files"
    elif viewpoints != {DEFAULT_VIEWPOINT}:
        joined["viewpoint"] = viewpoints.pop()
    for kind, what in _KINDS.items():
        having = [cloud.source for cloud in clouds if kind in cloud.header]
        if having and kind not in joined and (kind != "viewpoint" or len(viewpoints) > 1):
            notes.append(f"the {what} of {having[0]} is not kept: {why[kind]}")
    if times and "las" not in joined:
        notes.append("what GPS times count from is not kept with it")
    return joined, notes


def _check_equal(facts: Sequence[tuple[str, Any]], what: str, repair: str) -> None:
    """Raise FormatError if the facts about two files differ."""
    for source, fact in facts[1:]:
        if fact != facts[0][1]:
            raise FormatError(
                f"{source}: expected the {what} of {facts[0][0]}, got another; {repair}."
            )


def _reason_to_drop(streams: Sequence[CloudStream], clouds: Sequence[Cloud]) -> str:
    """Return why the header of the first of LAS files cannot be that of all; empty if it can."""
    headers = [cloud.header["las"] for cloud in clouds]
    if len({header.point_format.id for header in headers}) > 1:
        return "point formats differ"
    offsets, extents = headers[0].offsets, [stream.extent for stream in streams]
    reach = np.max([np.abs([e.low - offsets, e.high - offsets]) for e in extents])
    if reach > LARGEST_INTEGER * np.min([header.scales for header in headers]):
        return "its grid does not reach all points"
    return ""


def _joined_las(clouds: Sequence[Cloud]) -> tuple[Any, list[str]]:
    """Return the header of the first of LAS files with a grid for all, and what is not kept."""
    headers, source = [cloud.header["las"] for cloud in clouds], clouds[0].source
    joined = copy.deepcopy(headers[0])
    joined.scales = np.min([header.scales for header in headers], axis=0)
    notes = []
    facts = [name for name in _ORIGIN_FACTS if len({str(getattr(h, name)) for h in headers}) > 1]
    if facts:
        words = ", ".join(name.replace("_", " ") for name in facts)
        notes.append(f"{words} are those of {source} for all points")
    first, *others = [set(_records(header)) for header in headers]
    lost = sorted({record[:2] for records in others for record in records - first})
    if lost:
        names = ", ".join(f"{owner} {number}" for owner, number in lost)
        notes.append(f"records are those of {source}; left out of others: {names}")
    dimensions = [{dim.name: dim for dim in h.point_format.extra_dimensions} for h in headers]
    differing = [
        name
        for name, dim in dimensions[0].items()
        if any(_described(own[name]) != _described(dim) for own in dimensions[1:] if name in own)
    ]
    if differing:
        joined.remove_extra_dims(differing)
        notes.append(f"scale and description of {', '.join(differing)} are left out: files differ")
    return joined, notes


def _described(dimension: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """Return what a LAS file says of an extra dimension, as values that compare."""
    parts = (dimension.offsets, dimension.scales, dimension.no_data)
    return dimension.description, *(None if part is None else part.tolist() for part in parts)


def _records(header: Any) -> Iterator[tuple[str, int, bytes]]:  # noqa: ANN401
    """Yield the records of a LAS file that stand for themselves: owner, number, content."""
    for record in (*header.vlrs, *(header.evlrs or ())):
        known = (record.user_id, record.record_id)
        if record.user_id not in _OWN_RECORDS and known != _EXTRA_DIMENSIONS:
            yield *known, record.record_data_bytes()


def _system(header: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return what says in which coordinate reference system a file is; empty if nothing does."""
    if "las" not in header:
        return header.get(SYSTEM, "")
    records = [*header["las"].vlrs, *(header["las"].evlrs or ())]
    return frozenset(
        (record.record_id, record.record_data_bytes())
        for record in records
        if record.user_id == _PROJECTION
    )
