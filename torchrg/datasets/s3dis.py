"""The Stanford rooms, S3DIS, as they are released: text files of annotated objects."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrg.datasets.folder import Scene, SceneDataset, listed
from torchrg.datasets.room_cache import USER_CACHE, read_cached_room
from torchrg.datasets.rooms import ANNOTATIONS, Room, class_names, object_files, read_room
from torchrg.errors import ConfigError, FormatError

ROOMS_PER_AREA = {1: 44, 2: 40, 3: 23, 4: 49, 5: 68, 6: 48}
"""Number of rooms of each area in the release, 272 in all."""


class S3DIS(SceneDataset):
    """The rooms of S3DIS, read from ``ROOT/Area_i/<room>/Annotations/*.txt``, aligned or not.

    A sample has ``coord`` ``(N, 3)`` float32 in metres, ``color`` ``(N, 3)`` uint8, ``segment``
    ``(N,)`` int64 (a place in :attr:`classes`), ``instance`` ``(N,)`` int64 (the object, counted
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
        transform: Callable[[Mapping[str, Any]], Any] | None = None,
    ) -> None:
        self.root = Path(root)
        self.class_order = class_order
        self.classes = class_names(class_order)
        self.cache = None if cache is None else Path(cache).expanduser()
        self.transform = transform
        self.scenes = [scene for area in areas for scene in _scenes_of_area(self.root, area)]

    def read_sample(self, index: int) -> dict[str, Any]:
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
        """Return the arrays of the room of a scene and the report of what was unusual about it."""
        scene = self.scenes[index]
        if self.cache is None:
            return read_room(scene.path, class_order=self.class_order)
        return read_cached_room(scene, self.cache, class_order=self.class_order)


def _scenes_of_area(root: Path, area: int) -> list[Scene]:
    """Return the rooms of an area, and warn if there are not as many as in the release."""
    if area not in ROOMS_PER_AREA:
        known = ", ".join(map(str, ROOMS_PER_AREA))
        raise ConfigError(f"S3DIS: expected areas among {known}, got {area!r}.")
    folder = root / f"Area_{area}"
    if not folder.is_dir():
        inside = [path.parent for path in root.glob("*/Area_[1-6]")] if root.is_dir() else []
        repair = f"pass {inside[0]}" if inside else "choose areas=..., or fetch it again"
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
    return [Scene(f"{folder.name}/{room.name}", room, object_files(room)) for room in rooms]
