"""Several clouds as one: the points of one after those of the other."""

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrg.errors import FormatError
from torchrg.io.e57 import SYSTEM
from torchrg.io.headers import LARGEST_INTEGER
from torchrg.io.pcd import DEFAULT_VIEWPOINT
from torchrg.structures import Cloud

_SUSPICIOUS_RATIO = 100
"""Ratio of the sizes of two clouds from which on the user is warned. Tiles of one survey differ
less, and a cloud in centimetres differs from one in metres by this much."""
_PROJECTION = "LASF_Projection"
"""Owner of the records that say in which coordinates a LAS file is."""


def merge_clouds(clouds: Sequence[Cloud]) -> Cloud:
    """Put the points of several clouds one after the other, with the fields that they share.

    Convention:
        A field is kept if every cloud has it with as many columns of one kind of numbers, and
        colours of as many bits. Coordinates are float64 if any are. Of the headers that is kept in
        which all agree; of LAS files it is one with the finest scale, if they have the same
        dimensions and its grid reaches all points; of E57 files all scans. The notes say in one
        line what is left out.

    Args:
        clouds: The clouds, at least one; their coordinates are taken to be of one frame and unit.

    Raises:
        FormatError: If there are no clouds, or if two name different coordinate reference systems,
            or LAS files count GPS times differently.

    Example:
        >>> clouds = [Cloud(np.eye(3), {"labels": np.arange(3)}), Cloud(np.zeros((1, 3)))]
        >>> merged = merge_clouds(clouds)
        >>> len(merged), merged.notes
        (4, ('fields left out, as not all files have them alike: labels',))
    """
    if not clouds:
        raise FormatError("merge: expected at least one cloud, got none; name a file.")
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
    for what, left in (("fields", lost), ("facts of the header", dropped)):
        if left:
            notes.append(f"{what} left out, as not all files have them alike: {', '.join(left)}")
    times = Counter(cloud.source for cloud in clouds if cloud.source)
    notes += [f"{name} is taken {count} times" for name, count in times.items() if count > 1]
    notes += _note_sizes(clouds)
    fronts = [np.zeros((len(c), 3), np.float32) if c.front is None else c.front for c in clouds]
    has_front = any(cloud.front is not None for cloud in clouds)
    return Cloud(
        np.concatenate([cloud.coordinates for cloud in clouds]),
        {name: np.concatenate([cloud.fields[name] for cloud in clouds]) for name in shared},
        source=f"{clouds[0].source} and {len(clouds) - 1} more",
        header=header,
        notes=tuple(notes),
        front=np.concatenate(fronts) if has_front else None,
    )


def _kind(name: str, cloud: Cloud) -> object:
    """Return what two clouds have to share of a field, which no two do of numbers of scans."""
    values = cloud.fields.get(name)
    if values is None or (name == "scan" and "scans" in cloud.header):
        return id(cloud)
    return values.shape[1:], values.dtype if name == "color" else values.dtype.kind


def _note_sizes(clouds: Sequence[Cloud]) -> list[str]:
    """Say which clouds differ so much in size that their units may, too."""
    finite = [(cloud.source, cloud.coordinates[cloud.finite]) for cloud in clouds]
    sizes = [(float(np.ptp(values, axis=0).max()), name) for name, values in finite if len(values)]
    positive = [size for size in sizes if size[0] > 0]
    if not positive:
        return []
    (small, smallest), (large, largest) = min(positive), max(positive)
    if large < _SUSPICIOUS_RATIO * small:
        return []
    return [
        f"{largest} is {large / small:,.0f} times as large as {smallest}; expected coordinates of "
        "one unit"
    ]


def _common_header(clouds: Sequence[Cloud]) -> Mapping[str, Any]:
    """Return the entries of the headers in which all clouds agree, and all scans."""
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
    """Return the header of the first LAS file with a grid for all, if their dimensions agree."""
    headers = [cloud.header["las"] for cloud in clouds]
    # As text, because the scales of a dimension of several elements do not compare to one truth.
    if len({repr((h.point_format.id, [*h.point_format.dimensions])) for h in headers}) > 1:
        return {}
    header = copy.deepcopy(headers[0])
    header.scales = np.min([each.scales for each in headers], axis=0)
    farthest = max(np.abs(cloud.coordinates - header.offsets).max() for cloud in clouds)
    return {"las": header} if farthest <= LARGEST_INTEGER * header.scales.min() else {}


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
