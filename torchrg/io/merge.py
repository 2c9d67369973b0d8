"""Concatenation of clouds."""

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrg import scratch
from torchrg.errors import FormatError
from torchrg.io.e57 import SYSTEM
from torchrg.io.headers import MAX_INTEGER
from torchrg.io.pcd import DEFAULT_VIEWPOINT
from torchrg.structures import Cloud

_SUSPICIOUS_RATIO = 100
"""Ratio of the extents of two clouds from which a warning is issued: tiles of one survey differ
less, clouds in centimeters and meters by this factor."""
_PROJECTION = "LASF_Projection"
"""User ID of the LAS records that store the coordinate reference system."""


def merge_clouds(clouds: Sequence[Cloud]) -> Cloud:
    """Concatenate clouds, keeping the fields they share.

    Convention:
        A field is kept if all clouds have it with the same shape and kind of numbers, and colors
        with the same bit depth. Coordinates are float64 if any are. Header entries are kept if
        equal in all files. For LAS files the header with the finest scale is kept if the dimensions
        agree and its grid covers all points; for E57 files all scans are kept. Notes list the rest.

    Args:
        clouds: At least one cloud; all must use the same frame and unit.

    Raises:
        FormatError: If there are no clouds, two clouds have different coordinate reference systems,
            or LAS files have different kinds of GPS times.
    """
    if not clouds:
        raise FormatError("merge: expected at least one cloud, got none; pass a file.")
    if len(clouds) == 1:
        return clouds[0]
    notes = [f"{cloud.source}: {note}" for cloud in clouds for note in cloud.notes]
    notes += _check_systems(clouds)
    header = _common_header(clouds)
    names = dict.fromkeys(name for cloud in clouds for name in cloud.fields)
    shared = [name for name in names if len({_kind(name, cloud) for cloud in clouds}) == 1]
    lost = [name for name in names if name not in shared]
    dropped = dict.fromkeys(
        kind
        for cloud in clouds
        for kind, entry in cloud.header.items()
        if kind not in header and entry != DEFAULT_VIEWPOINT
    )
    for what, left in (("fields", lost), ("header entries", dropped)):
        if left:
            notes.append(f"{what} left out, because not all files share them: {', '.join(left)}")
    times = Counter(cloud.source for cloud in clouds if cloud.source)
    notes += [f"{name} is used {count} times" for name, count in times.items() if count > 1]
    notes += _note_sizes(clouds)

    fronts = [np.zeros((len(c), 3), np.float32) if c.front is None else c.front for c in clouds]
    has_front = any(cloud.front is not None for cloud in clouds)
    return Cloud(
        scratch.join([cloud.coordinates for cloud in clouds]),
        {name: scratch.join([cloud.fields[name] for cloud in clouds]) for name in shared},
        source=f"{clouds[0].source} and {len(clouds) - 1} more",
        header=header,
        notes=tuple(notes),
        front=scratch.join(fronts) if has_front else None,
    )


def _kind(name: str, cloud: Cloud) -> object:
    """Return the properties of a field that clouds must share; scan numbers are never shared."""
    values = cloud.fields.get(name)
    if values is None or (name == "scan" and "scans" in cloud.header):
        return id(cloud)
    return values.shape[1:], values.dtype if name == "color" else values.dtype.kind


def _note_sizes(clouds: Sequence[Cloud]) -> list[str]:
    """Return a note if the extents of clouds suggest different units."""
    finite = [(cloud.source, cloud.coordinates[cloud.finite]) for cloud in clouds]
    sizes = [(float(np.ptp(values, axis=0).max()), name) for name, values in finite if len(values)]
    positive = [size for size in sizes if size[0] > 0]
    if not positive:
        return []
    (small, smallest), (large, largest) = min(positive), max(positive)
    if large < _SUSPICIOUS_RATIO * small:
        return []
    return [
        f"{largest} is {large / small:,.0f} times as large as {smallest}; check that both use the "
        "same unit"
    ]


def _common_header(clouds: Sequence[Cloud]) -> Mapping[str, Any]:
    """Return the header entries equal in all clouds, and all scans."""
    headers = [cloud.header for cloud in clouds]
    common = dict[str, Any]()
    for kind, entry in headers[0].items():
        if not all(kind in header for header in headers):
            continue
        if kind == "scans":
            common[kind] = tuple(scan for header in headers for scan in header[kind])
        elif kind == "las":
            common |= _common_las(clouds)
        elif all(header[kind] == entry for header in headers):
            common[kind] = entry
    return common


def _common_las(clouds: Sequence[Cloud]) -> Mapping[str, Any]:
    """Return the header of the first LAS file with a grid for all points, if dimensions agree."""
    headers = [cloud.header["las"] for cloud in clouds]
    # Compared as text, because scales of dimensions with several elements compare elementwise.
    if len({repr((h.point_format.id, [*h.point_format.dimensions])) for h in headers}) > 1:
        return {}
    header = copy.deepcopy(headers[0])
    header.scales = np.min([each.scales for each in headers], axis=0)
    farthest = max(np.abs(cloud.coordinates - header.offsets).max() for cloud in clouds)
    return {"las": header} if farthest <= MAX_INTEGER * header.scales.min() else {}


def _check_systems(clouds: Sequence[Cloud]) -> list[str]:
    """Raise for different coordinate reference systems; return a note if some clouds have none."""
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
        return [f"only {len(named)} of {len(clouds)} files have a coordinate reference system"]
    return []


def _check_equal(facts: Sequence[tuple[str, object]], what: str, fix: str) -> None:
    """Raise FormatError if the values of two files differ."""
    for name, fact in facts[1:]:
        if fact != facts[0][1]:
            raise FormatError(f"{name}: expected the {what} of {facts[0][0]}, got another; {fix}.")


def _system(cloud: Cloud) -> object:
    """Return the coordinate reference system of a cloud; empty if unknown."""
    if "las" not in cloud.header:
        return cloud.header.get(SYSTEM, "")
    records = [*cloud.header["las"].vlrs, *(cloud.header["las"].evlrs or ())]
    return frozenset(
        (record.record_id, record.record_data_bytes())
        for record in records
        if record.user_id == _PROJECTION
    )
