"""A folder of clouds as a source: one result folder for each file that can be read."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.batch.scans import Converted, Scan
from torchrg.config import PipelineConfig
from torchrg.datasets.plane_table import describe_planes
from torchrg.datasets.scene_list import natural_key
from torchrg.errors import FormatError
from torchrg.io import FORMATS, atomic_path, read_cloud
from torchrg.io.counts import estimate_points
from torchrg.pipeline import segment_planes
from torchrg.structures import Cloud, Segmentation


@dataclass(frozen=True)
class FolderSource:
    """Every readable cloud below a folder.

    Writes ``coord``, ``normal``, ``curvature`` and ``plane`` as ``.npy``, ``color`` too where the
    cloud has colours, and ``planes.json``. Coordinates are the input's own, points that are not
    finite included.

    Args:
        root: The folder.
    """

    root: Path
    bytes_per_point: int = 12 + 12 + 4 + 8

    def describe(self) -> dict[str, Any]:
        """Return the kind of the source."""
        return {"kind": "folder"}

    def list_scans(self) -> list[Scan]:
        """Return the files that can be read, hidden ones left out, in natural order.

        Raises:
            FormatError: If there is none, or two would have one result folder.
        """
        if not self.root.is_dir():
            raise FormatError(f"{self.root}: expected a directory; check the spelling.")
        scans: dict[str, Scan] = {}
        for path in sorted(self.root.rglob("*"), key=lambda path: natural_key(path.as_posix())):
            inside = path.relative_to(self.root)
            hidden = any(part.startswith(".") for part in inside.parts)
            if hidden or path.suffix.lower() not in FORMATS or not path.is_file():
                continue
            name = inside.with_suffix("").as_posix()
            if name in scans:
                raise FormatError(
                    f"{path}: {scans[name].inputs[0].name} beside it has the same name, and "
                    "results go by name; move or rename one."
                )
            scans[name] = Scan(name, (path,), estimate_points(path))
        if not scans:
            raise FormatError(f"{self.root}: expected clouds ({' '.join(FORMATS)}), got none.")
        return list(scans.values())

    def convert(
        self, scan: Scan, folder: Path, settings: PipelineConfig, begin: Callable[[str], None]
    ) -> Converted:
        """Read, segment and write one cloud.

        Raises:
            FormatError: If it cannot be read or has no finite point, or a result not be written.
        """
        begin("read")
        cloud = read_cloud(scan.inputs[0])
        num_bad = len(cloud) - int(cloud.finite.sum())
        if num_bad == len(cloud):
            raise FormatError(
                f"{cloud.source}: expected finite points, got none in {num_bad:,} points."
            )
        seg = segment_planes(cloud.points, settings, on_stage=begin)
        begin("write")
        files = _write(folder, cloud, seg)
        warnings = [f"{num_bad:,} points are not finite"] if num_bad else []
        if len(seg.planes.count) == 0:
            warnings.append("no plane found")
        return Converted(len(cloud), len(seg.planes.count), files, warnings=tuple(warnings))


def _write(folder: Path, cloud: Cloud, seg: Segmentation) -> tuple[str, ...]:
    """Write the results of a cloud and return the names of the files."""
    arrays: dict[str, NDArray[Any]] = {
        "coord": cloud.coordinates,
        "normal": seg.normals.numpy(),
        "curvature": seg.curvature.numpy(),
        "plane": seg.labels.numpy().astype(np.int32),
    }
    if "color" in cloud.fields:
        arrays["color"] = cloud.fields["color"]
    for name, values in arrays.items():
        with atomic_path(folder / f"{name}.npy") as beside:
            np.save(beside, np.ascontiguousarray(values), allow_pickle=False)
    with atomic_path(folder / "planes.json") as beside:
        table = describe_planes(seg.planes, origin=cloud.origin.tolist())
        beside.write_text(json.dumps(table) + "\n", encoding="utf-8")
    return (*(f"{name}.npy" for name in arrays), "planes.json")
