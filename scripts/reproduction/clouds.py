"""Clouds: the paper's four or their synthetic substitutes, and others with ground truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reproduction.records import Folder
from tests.made import (
    CURVED_LAYOUT,
    HALL_LAYOUT,
    KINECT_LAYOUT,
    build_scanned_room,
    make_kinect_room,
    make_mapped_room,
    make_storey,
    on_voxels,
    quantised_frame,
    scan_scene,
)
from torchrg import estimate_normals, load_config, search_knn, segment_planes
from torchrg.config import NormalsConfig
from torchrg.io import read_cloud
from torchrg.io.files import hash_file
from torchrg.scenes import Scene, make_room
from torchrg.structures import UNLABELED, Neighbors, NormalFit

POINTS = {"tutorial": 108_104, "hallway": 579_313, "cory": 1_097_901, "kinect": 968_520}
"""Sizes of the paper's clouds (Table 3)."""

QUICK_POINTS = 30_000
"""Maximum number of points of a file in a quick run."""

SMALLEST = 50
"""Minimum number of points of a region that the paper draws, and of a color that is a surface."""

SHELL = ("floor", "ceiling", "wall")
"""Surfaces that are objects of their own, as in the annotations of S3DIS."""

_WARM_UP = 2000
"""Number of points of the cloud that warms up a method."""

_CHUNK = 100_000
"""Number of points whose neighbors are looked up at a time."""

TITLES = {
    "tutorial": "region_growing_tutorial",
    "hallway": "hallway_2",
    "cory": "Cory_5th",
    "kinect": "Kinect v2 room",
}
"""The paper's names of its clouds."""

OTHERS = {"room": "a room", "hall": "a second hall"}
"""Other clouds on which the claims are tried."""

HARD = {
    "exact": "exact planes",
    "quantised": "depth in centimeters",
    "stepped": "depth in steps of a Kinect",
    "frames": "raw frames of a Kinect",
    "thinned": "thinned to voxels",
    "curved": "curved surfaces",
}
"""Clouds unlike the paper's."""


class EvalCloud(NamedTuple):
    """A cloud to segment, with its ground truth if known."""

    key: str  # a key of :data:`TITLES`, :data:`OTHERS` or :data:`HARD`
    name: str  # name in records, unique for the points
    points: Tensor  # finite points, shape ``(N, 3)``
    labels: Tensor | None  # true surfaces, shape ``(N,)``
    normals: Tensor | None  # true normals, shape ``(N, 3)``
    origin: str  # description, and how it differs from the paper's
    is_papers: bool = False  # whether it is the paper's own
    objects: Tensor | None = None  # true objects, shape ``(N,)``
    curved: Tensor | None = None  # labels of the curved surfaces

    @property
    def title(self) -> str:
        """Name in tables, with * for a substitute of the paper's cloud."""
        is_substitute = self.key in TITLES and not self.is_papers
        return f"{title_of(self.key)}*" if is_substitute else title_of(self.key)


def title_of(key: str) -> str:
    """Return the name of a cloud in tables."""
    return {**TITLES, **OTHERS, **HARD}[key]


def load_cloud(key: str, path: Path | None, *, quick: bool) -> EvalCloud:
    """Read a cloud of the paper, or generate its substitute.

    Args:
        key: A key of :data:`TITLES`, :data:`OTHERS` or :data:`HARD`.
        path: File of the paper's cloud, if available.
        quick: Whether to use a small part.

    Returns:
        The cloud. A file gives its finite points, in quick runs the ones nearest to its center.
    """
    return _synthetic_cloud(key, quick) if path is None else _read_cloud(key, path, quick)


def _synthetic_cloud(key: str, quick: bool) -> EvalCloud:
    make, what = SYNTHETIC[key]
    scene = make(quick)
    return EvalCloud(
        key,
        f"{key}-made",
        scene.points,
        scene.labels,
        scene.normals,
        f"{len(scene.points):,} synthetic points with exact ground truth: {what}",
        objects=_objects(scene),
        curved=(~scene.planar).nonzero().squeeze(1),
    )


def _objects(scene: Scene) -> Tensor:
    """Return the object of each point: a table is one object, and so is a wall."""
    is_shell = torch.tensor([kind in SHELL for kind in scene.kinds])
    num_objects = int(scene.objects.max()) + 1
    faces = torch.arange(len(is_shell)) + num_objects
    return torch.where(is_shell, faces, scene.objects)[scene.labels]


