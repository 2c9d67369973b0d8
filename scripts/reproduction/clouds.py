"""The four clouds of the paper, or made ones with known truth in their place."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from reproduction.paper_numbers import POINTS
from reproduction.scenes import HALL_LAYOUT, StoreyLayout, make_kinect_room, make_storey
from torchrg.io import read_cloud
from torchrg.scenes import Scene, make_room

QUICK_POINTS = 100_000
"""Most points of a file in a quick run."""

TITLES = {
    "tutorial": "region_growing_tutorial",
    "hallway": "hallway_2",
    "cory": "Cory_5th",
    "kinect": "Kinect v2 room",
}
"""The paper's names of its clouds."""


class EvalCloud(NamedTuple):
    """A cloud to segment.

    Attributes:
        key: A key of :data:`TITLES`.
        name: Of its cells: another name for other points.
        points: Finite points, shape ``(N, 3)``.
        labels: True faces, shape ``(N,)``, or None.
        normals: True normals, shape ``(N, 3)``, or None.
        colors: Shape ``(N, 3)``, uint8, or None.
        origin: What the cloud is, and how it differs from the paper's.
        is_papers: Whether it is the paper's own.
    """

    key: str
    name: str
    points: Tensor
    labels: Tensor | None
    normals: Tensor | None
    colors: Tensor | None
    origin: str
    is_papers: bool


def load_cloud(key: str, path: Path | None, *, quick: bool) -> EvalCloud:
    """Read a cloud of the paper, or make one in its place.

    Args:
        key: A key of :data:`TITLES`.
        path: The paper's cloud, if it is there.
        quick: Whether a small piece will do.

    Returns:
        The cloud. Of a file the finite points, in quick runs those nearest to its middle.
    """
    if path is None:
        scene, what = _made_scene(key, quick)
        origin = f"{len(scene.points):,} points, made with exact truth: {what}"
        return EvalCloud(
            key, f"{key}-made", scene.points, scene.labels, scene.normals, None, origin, False
        )
    cloud = read_cloud(path)
    kept = torch.from_numpy(cloud.finite).nonzero().squeeze(1)
    origin = f"{len(kept):,} points of {path.name}"
    if quick and len(kept) > QUICK_POINTS:
        points = cloud.points[kept]
        distances = (points - points.median(dim=0).values).square().sum(dim=1)
        kept = kept[distances.topk(QUICK_POINTS, largest=False).indices.sort().values]
        origin = f"{len(kept):,} points around the middle of {path.name}"
    labels, normals, colors = (
        torch.from_numpy(cloud.fields[field])[kept] if field in cloud.fields else None
        for field in ("labels", "normals", "color")
    )
    if key == "tutorial":
        colors = None  # Those of the file show somebody's segmentation, not the scene.
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()[:8]
    return EvalCloud(
        key, f"{key}-{digest}", cloud.points[kept], labels, normals, colors, origin, not quick
    )


def _made_scene(key: str, quick: bool) -> tuple[Scene, str]:
    """Return a made cloud and a few words about it."""
    make, what = (_QUICK if quick else _FULL)[key]
    return make(), what


_SHORT_HALL = replace(HALL_LAYOUT, size=(10.0, 2.4, 2.7), num_doors=5, num_cabinets=1, num_panels=2)
_PIECE = replace(HALL_LAYOUT, size=(6.0, 2.4, 2.7), num_doors=2, num_cabinets=0, num_panels=1)

_FULL: dict[str, tuple[Callable[[], Scene], str]] = {
    "tutorial": (
        lambda: make_room(POINTS["tutorial"], layout=_SHORT_HALL, seed=1),
        "a hallway of 10 m with five doors, noise 3 mm",
    ),
    "hallway": (
        lambda: make_room(POINTS["hallway"], layout=HALL_LAYOUT),
        "a hallway of 24 m with 14 doors, noise 3 mm",
    ),
    "cory": (
        lambda: make_storey(POINTS["cory"]),
        "a hallway and eight furnished rooms, noise 3 mm",
    ),
    "kinect": (
        lambda: make_kinect_room(POINTS["kinect"]),
        "an office from 16 simulated depth frames with the noise of a Kinect",
    ),
}
_QUICK: dict[str, tuple[Callable[[], Scene], str]] = {
    "tutorial": (
        lambda: make_room(60_000, layout=_PIECE, seed=1),
        "a hallway of 6 m, noise 3 mm",
    ),
    "hallway": (
        lambda: make_room(150_000, layout=_PIECE),
        "a hallway of 6 m with two doors, noise 3 mm",
    ),
    "cory": (
        lambda: make_storey(150_000, layout=StoreyLayout(rooms_per_side=2)),
        "a hallway and four furnished rooms, noise 3 mm",
    ),
    "kinect": (
        lambda: make_kinect_room(100_000, num_frames=8),
        "an office from eight simulated depth frames with the noise of a Kinect",
    ),
}
