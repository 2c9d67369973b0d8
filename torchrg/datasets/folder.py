"""Any folder of clouds as a data set, and how the files below a folder are found and ordered."""

import os
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch.utils.data import Dataset

from torchrg._checks import as_tensor
from torchrg.datasets.collate import collate_offset
from torchrg.datasets.pointcept import POINT_ARRAYS, SOURCE_ARRAYS, read_pointcept_scene
from torchrg.errors import ConfigError, FormatError
from torchrg.io import FOLDER_SUFFIXES, estimate_points, read_cloud, takes_columns
from torchrg.io.colors import read_colors
from torchrg.io.npy import map_folder
from torchrg.structures import Cloud
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
        dataset: The data set whose classes it has, empty if unknown; None for a plain cloud.
        place: Where it is in the release, which some programs keep. Default: its name.
        num_points: Its number of points by the headers or sizes of its files, for ``convert``.
        item: What else reads it; plain values that travel between processes.
    """

    name: str
    path: Path
    files: tuple[Path, ...]
    dataset: str | None = None
    place: str = ""
    num_points: int = 0
    item: Any = None


class SceneDataset(Dataset[Sample]):
    r"""A map-style data set that lists its scenes before it reads them; base of data sets.

    A data set of your own sets ``root`` and ``scenes`` and overrides :meth:`read_scene`. It then
    works in a :class:`torch.utils.data.DataLoader`, and
    :class:`torchrg.batch.sources.CloudSource` converts it.

    Attributes:
        root: The folder of the data set.
        scenes: Name, path and input files of each scene.
        transform: Called with each sample. Default: none.

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
    """Name of the kind of data set in records of :mod:`torchrg.batch`."""

    def read_scene(self, scene: SceneFiles) -> Cloud:
        """Return the cloud of a scene, labels among its fields."""
        raise NotImplementedError

    def read_cloud(self, index: int) -> Cloud:
        """Return the cloud of the scene of an index."""
        return self.read_scene(self.scenes[index])

    def read_sample(self, index: int) -> SampleDict:
        """Return the sample of a scene: its fields, and coordinates as they are in its files."""
        cloud = self.read_cloud(index)
        fields: SampleDict = {key: torch.from_numpy(v) for key, v in cloud.fields.items()}
        for key in fields.keys() & {"segment", "segment200", "instance"}:
            fields[key] = fields[key].reshape(len(cloud), -1)[:, 0].long()
        if cloud.front is not None:
            fields["front"] = torch.from_numpy(cloud.front)
        header = cloud.header.items()
        whole = {k: torch.from_numpy(v) for k, v in header if isinstance(v, np.ndarray)}
        name = self.scenes[index].name
        return {"coord": torch.from_numpy(cloud.coordinates), **fields, **whole, "name": name}

    def count_points(self, scene: SceneFiles) -> int:
        """Return about how many points a scene has, without reading it."""
        return estimate_points(scene.path / "coord.npy" if scene.path.is_dir() else scene.path)

    def describe(self) -> dict[str, Any]:
        """Return the settings that change what is read, for JSON."""
        return {}

    def check_output(self, layout: str, out: Path) -> None:
        """Raise ConfigError if results in a layout would be read as scenes from where they go."""
        check_outside(self.root, out)

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

    kind = "folder"

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
        self.scenes = [self._scene(path) for path in paths]
        first: dict[str, Path] = {}
        for name, path, *_ in self.scenes:
            if first.setdefault(name, path) != path:
                one, other = (place.relative_to(self.root) for place in (first[name], path))
                raise FormatError(
                    f"{root}: expected one file for each scan, got {one} and {other}; move or "
                    "rename one, or choose between them by suffixes."
                )

    def _scene(self, path: Path) -> SceneFiles:
        """Return a cloud, named by the path without the suffix, whatever else there is."""
        inside = path.relative_to(self.root)
        if not path.is_dir():
            return SceneFiles(inside.with_suffix("").as_posix(), path, (path,))
        files = tuple(f for name in POINT_ARRAYS if (f := path / f"{name}.npy").is_file())
        # Without the classes of ScanNet, the data set is unknown.
        is_known = {"segment", "segment20"} & {file.stem for file in files} != {"segment"}
        return SceneFiles(inside.as_posix(), path, files, "ScanNet" if is_known else "")

    def describe(self) -> dict[str, Any]:
        """Return the settings that change what is read, for JSON."""
        return {} if self.columns is None else {"columns": list(self.columns)}

    def check_output(self, layout: str, out: Path) -> None:
        """Raise ConfigError if results go to ``root`` but do not complete folders of Pointcept."""
        files = [scene.path.name for scene in self.scenes if not scene.path.is_dir()]
        if files or layout != "pointcept":
            what = f"the results of {files[0]}" if files else f"layout {layout}"
            check_outside(self.root, out, f"for {what}")

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


def check_outside(root: Path, out: Path, why: str = "so that no result is read as a scan") -> None:
    """Check that results go elsewhere than to the folder of a data set."""
    if out == root:
        raise ConfigError(f"{out}: expected a directory outside {root}, {why}; choose another.")


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
