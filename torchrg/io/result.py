"""Segmentation results: a cloud with its labels, planes and superpoints.

:func:`torchrg.write_cloud` and commands write them, :func:`read_result` reads them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg.errors import ShapeError
from torchrg.io import read_cloud
from torchrg.io.dxf import encode_dxf
from torchrg.io.fields import add_result_fields
from torchrg.io.files import PARSE_ERRORS, atomic_path, local_path
from torchrg.io.npy import POINT_RESULTS, map_folder, read_result_arrays
from torchrg.io.plane_table import Arrays, Json, described_to_arrays, encode_csv, planes_from_arrays
from torchrg.io.plane_table import describe_planes as describe_planes
from torchrg.metrics.contingency import number_labels
from torchrg.neighbors import search_knn
from torchrg.neighbors.order import distinct_rows
from torchrg.regions import summarize_planes
from torchrg.regions.adjacency import find_adjacency
from torchrg.regions.superpoints import majority_planes
from torchrg.structures import (
    UNLABELED,
    Cloud,
    Neighbors,
    PlaneAdjacency,
    Planes,
    Segmentation,
    Superpoints,
)
from torchrg.structures.colors import narrow_colors, read_colors
from torchrg.structures.points import FilePath, are_integers, short_repr

__all__ = ["Result", "read_result", "write_table"]
__dir__ = __all__.copy

PLANES_FILE, RECORD = "planes.json", "provenance.json"
"""Files of the plane table and the provenance in a folder of arrays; see
``torchrg/datasets/provenance.py``."""
PAGE_SUFFIXES = (".png", ".html")
"""Suffixes of the image and the viewer of a result."""
_FOLDER_FIELDS = {
    "plane": "labels",
    "superpoint": "superpoint",
    "normal": "normals",
    "curvature": "curvature",
    "color": "color",
}
"""Fields of a cloud by the names of their arrays in a folder."""
_KINDS = {
    "labels": ("iu", ()),
    "superpoint": ("iu", ()),
    "color": ("ub", (3,)),
    "normals": ("f", (3,)),
    "curvature": ("f", ()),
    "sharp": ("b", ()),
    "valid": ("b", ()),
}
"""NumPy's kind of numbers of a field, and shape of a row."""
_MAX_SAMPLED_POINTS = 100_000
"""Number of points of a random sample from which adjacent planes are found if unknown."""
_NUM_NEIGHBORS = 50
"""Number of neighbors: the default for normals, so that small clouds get their own adjacency."""


