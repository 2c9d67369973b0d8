"""Where rays meet a scene, and what a laser scanner sees of it."""

from functools import singledispatch
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.made.curved import Cone, Ring
from tests.made.scanners import ScannedModel
from torchrg.scenes import Scene, SceneModel
from torchrg.scenes.geometry import Doubles, unit
from torchrg.scenes.scene import label_points
from torchrg.scenes.surfaces import Flat, Surface
from torchrg.structures import UNLABELED

_PLACES, _NOISE = range(2)
"""What random numbers are drawn for: the same places whatever the noise."""

_FLAT_SLACK = 1e-9
"""Rays through the seam of two faces must not slip between them; meters."""
_SLACK = 1e-9
"""The same for curved faces, relative."""

_TILE = 32
"""Rays on a side of the blocks that are tested against a face as one."""
_MARGIN = 1e-3
"""Added to the angle of a block, radians."""

_LOWEST, _HIGHEST = -65.0, 90.0
"""Elevations of a scan, degrees: a tripod hides what is below."""
_MORE = 1.02
"""How many more rays are cast than are expected to be needed."""


class Hits(NamedTuple):
    """Where rays first meet a scene.

    Attributes:
        distances: In lengths of the directions, shape ``(H, W)``; infinite where never.
        faces: The faces met, shape ``(H, W)``; ``UNLABELED`` where none.
    """

    distances: Doubles
    faces: NDArray[np.int64]


def cast_rays(model: SceneModel, origin: Doubles, directions: Doubles) -> Hits:
    """Return where rays from one place first meet a scene.

    Args:
        model: The scene.
        origin: Where the rays start, shape ``(3,)``.
        directions: A grid of rays, of any length, shape ``(H, W, 3)``. Neighbors should be
            similar: whole blocks of rays skip the faces they cannot meet.

    Example:
        >>> from torchrg.scenes import build_room
        >>> down = np.array([[[0.0, 0, -1]]])
        >>> hits = cast_rays(build_room(), np.array([0.5, 0.5, 1.25]), down)
        >>> hits.distances.tolist(), hits.faces.tolist()
        ([[1.25]], [[0]])
    """
    height, width, _ = directions.shape
    rows, columns = np.arange(height) // _TILE, np.arange(width) // _TILE
    tile_of = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    order = np.argsort(tile_of, kind="stable")
    tiles, steps = tile_of[order], directions.reshape(-1, 3)[order]
    cones = _cones(tiles, steps)
    distances, faces = np.full(len(steps), np.inf), np.full(len(steps), UNLABELED)
    with np.errstate(divide="ignore", invalid="ignore"):
        for face, surface in enumerate(model.surfaces):
            rows = np.flatnonzero(_may_meet(cones, surface.bounds - origin)[tiles])
            found = intersect(surface, origin[None], steps[rows])
            nearer = found < distances[rows]
            distances[rows[nearer]], faces[rows[nearer]] = found[nearer], face
    back = np.argsort(order, kind="stable")
    return Hits(distances[back].reshape(height, width), faces[back].reshape(height, width))


def _cones(tiles: NDArray[np.int64], steps: Doubles) -> tuple[Doubles, Doubles]:
    """Return axis ``(T, 3)`` and half angle ``(T,)`` of a cone around each block of rays."""
    starts = np.flatnonzero(np.diff(tiles, prepend=-1))
    towards = unit(steps)
    sums = np.add.reduceat(towards, starts)
    # Opposite rays add up to nothing: then any axis will do, with a half angle as wide as it takes.
    axes = unit(np.where(np.vecdot(sums, sums)[:, None] > 0, sums, towards[starts]))
    cosines = np.minimum.reduceat(np.vecdot(towards, axes[tiles]), starts)
    return axes, np.arccos(np.clip(cosines, -1, 1)) + _MARGIN


