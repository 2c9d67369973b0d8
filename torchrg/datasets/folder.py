"""Any folder of clouds as a data set, and how the files below a folder are found and ordered."""

import os
import re
import unicodedata
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch.utils.data import Dataset

from torchrg._checks import as_tensor
from torchrg.datasets.collate import collate_offset
from torchrg.datasets.pointcept import POINT_ARRAYS, read_pointcept_scene
from torchrg.errors import FormatError
from torchrg.io import FOLDER_SUFFIXES, read_cloud, takes_columns
from torchrg.transforms.rows import Sample, SampleDict

Transform = Callable[[SampleDict], Sample]
"""A function that data sets call with each sample."""
_NUMBERED = {"instance", "plane", "superpoint"}
"""Arrays whose numbers begin again in each scene."""
_FIELD_KEYS = {"normals": "normal"}
"""Fields of a cloud that have another name in a sample."""


class SceneFiles(NamedTuple):
    """One item of a data set, and what it is made from.

    Attributes:
        name: Unique within the data set and fit for a path below an output folder, with forward
            slashes: ``Area_1/office_1``.
        path: The file or folder that is read.
        files: Every input file, in the order they are read; their bytes decide the result.
    """

    name: str
    path: Path
    files: tuple[Path, ...]


class SceneDataset(Dataset[Sample]):
    """A map-style data set whose items are known before they are read.

    A data set sets ``scenes`` and ``transform``, and says how to read a sample.
    """

    scenes: list[SceneFiles]
    transform: Transform | None

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a scene."""
        raise NotImplementedError

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Sample:
        """Return a sample, transformed."""
        sample = self.read_sample(index)
        return sample if self.transform is None else self.transform(sample)


class FolderOfClouds(SceneDataset):
    """All readable clouds below a folder, in natural order; hidden files are passed over.

    Links are followed and each file is read once; see :func:`files_below`.

    A sample has ``coord`` ``(N, 3)`` float32 about ``origin`` ``(1, 3)`` float64, the fields of the
    file (``normal``, ``color``, ``labels``, ``intensity``, ...), ``front`` where the file says to
    which side surfaces look (see :attr:`torchrg.Cloud.front`), and ``name``, the path below
    ``root`` without the suffix. A folder with ``coord.npy`` is one cloud, as Pointcept keeps them;
    see :func:`torchrg.datasets.read_pointcept_scene`.

    Args:
        root: The folder.
        suffixes: Which files are clouds. Default: :data:`torchrg.io.FOLDER_SUFFIXES`,
            all that can be read but ``.csv``.
        columns: Names for the columns of text and of bare ``.npy`` arrays; see
            :func:`torchrg.read_cloud`.
        transform: Called with each sample.

    Attributes:
        scenes: Name, path and input files of each cloud.

    Raises:
        FormatError: If there is no such folder, no cloud in it, or two of one name.

    Warns:
        UserWarning: If links are passed over.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        suffixes: Sequence[str] = FOLDER_SUFFIXES,
        columns: Sequence[str] | None = None,
        transform: Transform | None = None,
    ) -> None:
        self.root = Path(root)
        self.transform = transform
        self.columns = columns
        endings = {suffix.lower() for suffix in suffixes}
        paths = [
            path
            for path in files_below(self.root, is_item=is_scene)
            if path.is_dir() or path.suffix.lower() in endings
        ]
        if not paths:
            raise FormatError(
                f"{root}: expected files that end in one of {' '.join(suffixes)}, got none."
            )
        self.scenes = [SceneFiles(self._name_of(path), path, _files_of(path)) for path in paths]
        first: dict[str, Path] = {}
        for name, path, _ in self.scenes:
            if first.setdefault(name, path) != path:
                one, other = (place.relative_to(self.root) for place in (first[name], path))
                raise FormatError(
                    f"{root}: expected one file for each scan, got {one} and {other}; move or "
                    "rename one, or choose between them by suffixes."
                )

    def _name_of(self, path: Path) -> str:
        """Return the name of a cloud: the path without the suffix, whatever else there is."""
        inside = path.relative_to(self.root)
        return (inside if path.is_dir() else inside.with_suffix("")).as_posix()

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a cloud."""
        name, path, _ = self.scenes[index]
        if path.is_dir():
            return {**read_pointcept_scene(path), "name": name}
        cloud = read_cloud(path, columns=self.columns if takes_columns(path) else None)
        fields = {
            _FIELD_KEYS.get(field, field): as_tensor(str(path), field, values)
            for field, values in cloud.fields.items()
            if values.dtype.kind in "fiub"
        }
        if cloud.front is not None:
            fields["front"] = torch.from_numpy(cloud.front)
        origin = torch.from_numpy(cloud.origin).reshape(1, 3)
        return {**fields, "coord": cloud.points, "origin": origin, "name": name}


def read_pointcept_area(folder: str | os.PathLike[str]) -> SampleDict:
    """Read all scenes of a folder in Pointcept's layout as one cloud: an area of S3DIS, a split.

    Loaders that take whole areas read this; see :mod:`torchrg.datasets`.

    Args:
        folder: A folder of scenes, as ``OUT/Area_5`` of ``torchrg convert s3dis``.

    Returns:
        What :func:`torchrg.datasets.read_pointcept_scene` returns of each scene, end to end in
        natural order: ``(N, ...)``, with ``offset`` ``(B,)``, the row each scene ends before, and
        ``name``, a list. Numbers of ``instance``, ``plane`` and ``superpoint`` go on from scene to
        scene, so that each is in one scene only; -1 stays.

    Raises:
        FormatError: If there is no such folder or no scene in it, or a file is damaged.
        ShapeError: If some scenes have an array that others have not.
    """
    paths = [path for path in files_below(Path(folder), is_item=is_scene) if path.is_dir()]
    if not paths:
        raise FormatError(
            f"{folder}: expected folders with coord.npy, got none; name the folder of an area."
        )
    scenes: list[SampleDict] = [{**read_pointcept_scene(p), "name": p.name} for p in paths]
    for key in _NUMBERED & set(scenes[0]):
        first = 0
        for labels in (scene[key] for scene in scenes if key in scene):
            labels[labels >= 0] += first
            first = int(labels.max()) + 1 if (labels >= 0).any() else first
    return collate_offset(scenes)


def is_scene(folder: Path) -> bool:
    """Whether a folder is a cloud itself, in Pointcept's layout."""
    return (folder / "coord.npy").is_file()