def _read_cloud(key: str, path: Path, quick: bool) -> EvalCloud:
    cloud = read_cloud(path)
    kept = torch.from_numpy(cloud.finite).nonzero().squeeze(1)
    origin = f"{len(kept):,} points of {path.name}"
    if quick and len(kept) > QUICK_POINTS:
        points = cloud.points[kept]
        distances = (points - points.median(dim=0).values).square().sum(dim=1)
        kept = kept[distances.topk(QUICK_POINTS, largest=False).indices.sort().values]
        origin = f"{len(kept):,} points around the center of {path.name}"
    fields = {name: values[kept.numpy()] for name, values in cloud.fields.items()}
    labels, normals = (
        torch.from_numpy(fields[field]) if field in fields else None
        for field in ("labels", "normals")
    )
    if key == "tutorial" and labels is None and "color" in fields:
        labels = labels_of_colors(fields["color"])
        origin += ", its colors used as ground truth (a published segmentation, not a measurement)"
    digest = hash_file(path)[:8]
    return EvalCloud(
        key, f"{key}-{digest}", cloud.points[kept], labels, normals, origin, is_papers=not quick
    )


def labels_of_colors(colors: NDArray[np.uint8]) -> Tensor:
    """Return a label for each color of at least 50 points, shape ``(N,)``.

    The file of PCL's tutorial shows a segmentation: 124 colors of at least 50 points.
    """
    _, labels, counts = np.unique(colors, axis=0, return_inverse=True, return_counts=True)
    labels = labels.ravel()
    return torch.from_numpy(np.where(counts[labels] >= SMALLEST, labels, UNLABELED))


_SHORT_HALL = replace(HALL_LAYOUT, size=(10.0, 2.4, 2.7), num_doors=5, num_cabinets=1, num_panels=2)
_PIECE = replace(HALL_LAYOUT, size=(6.0, 2.4, 2.7), num_doors=2, num_cabinets=0, num_panels=1)
_NOISE = 0.003
"""Meters."""
_VOXEL = 0.03
"""Meters."""
_DISPARITY_SCALE = 525 * 0.075 * 8
"""Product of depth, in meters, and disparity, in eighths of a pixel, of a Kinect."""


def _laser_hall(quick: bool) -> Scene:
    """Return a laser scan of a hallway, the substitute for the tutorial's cloud."""
    layout, size = (_PIECE, 30_000) if quick else (_SHORT_HALL, POINTS["tutorial"])
    return scan_scene(build_scanned_room(2, layout=layout), size, noise=_NOISE)


def _depth_room(quick: bool, quantise: Callable[[Tensor], Tensor]) -> Scene:
    """Return a noise-free depth frame with quantized depth."""
    model = build_scanned_room(layout=KINECT_LAYOUT)
    return quantised_frame(model, quantise, 30_000 if quick else 250_000)


def _room(quick: bool, multiple: int = 1, noise: float = _NOISE) -> Scene:
    """Return a furnished room, with a multiple of the default number of points."""
    if quick:
        return make_room(30_000 * multiple, noise, layout=KINECT_LAYOUT)
    return make_room(200_000 * multiple, noise)