def _may_meet(cones: tuple[Doubles, Doubles], bounds: Doubles) -> NDArray[np.bool_]:
    """Return which cones touch the ball around a box, given relative to their tip."""
    axes, half_angles = cones
    middle, radius = bounds.mean(axis=0), np.linalg.norm(bounds[1] - bounds[0]) / 2
    distance = np.linalg.norm(middle)
    if distance <= radius:
        return np.ones(len(axes), dtype=bool)
    angles = np.arccos(np.clip(np.vecdot(axes, middle) / distance, -1, 1))
    return angles <= half_angles + np.arcsin(radius / distance)


def scan_scene(model: ScannedModel, num_points: int, *, noise: float = 0.0, seed: int = 0) -> Scene:
    """Return what a laser scanner at each viewpoint sees, in equal steps of azimuth and elevation.

    Each viewpoint has the same number of points, up to one; a few of the rays are dropped at random
    to meet it. The cloud is in the order of viewpoint, azimuth, elevation, its noise along the
    normals.
    """
    rng = np.random.default_rng([seed, _PLACES])
    fractions = np.diff(np.arange(len(model.viewpoints) + 1) * num_points // len(model.viewpoints))
    scans = [
        _scan(model, viewpoint, int(fraction), rng)
        for viewpoint, fraction in zip(model.viewpoints, fractions, strict=True)
    ]
    places, labels = (np.concatenate(parts) for parts in zip(*scans, strict=True))
    outwards = np.empty_like(places)
    for face, surface in enumerate(model.surfaces):
        rows = np.flatnonzero(labels == face)
        outwards[rows] = surface.normals_at(places[rows])
    points, normals = places.astype(np.float32), outwards.astype(np.float32)
    if noise > 0:
        shake = np.random.default_rng([seed, _NOISE]).standard_normal(
            (num_points, 1), dtype=np.float32
        )
        points += np.float32(noise) * (shake * normals)
    return label_points(model, points, labels, normals)


def _scan(
    model: SceneModel, viewpoint: Doubles, num_points: int, rng: np.random.Generator
) -> tuple[Doubles, NDArray[np.int64]]:
    """Return exactly ``num_points`` points and faces seen from one place."""
    num_rays = num_points
    while True:
        directions = _angular_grid(num_rays, 2 * np.pi * rng.random())
        hits = cast_rays(model, viewpoint, directions)
        met = np.flatnonzero(hits.faces != UNLABELED)
        if len(met) >= num_points:
            break
        num_rays = int(num_rays * num_points / len(met) * _MORE) + 1
    kept = met[np.sort(rng.permutation(len(met))[:num_points])]
    steps = directions.reshape(-1, 3)[kept]
    return viewpoint + hits.distances.ravel()[kept, None] * steps, hits.faces.ravel()[kept]


def _angular_grid(num_rays: int, first_azimuth: float) -> Doubles:
    """Return at least ``num_rays`` directions in equal steps, shape ``(columns, rows, 3)``."""
    span = _HIGHEST - _LOWEST
    rows = int(np.ceil(np.sqrt(num_rays * span / 360)))
    columns = int(np.ceil(num_rays / rows))
    elevation = np.deg2rad(_LOWEST + span * (np.arange(rows) + 0.5) / rows)
    azimuth = (first_azimuth + 2 * np.pi * np.arange(columns) / columns)[:, None]
    level = np.cos(elevation)
    sides = (np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation))
    return np.stack(np.broadcast_arrays(*sides), axis=-1)


@singledispatch
def intersect(surface: Surface, origins: Doubles, directions: Doubles) -> Doubles:
    """Return how far along each ray a surface is first met, shape ``(N,)``; infinite where never.

    ``origins`` have shape ``(N, 3)`` or ``(1, 3)``, ``directions`` ``(N, 3)``; distances are in
    lengths of the directions, and only positive ones count. Tori are not met.
    """
    raise NotImplementedError(type(surface))