@short_repr
@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A cloud, its per-point results, and its plane table.

    Args:
        cloud: The points. Its fields include the known results: ``labels``, ``normals``,
            ``curvature``, the masks ``sharp`` and ``valid``, and ``superpoint``, with coarser
            levels as ``superpoint_1`` and so on.
        table: Plane table relative to :attr:`Cloud.origin`; rows by label. Default: none.
        plane_of_superpoint: See :attr:`torchrg.structures.Superpoints.plane`, shape ``(S,)``.
        provenance: Record of how the result was made.
        neighbors: See :attr:`torchrg.structures.Segmentation.neighbors`.

    Example:
        >>> points = np.array([[0.0, 0, 2], [1, 0, 2], [0, 1, 2], [1, 1, 2], [5, 5, 5]])
        >>> labeled = Cloud(points, {"labels": np.array([7, 7, 7, 7, -1])})
        >>> result = Result(labeled)
        >>> result.names.tolist(), result.planes.offset.tolist(), result.planes.count.tolist()
        ([7], [2.0], [4])
    """

    cloud: Cloud
    table: Planes | None = None
    plane_of_superpoint: Tensor | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    neighbors: Neighbors | None = None

    @classmethod
    def from_segmentation(
        cls, cloud: Cloud, segmentation: Segmentation, superpoints: Superpoints | None = None
    ) -> Result:
        """Create the result of segmenting a cloud, or a depth image with its pixels as points.

        Input fields with the names of results are renamed, as in files.

        Raises:
            ShapeError: If the segmentation has another number of points.
        """
        if segmentation.labels.numel() != len(cloud):
            raise ShapeError(
                f"Result: expected a segmentation of {len(cloud):,} points, got "
                f"{segmentation.labels.numel():,}; pass the points that were segmented."
            )
        segmentation = segmentation.cpu()
        superpoints = None if superpoints is None else superpoints.cpu()
        arrays = ((name, getattr(segmentation, name).numpy(force=True)) for name in POINT_RESULTS)
        results = {name: array.reshape(len(cloud), *_KINDS[name][1]) for name, array in arrays}
        if superpoints is not None:
            results |= superpoints.by_level()
        labeled = replace(cloud, fields=add_result_fields(cloud.fields, results))
        plane_of_superpoint = None if superpoints is None else superpoints.plane
        neighbors = segmentation.neighbors
        return cls(labeled, segmentation.planes, plane_of_superpoint, neighbors=neighbors)

    @cached_property
    def fields(self) -> dict[str, Tensor]:
        """Result fields of the cloud with a valid type and shape, and ``color`` as uint8.

        Other files may use these names for different data.
        """
        fields = {
            name: values
            for name, (kinds, shape) in _KINDS.items()
            if (values := self.cloud.fields.get(name)) is not None
            and values.dtype.kind in kinds
            and values.shape[1:] == shape
            and (name != "color" or values.dtype.itemsize <= 2)
        }
        if "color" in fields:
            fields["color"] = narrow_colors(fields["color"])
        return {name: torch.from_numpy(np.ascontiguousarray(v)) for name, v in fields.items()}

    def to_dict(self) -> dict[str, Any]:
        """Convert to a sample for data loaders and transforms.

        Contains ``coord`` ``(N, 3)``, float32, relative to ``origin`` ``(1, 3)``, float64, and if
        known ``plane``, ``normal``, ``curvature``, ``color``, ``superpoint``, ``planes``.

        Example:
            >>> sample = Result(Cloud(np.zeros((2, 3)), {"labels": np.array([0, -1])})).to_dict()
            >>> list(sample), sample["plane"].tolist(), len(sample["planes"])
            (['coord', 'origin', 'plane', 'planes'], [0, -1], 1)
        """
        fields = {**self.fields, "labels": self.labels} if self.planes is not None else self.fields
        origin = torch.from_numpy(self.cloud.origin)[None]
        arrays = {key: fields[name] for key, name in _FOLDER_FIELDS.items() if name in fields}
        table = {} if self.planes is None else {"planes": self.planes}
        return {"coord": self.cloud.points, "origin": origin, **arrays, **table}

    @cached_property
    def _numbering(self) -> tuple[Tensor, Tensor]:
        """Label of each plane, and plane of each point."""
        labels = self.fields.get("labels", torch.full((len(self.cloud),), UNLABELED)).long()
        if self.table is not None:
            return torch.arange(len(self.table)), labels
        is_labeled = torch.from_numpy(self.cloud.finite) & (labels >= 0)
        return number_labels(torch.where(is_labeled, labels, UNLABELED))

    @property
    def names(self) -> Tensor:
        """Label of each row of :attr:`planes`, ascending, shape ``(M,)``, int64."""
        return self._numbering[0]

    @property
    def labels(self) -> Tensor:
        """Row of :attr:`planes` for each point, or -1, shape ``(N,)``, int64.

        Equal to the stored labels for results of torchrg; labels of other programs may have gaps.
        """
        return self._numbering[1]

    @cached_property
    def planes(self) -> Planes | None:
        """The plane table; None without labels.

        Missing data is computed once from the labels: the table, or adjacency for images.
        """
        table = self.table
        if "labels" not in self.fields or (table is not None and table.adjacency is not None):
            return table
        whole = self.cloud.points, self._normals, self.labels
        rows = distinct_rows(self.cloud.points, self.labels)
        sampled, neighbors = rows, self.neighbors
        if neighbors is not None and len(neighbors.indices) != len(rows):
            neighbors = None
        if neighbors is None and bool((self.labels[rows] >= 0).any()):
            chosen = np.random.default_rng(0).permutation(len(rows))[:_MAX_SAMPLED_POINTS]
            sampled = rows[torch.from_numpy(chosen).sort().values]
            k = min(_NUM_NEIGHBORS, len(sampled))
            neighbors = search_knn(self.cloud.points[sampled], k, canonical=True)
        points, (present, labels) = self.cloud.points[sampled], number_labels(self.labels[sampled])
        if table is None:
            has_normals = "normals" in self.fields
            knn = neighbors if has_normals and len(sampled) == len(rows) else None
            parts = (values[rows] for values in whole)
            table = summarize_planes(*parts, neighbors=knn, canonical=True)
            count = torch.bincount(self.labels + 1, minlength=1)[1:]
            table = replace(table, count=count, curved=table.curved & has_normals)
        if neighbors is None or not len(present) or table.adjacency is not None:
            return table
        normal, rms = (column[present].double() for column in (table.normal, table.rms))
        curved, dtype = table.curved[present], table.rms.dtype
        met = find_adjacency(points, labels, neighbors, normal, rms, curved=curved)
        sizes = (size.to(dtype) for size in (met.boundary_length, met.dihedral_deg))
        return replace(table, adjacency=PlaneAdjacency(present[met.pairs], *sizes))

    @property
    def _normals(self) -> Tensor:
        """Normals in the dtype of the points, zero if unknown."""
        points = self.cloud.points
        normals = self.fields.get("normals", torch.zeros_like(points))
        return normals.to(points.dtype).nan_to_num(0, 0, 0)

    @property
    def segmentation(self) -> Segmentation | None:
        """Segmentation of ``cloud.points``; None without labels.

        Missing values are zero or False; points with a normal are ``valid``.
        """
        planes = self.planes if self.table is None else self.table
        if planes is None:
            return None
        points, normals = self.cloud.points, self.fields.get("normals", self._normals)
        has_normal = torch.from_numpy(self.cloud.finite) & (normals != 0).any(dim=1)
        return Segmentation(
            self.labels,
            normals,
            self.fields.get("curvature", torch.zeros(len(points))),
            self.fields.get("sharp", torch.zeros_like(has_normal)),
            self.fields.get("valid", has_normal),
            planes,
            points,
            self.neighbors,
        )

    @property
    def superpoints(self) -> Superpoints | None:
        """Superpoints of the cloud; None without superpoints.

        Labels are renumbered if they exceed the number of points, as after removing points.
        """
        if "superpoint" not in self.fields:
            return None
        fields, labels = self.cloud.fields, self.fields["superpoint"].long()
        coarser = (f"superpoint_{i}" for i in range(1, len(fields)))
        levels = (torch.from_numpy(fields[name]).long() for name in coarser if name in fields)
        plane = self.plane_of_superpoint
        if len(labels) and labels.max() >= len(labels):
            labels, plane = number_labels(labels)[1], None
        if plane is None or len(plane) != labels.max() + 1:
            plane = majority_planes(labels, self.labels)
        return Superpoints(labels, plane, tuple(levels))


def write_table(path: Path, described: Json) -> None:
    """Write the result of :func:`describe_planes` as JSON, CSV or DXF, by file extension."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        content = json.dumps(described, indent=1).encode()
    else:
        content = encode_dxf(described) if suffix == ".dxf" else encode_csv(described)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def read_result(path: FilePath, *, columns: Sequence[str] | None = None) -> Result:
    """Read a saved result, or a plain point cloud.

    Args:
        path: A file, or a folder written by ``torchrg convert`` or in Pointcept's layout.
        columns: Column names, as in :func:`torchrg.read_cloud`.

    Returns:
        The cloud and its results. ``.npz`` files contain complete results, folders all but the
        masks, other files the per-point results of :func:`torchrg.write_cloud`. A plane table that
        does not match the labels is dropped, with a note in ``notes`` of the cloud.

    Raises:
        FormatError: If the file is missing or corrupt; see :func:`torchrg.read_cloud`.
        MissingDependencyError: If the format needs an optional package.

    Example:
        >>> import tempfile
        >>> from torchrg import segment_planes, write_cloud
        >>> cloud = Cloud(torch.cartesian_prod(*[torch.arange(9.0)] * 2, torch.ones(1)).numpy())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_cloud(f"{folder}/plane.npz", cloud, segment_planes(cloud.points))
        ...     result = read_result(f"{folder}/plane.npz")
        >>> result.planes.count.tolist(), result.segmentation.labels.unique().tolist()
        ([81], [0])
    """
    source = local_path(path)
    if source.is_dir():
        cloud, extras = _read_folder(source)
    else:
        cloud = read_cloud(source, columns=columns)
        # Text files have a single type for all columns.
        whole = {
            name: values.astype(np.int64)
            for name, values in cloud.fields.items()
            if name.startswith("superpoint") and values.dtype.kind == "f" and are_integers(values)
        }
        cloud = replace(cloud, fields={**cloud.fields, **whole})
        extras = read_result_arrays(source) if source.suffix.lower() == ".npz" else {}
    planes = extras.get("plane_of_superpoint", np.zeros(()))
    result = Result(
        cloud,
        plane_of_superpoint=torch.from_numpy(planes) if planes.dtype == np.int64 else None,
        provenance=_parse_record(str(extras.get("provenance", ""))),
    )
    if "plane_count" not in extras:
        return result
    try:
        normals = result.fields.get("normals", cloud.points)
        table = planes_from_arrays(extras, cloud.origin, normals.dtype)
        sizes = torch.bincount(result.labels + 1, minlength=1)[1:]
        named = torch.equal(result.names, torch.arange(len(sizes)))
        if named and torch.equal(sizes, table.count):
            return replace(result, table=table)
    except PARSE_ERRORS:
        # A table of an older version, or unrelated arrays with these names.
        pass
    note = "plane table left out, because it does not match the labels"
    return replace(result, cloud=replace(cloud, notes=(*cloud.notes, note)))


