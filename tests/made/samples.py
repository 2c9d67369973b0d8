"""Other samples of scenes: voxels, pieces of unlike density, triangles, depth in steps."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tests.made.cameras import cameras_around, fuse_frames, render_depth
from tests.made.scanners import ScannedModel
from torchrg.neighbors import sample_voxels, search_knn
from torchrg.scenes import Scene
from torchrg.structures import UNLABELED

OUTLIERS = ("cluster", "shell", "far")
"""Kinds: a compact cluster next to the plane, a shell around the point, and a cluster far away."""
_PATCH_SIZE = 50
"""Points of a neighbourhood."""


def take_rows(scene: Scene, rows: Tensor) -> Scene:
    """Return some points of a scene."""
    points, labels, normals = (values[rows] for values in scene[:3])
    return scene._replace(points=points, labels=labels, normals=normals)


def on_voxels(scene: Scene, size: float) -> Scene:
    """Return one point of each voxel of a side, in meters."""
    return take_rows(scene, sample_voxels(scene.points, size).rows)


def in_pieces(scene: Scene, num_points: int, *, num_pieces: int = 40, seed: int = 12) -> Scene:
    """Return a scene cut into boxes that keep equally many points each, as S3DIS is put together.

    Example:
        >>> from torchrg.scenes import make_room
        >>> len(in_pieces(make_room(4000), 400).points)
        400
    """
    rng = np.random.default_rng(seed)
    places, pieces = scene.points.numpy(), [np.arange(len(scene.points))]
    while len(pieces) < num_pieces:
        longest = int(np.argmax([np.ptp(places[rows], axis=0).max() for rows in pieces]))
        rows = pieces.pop(longest)
        column = places[rows, int(np.argmax(np.ptp(places[rows], axis=0)))]
        below = column <= column.min() + np.ptp(column) * rng.uniform(0.25, 0.75)
        pieces += [rows[below], rows[~below]]
    fraction = num_points // num_pieces
    kept = np.concatenate([rng.permutation(rows)[:fraction] for rows in pieces])
    return take_rows(scene, torch.from_numpy(kept))


def drawn_from_triangles(scene: Scene, num_points: int, *, seed: int = 0) -> Scene:
    """Return points drawn from triangles between near points, as S3DIS is drawn from meshes.

    A triangle is a point and two of its six neighbors; a point of it belongs to the face of the
    nearest corner.
    """
    rng, num_neighbors = np.random.default_rng(seed), 6
    near = search_knn(scene.points, 1 + num_neighbors).indices.numpy()
    starts = rng.integers(0, len(near), num_points)
    others = rng.permuted(np.tile(np.arange(1, 1 + num_neighbors), (num_points, 1)), axis=1)[:, :2]
    corners = np.column_stack([starts, np.take_along_axis(near[starts], others, axis=1)])
    fractions = rng.dirichlet((1, 1, 1), num_points)
    places = np.einsum("nc,ncx->nx", fractions, scene.points.numpy()[corners].astype(np.float64))
    nearest = corners[np.arange(num_points), fractions.argmax(axis=1)]
    drawn = take_rows(scene, torch.from_numpy(nearest))
    return drawn._replace(points=torch.from_numpy(places.astype(np.float32)))


def quantised_frame(
    model: ScannedModel, quantise: Callable[[Tensor], Tensor], num_points: int
) -> Scene:
    """Return points of one depth frame without noise, whose depth goes through a function."""
    frame = render_depth(model, cameras_around(model, 1)[0])
    depth = quantise(frame.depth).where(frame.depth > 0, 0)
    return fuse_frames(model, [frame._replace(depth=depth)], num_points)


def objects_of(scene: Scene) -> Tensor:
    """Return the object of each point, shape ``(N,)``, -1 for none."""
    return torch.cat([scene.objects, torch.tensor([UNLABELED])])[scene.labels]


def contaminated(
    kind: str, fraction: float, rng: torch.Generator, count: int = 30
) -> tuple[Tensor, Tensor]:
    """Return noisy planes turned at random, a share of the points outliers, and their normals.

    Example:
        >>> patches, normals = contaminated("shell", 0.1, torch.Generator(), count=3)
        >>> patches.shape, normals.shape
        (torch.Size([3, 50, 3]), torch.Size([3, 3]))
    """
    patches = torch.rand(count, _PATCH_SIZE, 3, generator=rng) - 0.5
    patches[..., 2] = 0.01 * torch.randn(count, _PATCH_SIZE, generator=rng)
    number = round(fraction * _PATCH_SIZE)
    scatter = torch.randn(count, number, 3, generator=rng)
    patches[:, :number] = {
        "cluster": torch.tensor([0.2, 0.1, 0.4]) + 0.05 * scatter,
        "shell": 0.5 * scatter / scatter.norm(dim=-1, keepdim=True),
        "far": torch.tensor([5.0, 5.0, 10.0]) + scatter,
    }[kind]
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=rng)).Q
    return patches @ turn, turn[:, 2]
