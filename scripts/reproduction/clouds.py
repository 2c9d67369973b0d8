"""The clouds: the paper's four, or made ones in their place, and others with known truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reproduction.paper_numbers import POINTS
from tests.made import (
    CURVED_LAYOUT,
    HALL_LAYOUT,
    KINECT_LAYOUT,
    make_kinect_room,
    make_mapped_room,
    make_storey,
    on_voxels,
    quantised_frame,
    scan_scene,
)
from torchrg.batch.records import hash_file
from torchrg.io import read_cloud
from torchrg.scenes import Scene, build_room, make_room
from torchrg.structures import UNLABELED

QUICK_POINTS = 30_000
"""Most points of a file in a quick run."""

SMALLEST = 50
"""Points of the smallest region that the paper draws, and of the smallest colour that is a face."""

SHELL = ("floor", "ceiling", "wall")
"""Faces that are objects of their own where objects are annotated, as in S3DIS."""

TITLES = {
    "tutorial": "region_growing_tutorial",
    "hallway": "hallway_2",
    "cory": "Cory_5th",
    "kinect": "Kinect v2 room",
}
"""The paper's names of its clouds."""

OTHERS = {"room": "a room", "hall": "a second hall"}
"""Clouds on which its claims are tried as well."""

HARD = {
    "exact": "exact planes",
    "quantised": "depth in centimetres",
    "stepped": "depth in steps of a Kinect",
    "frames": "raw frames of a Kinect",
    "thinned": "thinned to voxels",
    "curved": "curved surfaces",
}
"""Clouds unlike the paper's."""


class EvalCloud(NamedTuple):
    """A cloud to segment."""

    key: str  # a key of :data:`TITLES`, :data:`OTHERS` or :data:`HARD`
    name: str  # of its cells: another name for other points
    points: Tensor  # finite points, shape ``(N, 3)``
    labels: Tensor | None  # true faces, shape ``(N,)``, or None
    normals: Tensor | None  # true normals, shape ``(N, 3)``, or None
    origin: str  # what the cloud is, and how it differs from the paper's
    is_papers: bool = False  # whether it is the paper's own
    objects: Tensor | None = None  # true objects, shape ``(N,)``, or None
    curved: Tensor | None = None  # labels of the faces that are not planes, or None

    @property
    def title(self) -> str:
        """Its name in tables, with * where it stands in for the paper's."""
        stands_in = self.key in TITLES and not self.is_papers
        return f"{title_of(self.key)}*" if stands_in else title_of(self.key)


def title_of(key: str) -> str:
    """Return the name of a cloud in tables."""
    return {**TITLES, **OTHERS, **HARD}[key]


def load_cloud(key: str, path: Path | None, *, quick: bool) -> EvalCloud:
    """Read a cloud of the paper, or make one.

    Args:
        key: A key of :data:`TITLES`, :data:`OTHERS` or :data:`HARD`.
        path: The paper's cloud, if it is there.
        quick: Whether a small piece will do.

    Returns:
        The cloud. Of a file the finite points, in quick runs those nearest to its middle.
    """
    return _made_cloud(key, quick) if path is None else _read_cloud(key, path, quick)


def _made_cloud(key: str, quick: bool) -> EvalCloud:
    """Return a made cloud with exact truth."""
    make, what = MADE[key]
    scene = make(quick)
    return EvalCloud(
        key,
        f"{key}-made",
        scene.points,
        scene.labels,
        scene.normals,
        f"{len(scene.points):,} points, made with exact truth: {what}",
        objects=_objects(scene),
        curved=(~scene.planar).nonzero().squeeze(1),
    )


def _objects(scene: Scene) -> Tensor:
    """Return the object of each point, as people annotate them: a table is one, a wall is one."""
    is_shell = torch.tensor([kind in SHELL for kind in scene.kinds])
    num_objects = int(scene.objects.max()) + 1
    faces = torch.arange(len(is_shell)) + num_objects
    return torch.where(is_shell, faces, scene.objects)[scene.labels]