def _read_folder(folder: Path) -> tuple[Cloud, Arrays]:
    """Return the cloud of a folder of arrays, and its other arrays as named in ``.npz``."""
    arrays = map_folder(folder, ("coord", *_FOLDER_FIELDS))
    fields = {
        _FOLDER_FIELDS[name]: values.reshape(-1, *_KINDS[_FOLDER_FIELDS[name]][1])
        for name, values in arrays.items()
        if name in _FOLDER_FIELDS
    }
    for name in fields.keys() & {"labels", "superpoint"}:
        fields[name] = fields[name].astype(np.int64)
    notes: tuple[str, ...] = ()
    if "color" in fields:
        color, notes = read_colors(folder / "color.npy", arrays["color"])
        fields["color"] = color.reshape(-1, 3)
    coord = arrays["coord"]
    grid = coord.shape[:2] if coord.ndim == 3 else None
    cloud = Cloud(coord.reshape(-1, 3), fields, grid, str(folder), notes=notes)
    extras: Arrays = {}
    if (folder / RECORD).is_file():
        extras["provenance"] = np.array((folder / RECORD).read_text("utf-8", "replace"))
    if (folder / PLANES_FILE).is_file():
        try:
            text = (folder / PLANES_FILE).read_text(encoding="utf-8")
            extras |= described_to_arrays(json.loads(text))
        except PARSE_ERRORS:
            extras["plane_count"] = np.zeros(0)
    return cloud, extras


def _parse_record(text: str) -> dict[str, Any]:
    """Parse a provenance record; return an empty one if invalid."""
    try:
        content = json.loads(text)
    except PARSE_ERRORS:
        return {}
    return content if isinstance(content, dict) else {}
