"""Folders of clouds as data sets, and ordered file discovery."""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, overload

import numpy as np
import torch
from torch.utils.data import Dataset, Subset

from torchrg._checks import as_tensor
from torchrg.datasets.collate import collate_offset
from torchrg.datasets.pointcept import POINT_ARRAYS, SOURCE_ARRAYS, read_pointcept_scene
from torchrg.errors import FormatError, warn
from torchrg.io import FOLDER_SUFFIXES, TEXT_SUFFIXES, estimate_points, read_cloud, takes_columns
from torchrg.io.files import decode_file, list_some, local_path
from torchrg.io.npy import map_array, map_folder
from torchrg.structures import Cloud
from torchrg.structures.colors import read_colors
from torchrg.transforms.rows import Sample, SampleDict

Transform = Callable[[SampleDict], Sample]
"""A function that data sets apply to each sample."""
_MAX_PROSE_BYTES = 1 << 16
"""Maximum size of a text file that is read to see whether it contains points."""
_LINKS = "links to files that were already read, or to a parent folder"
_THREE_NUMBERS = re.compile(r"^\W*([-+]?[\d.][^\s,;]*[\s,;]+){2}[-+]?[\d.]", re.MULTILINE)
"""Beginning of a line of points."""


class SceneFiles(NamedTuple):
    """Item of a data set and its files.

    Attributes:
        name: Unique name, usable as a path below an output folder, with forward slashes:
            ``Area_1/office_1``.
        path: The file or folder that is read.
        files: All input files in reading order; their bytes determine the result.
        dataset: The data set that defines the classes, empty if unknown; None for a plain cloud.
        release_path: Path in the release, which some programs keep. Default: its name.
        num_points: Number of points from headers or file sizes, for ``convert``.
        item: Extra data for reading; picklable.
    """

    name: str
    path: Path
    files: tuple[Path, ...]
    dataset: str | None = None
    release_path: str = ""
    num_points: int = 0
    item: Any = None