def _read_cloud(key: str, path: Path, quick: bool) -> EvalCloud:
    """Return a cloud of the paper."""
    cloud = read_cloud(path)
    kept = torch.from_numpy(cloud.finite).nonzero().squeeze(1)
    origin = f"{len(kept):,} points of {path.name}"
    if quick and len(kept) > QUICK_POINTS:
        points = cloud.points[kept]
        distances = (points - points.median(dim=0).values).square().sum(dim=1)
        kept = kept[distances.topk(QUICK_POINTS, largest=False).indices.sort().values]
        origin = f"{len(kept):,} points around the middle of {path.name}"
    fields = {name: values[kept.numpy()] for name, values in cloud.fields.items()}
    labels, normals = (
        torch.from_numpy(fields[field]) if field in fields else None
        for field in ("labels", "normals")
    )
    if key == "tutorial" and labels is None and "color" in fields:
        labels = faces_of_colors(fields["color"])
        origin += ", its colours taken for faces (somebody's segmentation, not a measured truth)"
    digest = hash_file(path)[:8]
    return EvalCloud(
        key, f"{key}-{digest}", cloud.points[kept], labels, normals, origin, is_papers=not quick
    )


def faces_of_colors(colors: NDArray[np.uint8]) -> Tensor:
    """Return a label for each colour, ``(N,)``; none for those of fewer than 50 points.

    The file of PCL's tutorial shows a segmentation: 124 colours of 50 points and more.
    """
    _, labels, counts = np.unique(colors, axis=0, return_inverse=True, return_counts=True)
    labels = labels.ravel()
    return torch.from_numpy(np.where(counts[labels] >= SMALLEST, labels, UNLABELED))


_SHORT_HALL = replace(HALL_LAYOUT, size=(10.0, 2.4, 2.7), num_doors=5, num_cabinets=1, num_panels=2)
_PIECE = replace(HALL_LAYOUT, size=(6.0, 2.4, 2.7), num_doors=2, num_cabinets=0, num_panels=1)
_NOISE = 0.003
"""Metres."""
_VOXEL = 0.03
"""Metres."""
_DISPARITY_SCALE = 525 * 0.075 * 8
"""Depth times this many eighths of a pixel, of a Kinect, in metres."""


def _laser_hall(quick: bool) -> Scene:
    """Return a hallway as a laser scanner sees it, in the place of the tutorial's."""
    layout, size = (_PIECE, 30_000) if quick else (_SHORT_HALL, POINTS["tutorial"])
    return scan_scene(build_room(2, layout=layout), size, noise=_NOISE)


def _depth_room(quick: bool, quantise: Callable[[Tensor], Tensor]) -> Scene:
    """Return a depth frame without noise, its depth replaced."""
    model = build_room(layout=KINECT_LAYOUT)
    return quantised_frame(model, quantise, 30_000 if quick else 250_000)


def _room(quick: bool, num_points: int = 1, noise: float = _NOISE) -> Scene:
    """Return a furnished room, with so many times the usual number of points."""
    if quick:
        return make_room(30_000 * num_points, noise, layout=KINECT_LAYOUT)
    return make_room(200_000 * num_points, noise)


MADE: dict[str, tuple[Callable[[bool], Scene], str]] = {
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
        "an office as mapped from frames of a Kinect v2 at known places, the mean of each voxel",
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
        "one depth frame without noise, in whole centimetres",
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
        lambda quick: on_voxels(_room(quick, num_points=5), _VOXEL),
        "a furnished room, noise 3 mm, one point of each voxel of 3 cm",
    ),
    "curved": (
        lambda quick: make_room(40_000 if quick else 250_000, layout=CURVED_LAYOUT),
        "a small room with columns, balls, a lamp, a round table, two bent walls, noise 3 mm",
    ),
}
"""What makes each cloud, given whether it may be small, and what it is."""