SYNTHETIC: dict[str, tuple[Callable[[bool], Scene], str]] = {
    "tutorial": (_laser_hall, "a laser scan of a hallway with doors, noise 3 mm"),
    "hallway": (
        lambda quick: (
            make_room(60_000, layout=_PIECE)
            if quick
            else make_room(POINTS["hallway"], layout=HALL_LAYOUT)
        ),
        "a hallway with doors, panels and cabinets, noise 3 mm",
    ),
    "cory": (
        lambda quick: (
            make_storey(80_000, rooms_per_side=2) if quick else make_storey(POINTS["cory"])
        ),
        "a hallway and the furnished rooms on both sides of it, noise 3 mm",
    ),
    "kinect": (
        lambda quick: (
            make_mapped_room(40_000, num_frames=16, voxel=0.04)
            if quick
            else make_mapped_room(POINTS["kinect"])
        ),
        "an office mapped from frames of a Kinect v2 with known poses, the mean of each voxel",
    ),
    "room": (_room, "a furnished room, noise 3 mm"),
    "hall": (
        lambda quick: (
            make_room(30_000, layout=_PIECE, seed=1)
            if quick
            else make_room(300_000, layout=HALL_LAYOUT, seed=1)
        ),
        "another hallway, half as dense, noise 3 mm",
    ),
    "exact": (lambda quick: _room(quick, noise=0.0), "a furnished room without noise"),
    "quantised": (
        lambda quick: _depth_room(quick, lambda depth: (100 * depth).round() / 100),
        "one depth frame without noise, in whole centimeters",
    ),
    "stepped": (
        lambda quick: _depth_room(
            quick, lambda depth: _DISPARITY_SCALE / (_DISPARITY_SCALE / depth).round()
        ),
        "one depth frame without noise, its disparity in eighths of a pixel",
    ),
    "frames": (
        lambda quick: (
            make_kinect_room(30_000, num_frames=4) if quick else make_kinect_room(250_000)
        ),
        "an office from 16 depth frames of a first Kinect, noise and steps, not averaged",
    ),
    "thinned": (
        lambda quick: on_voxels(_room(quick, multiple=5), _VOXEL),
        "a furnished room, noise 3 mm, one point of each voxel of 3 cm",
    ),
    "curved": (
        lambda quick: make_room(40_000 if quick else 250_000, layout=CURVED_LAYOUT),
        "a small room with columns, balls, a lamp, a round table, two bent walls, noise 3 mm",
    ),
}
"""Function that generates each cloud, small in a quick run, and its description."""


@dataclass(frozen=True)
class Run:
    """One call of the script.

    Args:
        folder: Output folder.
        quick: Whether to use small clouds.
        paths: Files of the paper's own clouds, by key.
        estimator: Another estimator of normals, ``module:function``, evaluated like the others.
    """

    folder: Folder
    quick: bool
    paths: Mapping[str, Path | None] = field(default_factory=dict)
    estimator: str | None = None
    _clouds: dict[str, "LoadedCloud"] = field(default_factory=dict)
    _warm: set[str] = field(default_factory=set)

    def cloud(self, key: str) -> "LoadedCloud":
        """Return a cloud, loaded once."""
        if key not in self._clouds:
            # The neighbors of a million points are large: keep only one cloud's.
            for other in self._clouds.values():
                other.forget()
            cloud = load_cloud(key, self.paths.get(key), quick=self.quick)
            self._clouds[key] = LoadedCloud(cloud)
        return self._clouds[key]

    def warm_up(self, method: str) -> None:
        """Segment a small cloud first, so that no run time includes the loading of code."""
        if method not in self._warm:
            segment_planes(make_room(_WARM_UP).points, load_config(method))
            self._warm.add(method)


@dataclass(frozen=True)
class LoadedCloud:
    """A cloud, with its neighbors and normals computed on demand."""

    cloud: EvalCloud
    _fits: dict[NormalsConfig, NormalFit] = field(default_factory=dict)

    @cached_property
    def neighbors(self) -> Neighbors:
        """Neighbors used by all methods."""
        return search_knn(self.cloud.points, load_config().normals.k)

    @cached_property
    def at_edges(self) -> Tensor:
        """Points near an edge of the true surfaces, shape ``(N,)``."""
        return find_edges(self.cloud.labels, self.neighbors)

    def fit(self, settings: NormalsConfig) -> NormalFit:
        """Return normals, and keep only the last ones."""
        if settings not in self._fits:
            self._fits.clear()
            self._fits[settings] = estimate_normals(
                self.cloud.points, config=settings, neighbors=self.neighbors
            )
        return self._fits[settings]

    def forget(self) -> None:
        """Free large values that can be computed again."""
        self.__dict__.pop("neighbors", None)
        self._fits.clear()


def find_edges(truth: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the points of a surface with a neighbor on another surface, shape ``(N,)``."""
    crossed = [
        ((truth[some.long()] != own[:, None]) & (truth[some.long()] != UNLABELED)).any(dim=1)
        for some, own in zip(neighbors.indices.split(_CHUNK), truth.split(_CHUNK), strict=True)
    ]
    return torch.cat(crossed) & (truth != UNLABELED)
