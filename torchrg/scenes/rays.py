"""Rays from one place, cast exactly onto a scene."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.scenes.frames import Array, dot, unit
from torchrg.scenes.scene import SceneModel
from torchrg.structures import UNLABELED

_TILE = 32  # rays on a side of the blocks that are tested against a face as one
_MARGIN = 1e-3  # added to the angle of a block, radians


class Hits(NamedTuple):
    """Where rays first meet a scene.

    Attributes:
        distances: In lengths of the directions, shape ``(H, W)``; infinite where never.
        faces: The faces met, shape ``(H, W)``; ``UNLABELED`` where none.
    """

    distances: Array
    faces: NDArray[np.int64]


def cast_rays(model: SceneModel, origin: Array, directions: Array) -> Hits:
    """Return where rays from one place first meet a scene.

    Args:
        model: The scene.
        origin: Where the rays start, shape ``(3,)``.
        directions: A grid of rays, of any length, shape ``(H, W, 3)``. Neighbours should be
            similar: whole blocks of rays skip the faces they cannot meet.

    Returns:
        Distance and face of each ray.

    Example:
        >>> from torchrg.scenes import build_room
        >>> down = np.array([[[0.0, 0, -1]]])
        >>> hits = cast_rays(build_room(), np.array([0.5, 0.5, 1.25]), down)
        >>> hits.distances.tolist(), hits.faces.tolist()
        ([[1.25]], [[0]])
    """
    height, width, _ = directions.shape
    tile_of = _tiles(height, width)
    order = np.argsort(tile_of, kind="stable")
    tiles, steps = tile_of[order], directions.reshape(-1, 3)[order]
    cones = _cones(tiles, steps)
    distances, faces = np.full(len(steps), np.inf), np.full(len(steps), UNLABELED)
    with np.errstate(divide="ignore", invalid="ignore"):
        for face, surface in enumerate(model.surfaces):
            rows = np.flatnonzero(_may_meet(cones, surface.bounds - origin)[tiles])
            found = surface.intersect(origin[None], steps[rows])
            nearer = found < distances[rows]
            distances[rows[nearer]], faces[rows[nearer]] = found[nearer], face
    back = np.argsort(order, kind="stable")
    return Hits(distances[back].reshape(height, width), faces[back].reshape(height, width))


def _tiles(height: int, width: int) -> NDArray[np.int64]:
    """Return the block of each ray of a grid, shape ``(H * W,)``."""
    rows, columns = np.arange(height) // _TILE, np.arange(width) // _TILE
    tiles: NDArray[np.int64] = rows[:, None] * (columns[-1] + 1) + columns
    return tiles.ravel()


def _cones(tiles: NDArray[np.int64], steps: Array) -> tuple[Array, Array]:
    """Return axis ``(T, 3)`` and half angle ``(T,)`` of a cone around each block of rays."""
    starts = np.flatnonzero(np.diff(tiles, prepend=-1))
    towards = unit(steps)
    sums = np.add.reduceat(towards, starts)
    # Opposite rays add up to nothing: then any axis will do, with a half angle as wide as it takes.
    axes = unit(np.where(dot(sums, sums)[:, None] > 0, sums, towards[starts]))
    cosines = np.minimum.reduceat(dot(towards, axes[tiles]), starts)
    return axes, np.arccos(np.clip(cosines, -1, 1)) + _MARGIN


def _may_meet(cones: tuple[Array, Array], bounds: Array) -> NDArray[np.bool_]:
    """Return which cones touch the ball around a box, given relative to their tip."""
    axes, half_angles = cones
    middle, radius = bounds.mean(axis=0), np.sqrt(((bounds[1] - bounds[0]) ** 2).sum()) / 2
    distance = np.sqrt(dot(middle, middle))
    if distance <= radius:
        return np.ones(len(axes), dtype=bool)
    angles = np.arccos(np.clip(dot(axes, middle) / distance, -1, 1))
    touched: NDArray[np.bool_] = angles <= half_angles + np.arcsin(radius / distance)
    return touched