def _files_of(path: Path) -> tuple[Path, ...]:
    """Return the input files of a cloud."""
    if not path.is_dir():
        return (path,)
    files = (path / f"{name}.npy" for name in POINT_ARRAYS)
    return tuple(file for file in files if file.is_file())


def check_folder(folder: Path) -> None:
    """Check that a folder is there."""
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder; check the spelling.")


def files_below(
    folder: Path, *, is_item: Callable[[Path], bool] = lambda folder: False
) -> list[Path]:
    """Return the files below a folder in natural order, without hidden ones, each file once.

    A folder that ``is_item`` itself stands for what is in it. Links to files and folders are
    followed, but not those to a folder that they are in, which have no end. What is there under
    several names has the one without links, or else the one that comes first.

    Warns:
        UserWarning: If something is passed over because it is there under another name.
    """
    check_folder(folder)
    files: list[Path] = []
    seen: set[str] = set()
    links: list[Path] = []
    passed: list[Path] = []

    def take(path: Path, real: str) -> None:
        if real in seen:
            passed.append(path)
            return
        seen.add(real)
        if not path.is_dir() or is_item(path):
            files.append(path)
            return
        for entry in listed(path):
            if entry.is_symlink() and not entry.name.startswith("."):
                links.append(entry)
            elif not entry.name.startswith("."):
                take(entry, os.path.join(real, entry.name))  # noqa: PTH118 Paths are slow here.

    take(folder, os.path.realpath(folder))
    while links:
        link = links.pop(0)
        place, target = (Path(os.path.realpath(path)) for path in (link.parent, link))
        if place.is_relative_to(target):
            passed.append(link)
        else:
            take(link, str(target))
    warn_of_links(folder, passed)
    return sorted(files, key=lambda path: [natural_key(p) for p in path.relative_to(folder).parts])


def warn_of_links(folder: Path, passed: Sequence[Path]) -> None:
    """Warn of what is passed over in a folder because it is there under another name, if any is."""
    if passed:
        more = f" and {len(passed) - 1:,} more" if len(passed) > 1 else ""
        warnings.warn(
            f"{folder}: passed over {passed[0].relative_to(folder)}{more}: a link leads there from "
            "another name, or to a folder that it is in, and each file counts once.",
            stacklevel=3,
        )


def listed(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the entries of a folder in natural order, hidden ones included."""
    return sorted(Path(folder).iterdir(), key=lambda path: natural_key(path.name))


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a key that sorts names with numbers as people do, without regard to the locale.

    Example:
        >>> sorted(["chair_10.txt", "chair_2.txt", "Chair_1.txt"], key=natural_key)
        ['Chair_1.txt', 'chair_2.txt', 'chair_10.txt']
    """
    parts = re.split(r"([0-9]+)", name)
    key: list[tuple[int, int | str]] = [
        (0, int(piece)) if piece.isdigit() else (1, piece.lower()) for piece in parts if piece
    ]
    # Names that differ in case or leading zeros only still have one order.
    return (*key, (2, name))


def folded_name(name: str) -> str:
    """Return what names have in common that some file systems take for the same.

    Those of macOS and Windows do not tell case apart, nor how letters with accents are put
    together, and what is written on others is carried there.

    Example:
        >>> folded_name("B\u00fcro") == folded_name("bu\u0308RO")
        True
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", name).casefold())
