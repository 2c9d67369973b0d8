"""S3DIS as a source: the raw release in, Pointcept's layout with planes out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torchrg._optional import require
from torchrg.batch.scans import Converted, Scan, check_finite
from torchrg.config import PipelineConfig
from torchrg.datasets import S3DIS, RoomReport, Scene, read_room, write_pointcept_scene
from torchrg.io.counts import estimate_points
from torchrg.pipeline import segment_planes
from torchrg.structures import Cloud


@dataclass(frozen=True)
class S3DISSource:
    """The rooms of S3DIS, ``ROOT/Area_i/<room>/Annotations/*.txt``.

    Writes ``OUT/Area_i/<room>`` as :func:`torchrg.datasets.write_pointcept_scene` does.

    Args:
        root: The folder that holds ``Area_1`` to ``Area_6``.
        settings: How to segment.
        areas: Numbers of the areas.
        class_order: Meaning of the numbers in ``segment``; see :class:`torchrg.datasets.S3DIS`.
        superpoint: Whether planes are written as ``superpoint`` too.
    """

    root: Path
    settings: PipelineConfig
    areas: tuple[int, ...]
    class_order: str = "pointcept"
    superpoint: bool = False
    in_place: ClassVar[bool] = False
    bytes_per_point: ClassVar[int] = 12 + 3 + 12 + 2 + 2 + 4 + 4 + 4

    def describe(self) -> dict[str, Any]:
        """Return kind and options."""
        return {
            "kind": "s3dis",
            "class_order": self.class_order,
            "superpoint": self.superpoint,
        }

    def list_scans(self) -> list[Scan]:
        """Return the rooms in natural order.

        Raises:
            FormatError: If an area is missing, or a room has no objects.
            MissingDependencyError: If what reads rooms is not installed.

        Warns:
            UserWarning: If an area has not as many rooms as the release.
        """
        require("pyarrow", extra="s3dis", purpose="read S3DIS")
        rooms = S3DIS(self.root, self.areas, class_order=self.class_order, cache=None)
        return [Scan(scene.name, scene.files, _estimate(scene)) for scene in rooms.scenes]

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read, segment and write one room.

        Raises:
            FormatError: If it cannot be read, or a result not be written.
        """
        begin("read")
        room = read_room(self.root / scan.name, class_order=self.class_order)
        cloud = Cloud(room.coord, source=scan.name)
        notes = (*check_finite(cloud), *_notes(room.report))
        seg = segment_planes(cloud.points, self.settings, on_stage=begin)
        begin("write")
        sample = {
            "coord": room.coord,
            "color": room.color,
            "segment": room.segment,
            "instance": room.instance,
        }
        files = write_pointcept_scene(
            folder, sample, seg, superpoint=self.superpoint, origin=cloud.origin.tolist()
        )
        repairs = tuple(
            f"{r.file.name}: line {r.line}, column {r.column}: {r.before!r} read as {r.after!r}"
            for r in room.report.repairs
        )
        return Converted(len(cloud), len(seg.planes.count), tuple(files), repairs, notes)


def find_areas(root: Path) -> tuple[int, ...]:
    """Return the numbers of the areas that are there; all six if none is, to be told so."""
    return tuple(n for n in range(1, 7) if (root / f"Area_{n}").is_dir()) or tuple(range(1, 7))


def _estimate(scene: Scene) -> int:
    """Return the number of points by the size of the files and the lines of the largest."""
    sizes = {file: file.stat().st_size for file in scene.files}
    largest = max(sizes, key=lambda file: sizes[file])
    return round(sum(sizes.values()) * estimate_points(largest) / max(sizes[largest], 1))


def _notes(report: RoomReport) -> tuple[str, ...]:
    """Return what was passed over in a room, a line each."""
    skipped = [f"{item.file.name} not read: {item.reason}" for item in report.skipped]
    return (*skipped, *(f"{file.name} taken as clutter" for file in report.as_clutter))