class SceneDataset(Dataset[Sample]):
    r"""Base class of map-style data sets, which list their scenes before reading them.

    A subclass sets ``root`` and ``scenes`` and overrides :meth:`read_scene`. It then works in a
    :class:`torch.utils.data.DataLoader`, and :class:`torchrg.batch.sources.CloudSource` converts
    it.

    Attributes:
        root: The folder of the data set.
        scenes: Name, path and input files of each scene.
        transform: Applied to each sample. Default: none.

    Example:
        >>> import tempfile
        >>> class TextScans(SceneDataset):
        ...     kind = "text-scans"
        ...     def __init__(self, root):
        ...         self.root = Path(root)
        ...         paths = sorted(self.root.glob("*.txt"))
        ...         self.scenes = [SceneFiles(path.stem, path, (path,), "") for path in paths]
        ...     def read_scene(self, scene):
        ...         rows = np.loadtxt(scene.path)
        ...         return Cloud(rows[:, :3], {"segment": rows[:, 3].astype(np.int16)})
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = (Path(root) / "a.txt").write_text("0 0 0 4\n1 0 0 4\n")
        ...     TextScans(root)[0]["segment"].tolist()
        [4, 4]
    """

    root: Path
    scenes: list[SceneFiles]
    transform: Transform | None = None
    kind: ClassVar[str] = "scenes"
    """Name of the type of data set in records of :mod:`torchrg.batch`."""

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a scene, with labels among its fields."""
        raise NotImplementedError

    def read_cloud(self, index: int) -> Cloud:
        """Return the cloud of the scene at an index."""
        return self.read_scene(self.scenes[index])

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a scene: its fields, and the coordinates stored in its files."""
        cloud = self.read_cloud(index)
        fields: SampleDict = {key: torch.from_numpy(v) for key, v in cloud.fields.items()}
        for key in fields.keys() & {"segment", "segment200", "instance"}:
            fields[key] = fields[key].reshape(len(cloud), -1)[:, 0].long()
        if cloud.front is not None:
            fields["front"] = torch.from_numpy(cloud.front)
        header = cloud.header.items()
        arrays = {k: torch.from_numpy(v) for k, v in header if isinstance(v, np.ndarray)}
        name = self.scenes[index].name
        return {"coord": torch.from_numpy(cloud.coordinates), **fields, **arrays, "name": name}

    def count_points(self, scene: SceneFiles) -> int:
        """Return the approximate number of points of a scene, without reading it."""
        return estimate_points(scene.path / "coord.npy" if scene.path.is_dir() else scene.path)

    def describe(self) -> dict[str, Any]:
        """Return the JSON-serializable parameters that affect the samples."""
        return {}

    def allows_results(self, layout: str) -> bool:
        """Return whether results of a layout in ``root`` would not be read as scenes."""
        return False

    def __len__(self) -> int:
        return len(self.scenes)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> Subset[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | Subset[Sample]:
        """Return a transformed sample, or the subset of a slice.

        An error of the transform has a note with the name, index and path of the scene.
        """
        if isinstance(index, slice):
            return Subset(self, range(len(self))[index])
        sample = self.read_sample(index)
        if self.transform is None:
            return sample
        try:
            return self.transform(sample)
        except Exception as error:
            scene = self.scenes[index]
            add_note(error, f"Sample {index}, {scene.name}, was read from {scene.path}.")
            raise

    def __iter__(self) -> Iterator[Sample]:
        """Yield all samples; Python's default takes an IndexError of the transform for the end."""
        return (self[index] for index in range(len(self)))

    def __repr__(self) -> str:
        root = [repr(str(self.root))] if hasattr(self, "root") else []
        return f"{type(self).__name__}({', '.join([*root, f'{len(self):,} scenes'])})"


class FolderOfClouds(SceneDataset):
    """All readable clouds below a folder, in natural order; hidden files are skipped.

    Links are followed and each file is read once; see :func:`find_files`.

    A sample has ``coord`` ``(N, 3)`` float32 relative to ``origin`` ``(1, 3)`` float64, and the
    fields of the file (``normal``, ``color``, ``labels``, ``intensity``, ...). It has ``front`` if
    the file stores which side of a surface was seen (see :attr:`torchrg.Cloud.front`). ``name`` is
    the path below ``root`` without suffix. A folder with ``coord.npy`` is one cloud in Pointcept's
    layout; see :func:`torchrg.datasets.read_pointcept_scene`.

    Args:
        root: The folder.
        suffixes: Suffixes of cloud files. Default: all formats except ``.csv``.
        exclude: Shell patterns of names, or of paths below the folder, that are no clouds, such as
            ``"readme.txt"`` or ``"old/*"``.
        columns: Column names of text and ``.npy``; see :func:`torchrg.read_cloud`.
        transform: Applied to each sample.

    Attributes:
        scenes: Name, path and input files of each cloud.

    Raises:
        FormatError: If the folder is missing, contains no cloud, or two of the same name.

    Warns:
        UserWarning: If links are skipped.
    """

    kind = "folder"

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        suffixes: Sequence[str] = FOLDER_SUFFIXES,
        exclude: Sequence[str] = (),
        columns: Sequence[str] | None = None,
        transform: Transform | None = None,
    ) -> None:
        self.root = local_path(root)
        self.transform = transform
        self.columns = columns
        endings = {suffix.lower() for suffix in suffixes}
        paths = [
            path
            for path in find_files(self.root, is_item=is_scene)
            if path.is_dir() or path.suffix.lower() in endings
            if not _is_matched(path.relative_to(self.root), exclude)
        ]
        if any(path.parent.name == "Annotations" for path in paths):
            warn(
                f"{root}: folders Annotations contain parts of rooms of S3DIS; use torchrg convert "
                "s3dis or torchrg.datasets.S3DIS."
            )
        for path in paths:
            if path.suffix == ".npy" and path.stem in POINT_ARRAYS:
                raise FormatError(
                    f"{path.parent}: expected coord.npy next to {path.name}, got none; copy it, or "
                    "rename the file if it is a cloud."
                )
        others = dict.fromkeys(path for path in paths if columns is None and is_other(path))
        warn_skipped(self.root, [*others], "files without points")
        paths = [path for path in paths if path not in others]
        if not paths:
            raise FormatError(f"{root}: expected files ending in {' '.join(suffixes)}, got none.")
        self.scenes = [self._scene(path) for path in paths]
        first: dict[str, Path] = {}
        for name, path, *_ in self.scenes:
            if first.setdefault(name, path) != path:
                one, other = (file.relative_to(self.root) for file in (first[name], path))
                raise FormatError(
                    f"{root}: expected one file per scan, got {one} and {other}; move or rename "
                    "one, or select files by suffix."
                )

    def _scene(self, path: Path) -> SceneFiles:
        """Return a cloud, named by its path without suffix."""
        inside = path.relative_to(self.root)
        if not path.is_dir():
            return SceneFiles(inside.with_suffix("").as_posix(), path, (path,))
        files = tuple(f for name in POINT_ARRAYS if (f := path / f"{name}.npy").is_file())
        # segment20 indicates ScanNet; segment alone could be of any data set.
        is_known = {"segment", "segment20"} & {file.stem for file in files} != {"segment"}
        return SceneFiles(inside.as_posix(), path, files, "ScanNet" if is_known else "")

    def describe(self) -> dict[str, Any]:
        """Return the JSON-serializable parameters that affect the samples."""
        return {} if self.columns is None else {"columns": list(self.columns)}

    def allows_results(self, layout: str) -> bool:
        """Return whether results of a layout just complete Pointcept folders."""
        return layout == "pointcept" and all(scene.path.is_dir() for scene in self.scenes)

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a file, or of a folder in Pointcept's layout."""
        path = scene.path
        if not path.is_dir():
            return read_cloud(path, columns=self.columns if takes_columns(path) else None)
        arrays, notes = map_folder(path, SOURCE_ARRAYS), tuple[str, ...]()
        if "color" in arrays:
            arrays["color"], notes = read_colors(path / "color.npy", arrays["color"])
        return Cloud(arrays.pop("coord"), arrays, source=str(path), notes=notes)

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a cloud."""
        name, path, *_ = self.scenes[index]
        if path.is_dir():
            return {**read_pointcept_scene(path), "name": name}
        cloud = self.read_cloud(index)
        fields = {
            "normal" if field == "normals" else field: as_tensor(str(path), field, values)
            for field, values in cloud.fields.items()
            if values.dtype.kind in "fiub"
        }
        if cloud.front is not None:
            fields["front"] = torch.from_numpy(cloud.front)
        origin = torch.from_numpy(cloud.origin).reshape(1, 3)
        return {**fields, "coord": cloud.points, "origin": origin, "name": name}


def read_pointcept_area(folder: str | os.PathLike[str]) -> SampleDict:
    """Read all scenes of a Pointcept folder as one cloud: an area of S3DIS, a split.

    Loaders of complete areas use this; see :mod:`torchrg.datasets`.

    Args:
        folder: A folder of scenes, such as ``OUT/Area_5`` of ``torchrg convert s3dis``.

    Returns:
        Results of :func:`torchrg.datasets.read_pointcept_scene`, concatenated in natural order:
        ``(N, ...)``, with ``offset`` ``(B,)``, the end row of each scene, and ``name``, a list.
        IDs in ``instance``, ``plane`` and ``superpoint`` are offset to be unique; -1 is unchanged.

    Raises:
        FormatError: If the folder is missing, contains no scene, or a file is corrupt.
        ShapeError: If the arrays of the scenes differ.
    """
    paths = [path for path in find_files(local_path(folder), is_item=is_scene) if path.is_dir()]
    if not paths:
        raise FormatError(f"{folder}: expected folders with coord.npy, got none; pass an area.")
    scenes: list[SampleDict] = [{**read_pointcept_scene(p), "name": p.name} for p in paths]
    unique = [key for key in ("instance", "plane", "superpoint") if key in scenes[0]]
    return collate_offset(scenes, unique=unique)


def is_other(path: Path) -> bool:
    """Whether an intact file is no cloud: a list of numbers such as labels, or text to be read."""
    with suppress(FormatError):
        if path.suffix.lower() == ".npy":
            values = map_array(path)
            return values.ndim == 1 and values.dtype.names is None
        if path.suffix.lower() in TEXT_SUFFIXES and 0 < path.stat().st_size <= _MAX_PROSE_BYTES:
            return _THREE_NUMBERS.search(decode_file(path)) is None
    return False


def _is_matched(path: Path, patterns: Sequence[str]) -> bool:
    """Whether a name, or a path with ``*`` also for slashes, matches one of the patterns."""
    return any(fnmatchcase(name, p) for name in (path.name, path.as_posix()) for p in patterns)


def is_scene(folder: Path) -> bool:
    """Whether a folder is itself a cloud in Pointcept's layout."""
    return (folder / "coord.npy").is_file()