@intersect.register
def _meet_flat(surface: Flat, origins: Doubles, directions: Doubles) -> Doubles:
    start = surface.frame.to_local(origins)
    step = surface.frame.vectors_to_local(directions)
    distance = -start[:, 2] / np.where(step[:, 2] == 0, np.nan, step[:, 2])
    x, y = start[:, 0] + distance * step[:, 0], start[:, 1] + distance * step[:, 1]
    hit = np.zeros(len(distance), dtype=bool)
    for corner, edge, other in surface.cells:
        u, v = x - corner[0], y - corner[1]
        cross = edge[0] * other[1] - edge[1] * other[0]
        a, b = (u * other[1] - v * other[0]) / cross, (v * edge[0] - u * edge[1]) / cross
        slack = _FLAT_SLACK / np.sqrt(np.abs(cross))
        hit |= (np.minimum(a, b) >= -slack) & (np.maximum(a, b) <= 1 + slack)
    return np.where(hit & (distance > 0), distance, np.inf)


@intersect.register
def _meet_cone(surface: Cone, origins: Doubles, directions: Doubles) -> Doubles:
    start = surface.frame.to_local(origins)
    step = surface.frame.vectors_to_local(directions)
    (r0, z0), (r1, z1) = surface.start, surface.end
    planar = surface.plane is not None
    if planar:
        crossings = [(z0 - start[:, 2]) / np.where(step[:, 2] == 0, np.nan, step[:, 2])]
    else:
        # On the cone the radius is r0 + slope (z - z0).
        slope = (r1 - r0) / (z1 - z0)
        radius, rise = r0 + slope * (start[:, 2] - z0), slope * step[:, 2]
        a = step[:, 0] ** 2 + step[:, 1] ** 2 - rise**2
        b = start[:, 0] * step[:, 0] + start[:, 1] * step[:, 1] - radius * rise
        c = start[:, 0] ** 2 + start[:, 1] ** 2 - radius**2
        crossings = solve_quadratic(a, b, c)
    nearest = np.full(len(step), np.inf)
    for distance in crossings:
        x, y, z = (start + distance[:, None] * step).T
        along = (np.hypot(x, y) - r0) / (r1 - r0) if planar else (z - z0) / (z1 - z0)
        hit = (along >= -_SLACK) & (along <= 1 + _SLACK) & _is_within(x, y, surface.sector)
        nearest = np.where(hit & (distance > 0), np.fmin(nearest, distance), nearest)
    return nearest


@intersect.register
def _meet_ring(surface: Ring, origins: Doubles, directions: Doubles) -> Doubles:
    start = surface.frame.to_local(origins)
    step = surface.frame.vectors_to_local(directions)
    b, c = np.vecdot(start, step), np.vecdot(start, start) - surface.radius**2
    crossings = solve_quadratic(np.vecdot(step, step), b, c)
    nearest = np.full(len(step), np.inf)
    for distance in crossings:
        x, y, z = (start + distance[:, None] * step).T
        on_arc = _is_within(np.hypot(x, y), z, surface.arc) & _is_within(x, y, surface.sector)
        nearest = np.where(on_arc & (distance > 0), np.fmin(nearest, distance), nearest)
    return nearest


def solve_quadratic(a: Doubles, b: Doubles, c: Doubles) -> list[Doubles]:
    """Return both solutions of ``a t^2 + 2 b t + c = 0``, shape ``(N,)`` each; NaN for none.

    Example:
        >>> [float(t[0]) for t in solve_quadratic(*np.array([[1.0], [-3], [5]]))]
        [5.0, 1.0]
    """
    discriminant = b * b - a * c
    root = np.sqrt(np.where(discriminant >= 0, discriminant, np.nan))
    far = -(b + np.where(b < 0, -root, root))
    with np.errstate(divide="ignore", invalid="ignore"):
        return [far / a, c / far]


def _is_within(x: Doubles, y: Doubles, angles: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which directions are in a range of angles, both ends included."""
    beyond = np.mod(np.arctan2(y, x) - angles[0] + _SLACK, 2 * np.pi)
    return beyond <= angles[1] - angles[0] + 2 * _SLACK
