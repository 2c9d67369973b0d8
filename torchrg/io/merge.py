"""Several clouds as one: the points of one after those of the other."""

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.e57 import SYSTEM
from torchrg.io.fields import WIDEN, Values
from torchrg.io.las import LARGEST_INTEGER
from torchrg.io.pcd import DEFAULT_VIEWPOINT
from torchrg.structures import Cloud

_SUSPICIOUS_RATIO = 100
"""Ratio of the sizes of two clouds from which on the user is warned. Tiles of one survey differ
less, and a cloud in centimetres differs from one in metres by this much."""
_PROJECTION = "LASF_Projection"
"""Owner of the records that say in which coordinates a LAS file is."""
_ENTRIES = {
    "las": "LAS header",
    "scans": "poses of scans",
    SYSTEM: "coordinate system",
    "viewpoint": "viewpoint",
}
"""Entries of the header of a cloud, for people."""


def merge_clouds(clouds: Sequence[Cloud]) -> Cloud:
    """Put the points of several clouds one after the other, with the fields that they share.

    Convention:
        A field is kept if every cloud has it with as many columns, numbers all or text all, or is a
        LAS file in which it is zero and therefore left out; it has the type that holds all of them,
        and colours of 8 bits become such of 16 where another cloud has these. Coordinates are
        float64 if any are. Scans of E57 files are numbered on. Of the headers that is kept in which
        all agree, and of LAS files one with the finest scale, if they have the same dimensions and
        its grid reaches all points. The notes say what is left out.

    Args:
        clouds: The clouds, at least one; their coordinates are taken to be of one frame and unit.

    Raises:
        FormatError: If there are no clouds, or if two name different coordinate reference systems,
            or LAS files count GPS times differently.

    Example:
        >>> clouds = [Cloud(np.eye(3), {"labels": np.arange(3)}), Cloud(np.zeros((1, 3)))]
        >>> merged = merge_clouds(clouds)
        >>> len(merged), merged.notes
        (4, ('left out, as not all files have them alike: labels',))
    """
    if not clouds:
        raise FormatError("merge: expected at least one cloud, got none; name a file.")
    if len(clouds) == 1:
        return clouds[0]
    notes = [f"{cloud.source}: {note}" for cloud in clouds for note in cloud.notes]
    notes += _check_systems(clouds)
    fields, header = dict[str, Values](), _common_header(clouds)
    lost = list[str]()
    for name in dict.fromkeys(name for cloud in clouds for name in cloud.fields):
        values = _field(name, clouds)
        if values is None:
            lost.append(name)
        else:
            fields[name] = values
    lost += [
        words
        for kind, words in _ENTRIES.items()
        if kind not in header
        and any(cloud.header.get(kind, DEFAULT_VIEWPOINT) != DEFAULT_VIEWPOINT for cloud in clouds)
    ]
    if lost:
        notes.append(f"left out, as not all files have them alike: {', '.join(lost)}")
    times = Counter(cloud.source for cloud in clouds if cloud.source)
    notes += [f"{name} is taken {count} times" for name, count in times.items() if count > 1]
    notes += _note_sizes(clouds)
    return Cloud(
        np.concatenate([cloud.coordinates for cloud in clouds]),
        fields,
        source=f"{clouds[0].source} and {len(clouds) - 1} more",
        header=header,
        notes=tuple(notes),
        front=_fronts(clouds),
    )


def _field(name: str, clouds: Sequence[Cloud]) -> Values | None:
    """Return a field of all clouds, or None if they do not share it."""
    if name == "scan" and all("scans" in cloud.header for cloud in clouds):
        starts = np.cumsum([0, *(len(cloud.header["scans"]) for cloud in clouds)])
        scans = [cloud.fields.get("scan", np.zeros(len(cloud), np.int32)) for cloud in clouds]
        numbers = [scan + start for scan, start in zip(scans, starts, strict=False)]
        return np.concatenate(numbers).astype(np.int32)
    known = [cloud.fields[name] for cloud in clouds if name in cloud.fields]
    kinds = {"number" if values.dtype.kind in "biuf" else values.dtype.kind for values in known}
    if len({values.shape[1:] for values in known}) > 1 or len(kinds) > 1:
        return None
    if not all(name in cloud.fields or _is_zero(cloud, name) for cloud in clouds):
        return None
    shape, dtype = known[0].shape[1:], np.result_type(*(values.dtype for values in known))
    parts = [cloud.fields.get(name, np.zeros((len(cloud), *shape), dtype)) for cloud in clouds]
    if name == "color" and dtype == np.uint16:
        parts = [p.astype(dtype) * WIDEN if p.dtype == np.uint8 else p for p in parts]
    return np.concatenate(parts)