def check_folder(folder: Path) -> None:
    """Raise FormatError if a folder does not exist, or is a file."""
    if not (path := local_path(folder)).is_dir():
        problem = "expected a folder, got a file" if path.exists() else "no such folder"
        raise FormatError(f"{folder}: {problem}; check the spelling.")


def find_files(
    folder: Path, *, is_item: Callable[[Path], bool] = lambda folder: False
) -> list[Path]:
    """Return each visible file below a folder once, in natural order.

    A folder for which ``is_item`` is true is returned instead of its files. Links are followed,
    except to a folder that contains them. For duplicates, the path without links is returned, else
    the first path.

    Warns:
        UserWarning: If a duplicate or a recursive link is skipped.
    """
    check_folder(folder)
    files: list[Path] = []
    seen: set[str] = set()
    links: list[Path] = []
    skipped: list[Path] = []

    def visit(path: Path, real_path: str) -> None:
        if real_path in seen:
            skipped.append(path)
            return
        seen.add(real_path)
        if not path.is_dir() or is_item(path):
            files.append(path)
            return
        for entry in list_dir(path):
            if entry.is_symlink() and not entry.name.startswith("."):
                links.append(entry)
            elif not entry.name.startswith("."):
                visit(entry, os.path.join(real_path, entry.name))  # noqa: PTH118 Paths are slow here.

    visit(folder, os.path.realpath(folder))
    while links:
        link = links.pop(0)
        parent, target = (Path(os.path.realpath(path)) for path in (link.parent, link))
        if parent.is_relative_to(target):
            skipped.append(link)
        else:
            visit(link, str(target))
    warn_skipped(folder, skipped)
    return sorted(files, key=lambda path: [natural_key(p) for p in path.relative_to(folder).parts])


def warn_skipped(folder: Path, skipped: Sequence[Path], why: str = _LINKS) -> None:
    """Warn if entries of a folder were skipped, with the reason."""
    if skipped:
        names = [str(path.relative_to(folder)) for path in skipped]
        warn(f"{folder}: skipped {list_some(names, max_names=1)}: {why}.")


def list_dir(folder: str | os.PathLike[str]) -> list[Path]:
    """Return all entries of a folder in natural order, including hidden ones."""
    return sorted(Path(folder).iterdir(), key=lambda path: natural_key(path.name))


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Return a locale-independent key for natural sorting of names with numbers."""
    parts = re.split(r"([0-9]+)", name)
    key: list[tuple[int, int | str]] = [
        (0, int(piece)) if piece.isdigit() else (1, piece.lower()) for piece in parts if piece
    ]
    # The name itself breaks ties of case and leading zeros.
    return (*key, (2, name))


def add_note(error: BaseException, note: str) -> None:
    """Add a line to an error; to its message in Python 3.10, which has no notes."""
    if sys.version_info >= (3, 11):
        error.add_note(note)
    else:
        error.args = (f"{error} {note}",)
