"""Terrestrial laser scans: rays on an angular grid from each viewpoint."""

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Array, cos_sin
from torchrg.scenes.rays import cast_rays
from torchrg.scenes.scene import SceneModel
from torchrg.structures import UNLABELED

_LOWEST, _HIGHEST = -65.0, 90.0  # elevations, degrees: a tripod hides what is below
_MORE = 1.02


def scan_places(
    model: SceneModel, num_points: int, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return what a scanner sees from the viewpoints of a scene, column by column.

    Args:
        model: The scene.
        num_points: Number of points, the same for each viewpoint up to one; a few of the rays are
            dropped at random to meet it.
        rng: Source of the first azimuth and of what is dropped.

    Returns:
        Points ``(N, 3)``, normals ``(N, 3)`` towards free space and faces ``(N,)``, in the order
        of viewpoint, azimuth, elevation.

    Raises:
        ConfigError: If nothing can be seen.
    """
    stations = len(model.viewpoints)
    shares = np.diff(np.arange(stations + 1) * num_points // stations)
    scans = [
        _scan(model, viewpoint, int(share), rng)
        for viewpoint, share in zip(model.viewpoints, shares, strict=True)
    ]
    points = np.concatenate([places for places, _ in scans])
    faces = np.concatenate([labels for _, labels in scans])
    normals = np.empty_like(points)
    for face, surface in enumerate(model.surfaces):
        rows = np.flatnonzero(faces == face)
        normals[rows] = surface.normals_at(points[rows])
    return points, normals, faces


def _scan(
    model: SceneModel, viewpoint: Array, num_points: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Return exactly ``num_points`` points and faces seen from one place."""
    num_rays = num_points
    while True:
        directions = _angular_grid(num_rays, 2 * np.pi * rng.random())
        hits = cast_rays(model, viewpoint, directions)
        met = np.flatnonzero(hits.faces != UNLABELED)
        if len(met) >= num_points:
            break
        if len(met) == 0 and num_rays > 10_000:
            raise ConfigError("sample_scene: expected a scene around its viewpoints, got no hit.")
        num_rays = int(num_rays * min(num_points / max(len(met), 1) * _MORE, 100)) + 1
    kept = met[np.sort(rng.permutation(len(met))[:num_points])]
    steps = directions.reshape(-1, 3)[kept]
    return viewpoint + hits.distances.ravel()[kept, None] * steps, hits.faces.ravel()[kept]


def _angular_grid(num_rays: int, first_azimuth: float) -> Array:
    """Return at least ``num_rays`` directions in equal steps, shape ``(columns, rows, 3)``."""
    span = _HIGHEST - _LOWEST
    rows = int(np.ceil(np.sqrt(num_rays * span / 360)))
    columns = int(np.ceil(num_rays / rows))
    elevations = (_LOWEST + span * (np.arange(rows) + 0.5) / rows) * (np.pi / 180)
    azimuths = first_azimuth + 2 * np.pi * np.arange(columns) / columns
    (level, up), (east, north) = cos_sin(elevations), cos_sin(azimuths)
    directions = np.empty((columns, rows, 3))
    directions[..., 0] = east[:, None] * level
    directions[..., 1] = north[:, None] * level
    directions[..., 2] = up
    return directions