def _is_zero(cloud: Cloud, name: str) -> bool:
    """Whether a field that is not there is a dimension of the LAS file that is zero everywhere."""
    header = cloud.header.get("las")
    known = () if header is None else set(header.point_format.standard_dimension_names)
    return ("red" if name == "color" else name) in known


def _fronts(clouds: Sequence[Cloud]) -> NDArray[np.float32] | None:
    """Return the fronts of all points, zero where a cloud has none."""
    if all(cloud.front is None for cloud in clouds):
        return None
    nothing = [np.zeros((len(cloud), 3), np.float32) for cloud in clouds]
    return np.concatenate(
        [zero if c.front is None else c.front for c, zero in zip(clouds, nothing, strict=True)]
    )


def _note_sizes(clouds: Sequence[Cloud]) -> list[str]:
    """Say which clouds differ so much in size that their units may, too."""
    finite = [(cloud.source, cloud.coordinates[cloud.finite]) for cloud in clouds]
    sizes = [(float(np.ptp(kept, axis=0).max()), name) for name, kept in finite if len(kept)]
    known = [size for size in sizes if size[0] > 0]
    if not known:
        return []
    (small, smallest), (large, largest) = min(known), max(known)
    if large < _SUSPICIOUS_RATIO * small:
        return []
    return [
        f"{largest} is {large / small:,.0f} times as large as {smallest}; expected coordinates of "
        "one unit"
    ]


def _common_header(clouds: Sequence[Cloud]) -> Mapping[str, Any]:
    """Return the entries of the headers in which all clouds agree, and all scans."""
    headers, first = [cloud.header for cloud in clouds], clouds[0].header
    kinds = [kind for kind in first if all(kind in header for header in headers)]
    common = {
        kind: first[kind]
        for kind in kinds
        if kind not in ("las", "scans") and all(h[kind] == first[kind] for h in headers)
    }
    if "scans" in kinds:
        common["scans"] = tuple(scan for header in headers for scan in header["scans"])
    if "las" in kinds and (header := _common_las(clouds)) is not None:
        common["las"] = header
    return common


def _common_las(clouds: Sequence[Cloud]) -> Any | None:  # noqa: ANN401
    """Return the header of a LAS file with a grid for all, if their dimensions are the same.

    It is that of the first file that has GPS times, as it says from which moment they count.
    """
    formats = [cloud.header["las"].point_format for cloud in clouds]
    # As text, because the scales of a dimension of several elements do not compare to one truth.
    if len({repr((each.id, [*each.dimensions])) for each in formats}) > 1:
        return None
    first = next((cloud for cloud in clouds if "gps_time" in cloud.fields), clouds[0])
    header = copy.deepcopy(first.header["las"])
    header.scales = np.min([cloud.header["las"].scales for cloud in clouds], axis=0)
    farthest = max(np.abs(cloud.coordinates - header.offsets).max() for cloud in clouds)
    return header if farthest <= LARGEST_INTEGER * header.scales.min() else None


def _check_systems(clouds: Sequence[Cloud]) -> list[str]:
    """Refuse clouds in different coordinate reference systems, and say if not all name one."""
    named = [(cloud, system) for cloud in clouds if (system := _system(cloud))]
    for kind in ("las", SYSTEM):
        systems = [(cloud.source, system) for cloud, system in named if kind in cloud.header]
        _check_equal(systems, "coordinate reference system", "reproject one of them")
    times = [
        (cloud.source, cloud.header["las"].global_encoding.gps_time_type)
        for cloud in clouds
        if "las" in cloud.header and "gps_time" in cloud.fields
    ]
    _check_equal(times, "kind of GPS times", "convert one of them, or leave gps_time out")
    if 0 < len(named) < len(clouds):
        return [f"only {len(named)} of {len(clouds)} files name a coordinate system"]
    return []


def _check_equal(facts: Sequence[tuple[str, object]], what: str, repair: str) -> None:
    """Raise FormatError if the facts about two files differ."""
    for source, fact in facts[1:]:
        if fact != facts[0][1]:
            raise FormatError(
                f"{source}: expected the {what} of {facts[0][0]}, got another; {repair}."
            )


def _system(cloud: Cloud) -> object:
    """Return what says in which coordinate reference system a cloud is; empty if nothing does."""
    if "las" not in cloud.header:
        return cloud.header.get(SYSTEM, "")
    records = [*cloud.header["las"].vlrs, *(cloud.header["las"].evlrs or ())]
    return frozenset(
        (record.record_id, record.record_data_bytes())
        for record in records
        if record.user_id == _PROJECTION
    )
