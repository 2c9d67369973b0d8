"""Rooms kept as arrays that are mapped into memory, so that the text is read once."""

import hashlib
import json
import os
import secrets
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from torchrg.datasets.folder import Scene
from torchrg.datasets.rooms import Repair, Room, RoomReport, Skipped, class_names, read_room
from torchrg.errors import FormatError
from torchrg.io.npy import map_array

USER_CACHE = "~/.cache/torchrg"
_VERSION = 1
"""To be raised when the same files are read as other arrays."""
_ARRAYS = ("coord", "color", "segment", "instance")
_STORED_ORDER = "pointcept"


def read_cached_room(scene: Scene, cache: Path, *, class_order: str = "pointcept") -> Room:
    """Read a room from the cache, and put it there first if it is not.

    An entry counts as long as path, size and time of change of every input file are what they were
    and torchrg reads them the same way; a damaged entry is made again. Processes may share a cache.
    The cache is a folder that is made; old entries are not removed. Its arrays are mapped
    copy-on-write: changing them changes no file.
    """
    entry = cache / "s3dis" / f"{scene.name.replace('/', '-')}-{_fingerprint(scene)}"
    room = _load(entry)
    if room is None:
        room = _store(entry, read_room(scene.path, class_order=_STORED_ORDER))
    if class_order != _STORED_ORDER:
        stored, wanted = class_names(_STORED_ORDER), class_names(class_order)
        table = np.array([wanted.index(name) for name in stored], room.segment.dtype)
        room = room._replace(segment=table[room.segment])
    return room


def _fingerprint(scene: Scene) -> str:
    """Return a name for the state of a room's files."""
    state = [
        (os.path.realpath(file), (status := file.stat()).st_size, status.st_mtime_ns)
        for file in scene.files
    ]
    return hashlib.sha256(json.dumps([_VERSION, state]).encode()).hexdigest()[:16]


def _load(entry: Path) -> Room | None:
    """Return what an entry holds, None if it is not there or damaged."""
    try:
        report = json.loads((entry / "report.json").read_text(encoding="utf-8"))
        coord, color, segment, instance = (map_array(entry / f"{name}.npy") for name in _ARRAYS)
        return Room(coord, color, segment, instance, _report_of(report))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _store(entry: Path, room: Room) -> Room:
    """Put a room into the cache in one step, and return it as it is there."""
    beside = entry.with_name(f".{entry.name}.{secrets.token_hex(4)}")
    try:
        beside.mkdir(parents=True)
        for name in _ARRAYS:
            np.save(beside / f"{name}.npy", getattr(room, name), allow_pickle=False)
        (beside / "report.json").write_text(json.dumps(_plain(room.report)), encoding="utf-8")
        if entry.exists() and _load(entry) is None:
            shutil.rmtree(entry, ignore_errors=True)
        try:
            beside.rename(entry)
        except OSError:
            # Another process has put the same room there in the meantime.
            if not entry.is_dir():
                raise
    except OSError as error:
        raise FormatError(
            f"{entry}: cannot be written: {error.strerror or error}; choose another folder with "
            "cache=..., or none with cache=None."
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return _load(entry) or room


def _plain(report: RoomReport) -> dict[str, Any]:
    """Return a report as JSON can hold it; latin-1 keeps every byte."""
    return {
        "repairs": [
            [str(file), line, column, before.decode("latin-1"), after.decode("latin-1")]
            for file, line, column, before, after in report.repairs
        ],
        "skipped": [[str(file), reason] for file, reason in report.skipped],
        "as_clutter": [[str(file)] for file in report.as_clutter],
    }


def _report_of(plain: dict[str, Any]) -> RoomReport:
    """Return the report that JSON holds."""
    return RoomReport(
        tuple(
            Repair(Path(file), line, column, before.encode("latin-1"), after.encode("latin-1"))
            for file, line, column, before, after in plain["repairs"]
        ),
        tuple(Skipped(Path(file), reason) for file, reason in plain["skipped"]),
        tuple(Path(file) for (file,) in plain["as_clutter"]),
    )
