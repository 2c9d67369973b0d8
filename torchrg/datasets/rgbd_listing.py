"""Recordings and their images below a folder."""

import os
from pathlib import Path

from torchrg.datasets.rgbd_images import DEPTH_SUFFIXES
from torchrg.datasets.scene_list import listed
from torchrg.errors import FormatError

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Suffixes of colour images."""


def recordings(root: str | os.PathLike[str], mark: str) -> list[Path]:
    """Return the recordings in a folder, which may be one itself, in natural order.

    Args:
        root: The folder.
        mark: Pattern of a name that every recording has in it.

    Raises:
        FormatError: If there is none.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder; check the spelling.")
    candidates = [folder, *(path for path in listed(folder) if path.is_dir())]
    found = [path for path in candidates if any(path.glob(mark))]
    if not found:
        raise FormatError(f"{folder}: expected recordings with {mark} in them, got none.")
    return found


def frame_name(root: str | os.PathLike[str], recording: Path, image: str) -> str:
    """Return the name of a frame: that of its recording and its own.

    Example:
        >>> frame_name("data", Path("data/office"), "12")
        'office/12'
        >>> frame_name("data/office", Path("data/office"), "12")
        'office/12'
    """
    inside = recording.relative_to(root).as_posix()
    return f"{recording.resolve().name if inside == '.' else inside}/{image}"


def numbered_images(folder: Path) -> list[Path]:
    """Return the depth images of a folder in natural order."""
    return [path for path in listed(folder) if path.suffix.lower() in DEPTH_SUFFIXES]


def image_beside(folder: Path, stem: str) -> Path | None:
    """Return the colour image of a name, None if there is none."""
    paths = (folder / f"{stem}{suffix}" for suffix in COLOR_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)
