"""The Stanford rooms, S3DIS, as they are released, and a cache of them as arrays."""

import hashlib
import json
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch

from torchrg.datasets.folder import SceneDataset, SceneFiles, Transform, check_folder, listed
from torchrg.datasets.rooms import ANNOTATIONS, Room, class_names, object_files, read_room
from torchrg.errors import ConfigError, FormatError
from torchrg.io import atomic_path
from torchrg.io.files import DAMAGES, first_line, make_folder
from torchrg.transforms.rows import SampleDict

ROOMS_PER_AREA = {1: 44, 2: 40, 3: 23, 4: 49, 5: 68, 6: 48}
"""Number of rooms of each area in the release, 272 in all."""
USER_CACHE = "~/.cache/torchrg"
_VERSION = 2
"""To be raised when the same files are read as other arrays."""
_STORED_ORDER = "pointcept"


class S3DIS(SceneDataset):
    """The rooms of S3DIS, read from ``ROOT/Area_i/<room>/Annotations/*.txt``, aligned or not.

    A sample has ``coord`` ``(N, 3)`` float32 in metres, ``color`` ``(N, 3)`` uint8, ``segment``
    ``(N,)`` int64 (a place in ``classes``), ``instance`` ``(N,)`` int64 (the object, counted
    from zero in natural order of the file names), and ``name``, as in ``Area_1/office_1``. Points
    are in the order of the objects, not in that of the room's own text file.

    Nothing is ever written below ``root``, unless ``cache`` says so.

    Args:
        root: The folder that holds ``Area_1`` to ``Area_6``.
        areas: Numbers of the areas to use.
        class_order: What the numbers in ``segment`` mean: a key of
            :data:`torchrg.datasets.CLASS_ORDERS`.
        cache: Folder that keeps rooms as arrays, 19 bytes a point, so that the text is read once.
            None: it is read every time.
        transform: Called with each sample.

    Attributes:
        scenes: Name, folder and input files of each room, in natural order.
        classes: Names of the classes by number.

    Raises:
        FormatError: If an area is missing.
        ConfigError: If an area or the class order is unknown.

    Warns:
        UserWarning: If an area has not as many rooms as the release.

    References:
        [1] I. Armeni et al. 3D semantic parsing of large-scale indoor spaces. CVPR, 2016.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        areas: Sequence[int] = tuple(ROOMS_PER_AREA),
        *,
        class_order: str = "pointcept",
        cache: str | os.PathLike[str] | None = USER_CACHE,
        transform: Transform | None = None,
    ) -> None:
        self.root = Path(root)
        self.class_order = class_order
        self.classes = class_names(class_order)
        self.cache = None if cache is None else Path(cache).expanduser()
        self.transform = transform
        self.scenes = [scene for area in areas for scene in _scenes_of_area(self.root, area)]

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a room."""
        room = self.read_room(index)
        return {
            "coord": torch.from_numpy(room.coord),
            "color": torch.from_numpy(room.color),
            "segment": torch.from_numpy(room.segment).long(),
            "instance": torch.from_numpy(room.instance).long(),
            "name": self.scenes[index].name,
        }

    def read_room(self, index: int) -> Room:
        """Return the room of a scene, with the notes and repairs that a sample has not."""
        scene = self.scenes[index]
        if self.cache is None:
            return read_room(scene.path, class_order=self.class_order)
        return _read_cached(scene, self.cache, self.class_order)


def _scenes_of_area(root: Path, area: int) -> list[SceneFiles]:
    """Return the rooms of an area, and warn if there are not as many as in the release."""
    if area not in ROOMS_PER_AREA:
        known = ", ".join(map(str, ROOMS_PER_AREA))
        raise ConfigError(f"S3DIS: expected areas among {known}, got {area!r}.")
    folder = root / f"Area_{area}"
    check_folder(root)
    if not folder.is_dir():
        inside = [path.parent for path in root.glob("*/Area_[1-6]")]
        repair = f"pass {inside[0]}" if inside else "choose areas that are there, or fetch it again"
        raise FormatError(f"{root}: expected a folder {folder.name}, got none; {repair}.")
    entries = [path for path in listed(folder) if path.is_dir() and not path.name.startswith(".")]
    rooms = [path for path in entries if (path / ANNOTATIONS).is_dir()]
    if len(rooms) != ROOMS_PER_AREA[area]:
        bare = [path.name for path in entries if path not in rooms]
        without = f" ({', '.join(bare)}: no {ANNOTATIONS})" if bare else ""
        warnings.warn(
            f"{folder}: expected {ROOMS_PER_AREA[area]} rooms, got {len(rooms)}{without}.",
            stacklevel=3,
        )
    return [SceneFiles(f"{folder.name}/{room.name}", room, object_files(room)) for room in rooms]


def _read_cached(scene: SceneFiles, cache: Path, class_order: str) -> Room:
    """Read a room from the cache, and put it there first if it is not.

    An entry is one ``.npz``. It counts as long as path, size and time of change of every input file
    are what they were and torchrg reads them the same way; a damaged entry is made again. Processes
    may share a cache. The cache is a folder that is made; old entries are not removed.
    """
    entry = cache / "s3dis" / f"{scene.name.replace('/', '-')}-{_fingerprint(scene)}.npz"
    room = _load(entry)
    if room is None:
        room = read_room(scene.path, class_order=_STORED_ORDER)
        try:
            make_folder(entry.parent)
            with atomic_path(entry) as beside:
                np.savez(beside, *map(np.asarray, room))
        except FormatError as error:
            repair = "choose another folder with cache=..., or none with cache=None"
            raise FormatError(f"{first_line(error)}; {repair}.") from error
    if class_order != _STORED_ORDER:
        stored, wanted = class_names(_STORED_ORDER), class_names(class_order)
        table = np.array([wanted.index(name) for name in stored], room.segment.dtype)
        room = room._replace(segment=table[room.segment])
    return room


def _fingerprint(scene: SceneFiles) -> str:
    """Return a name for the state of a room's files."""
    state = [
        (os.path.realpath(file), (status := file.stat()).st_size, status.st_mtime_ns)
        for file in scene.files
    ]
    return hashlib.sha256(json.dumps([_VERSION, state]).encode()).hexdigest()[:16]


def _load(entry: Path) -> Room | None:
    """Return what an entry holds, None if it is not there or damaged."""
    try:
        with entry.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            coord, color, segment, instance, *texts = (arrays[name] for name in arrays.files)
            repairs, notes = (tuple(lines.tolist()) for lines in texts)
    except (OSError, BadZipFile, *DAMAGES):
        return None
    return Room(coord, color, segment, instance, repairs, notes)
