"""A folder of clouds as a source: one result folder for each cloud."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torchrg.batch.results import write_results
from torchrg.batch.scans import Converted, Scan, check_finite
from torchrg.config import PipelineConfig
from torchrg.datasets import (
    FolderOfClouds,
    Scene,
    read_pointcept_scene,
    write_pointcept_scene,
)
from torchrg.errors import ConfigError
from torchrg.io import read_cloud
from torchrg.io.counts import estimate_points
from torchrg.pipeline import segment_planes
from torchrg.structures import Cloud

COPIED = ("coord", "color", "strength", "segment", "instance")
"""Arrays of a folder in Pointcept's layout that go along with its results."""


@dataclass(frozen=True)
class FolderSource:
    """Every readable cloud below a folder; folders in Pointcept's layout are clouds too.

    Files: ``coord``, ``normal``, ``curvature`` and ``plane`` as ``.npy``, ``color`` too where the
    cloud has colours, and ``planes.json``. Coordinates are the input's own, points that are not
    finite included. Folders in Pointcept's layout: see
    :func:`torchrg.datasets.write_pointcept_scene`.

    Args:
        root: The folder.
        settings: How to segment.
        out: Where results go. ``root`` itself completes folders in Pointcept's layout in place;
            no other folder below it can be.
        superpoint: Whether the planes of folders in Pointcept's layout are written as
            ``superpoint`` too.
    """

    root: Path
    settings: PipelineConfig
    out: Path
    superpoint: bool = False
    bytes_per_point: ClassVar[int] = 12 + 3 + 12 + 4 + 4

    @property
    def in_place(self) -> bool:
        """Whether results go into the folders of the clouds."""
        return self.out == self.root

    def describe(self) -> dict[str, Any]:
        """Return kind and options."""
        return {"kind": "folder", "superpoint": self.superpoint}

    def list_scans(self) -> list[Scan]:
        """Return the clouds in natural order.

        Raises:
            FormatError: If there is none.
            ConfigError: If results would go in among clouds that are files.
        """
        scenes = FolderOfClouds(self.root).scenes
        file = next((scene.path for scene in scenes if not scene.path.is_dir()), None)
        if file is not None and self.in_place:
            raise ConfigError(
                f"{self.out}: expected a directory outside {self.root} for the results of "
                f"{file.name}; choose another."
            )
        return [self._scan(scene) for scene in scenes]

    def _scan(self, scene: Scene) -> Scan:
        """Return a cloud with its input files."""
        if not scene.path.is_dir():
            return Scan(scene.name, (scene.path,), estimate_points(scene.path))
        # In place, nothing but the coordinates decides what is added.
        used = COPIED if not self.in_place else ("coord",)
        files = tuple(file for file in scene.files if file.stem in used)
        return Scan(scene.name, files, estimate_points(scene.path / "coord.npy"))

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one cloud.

        Raises:
            FormatError: If it cannot be read or has no finite point, or a result not be written.
        """
        begin("read")
        first = scan.inputs[0]
        is_file = first.parent.relative_to(self.root).as_posix() != scan.name
        if is_file:
            cloud = read_cloud(first)
        else:
            sample = read_pointcept_scene(first.parent)
            cloud = Cloud(sample["coord"].numpy(), source=str(first.parent))
        warnings = check_finite(cloud)
        seg = segment_planes(cloud.points, self.settings, on_stage=begin)
        begin("write")
        origin = cloud.origin.tolist()
        if is_file:
            colors = {name: cloud.fields[name] for name in ("color",) if name in cloud.fields}
            files = write_results(folder, cloud.coordinates, seg, fields=colors, origin=origin)
        else:
            kept = {name: sample[name] for name in COPIED if name in sample}
            files = write_pointcept_scene(
                folder, kept, seg, superpoint=self.superpoint, origin=origin
            )
        return Converted(len(cloud), len(seg.planes.count), tuple(files), warnings=warnings)
