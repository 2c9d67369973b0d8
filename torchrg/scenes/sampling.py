"""Clouds sampled from a scene: spread, noise, outliers, order."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import ConfigError
from torchrg.scenes.geometry import Array, Floats, cos_sin, dot, unit
from torchrg.scenes.scene import Scene, SceneModel, label_points, random_stream
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


NoiseDirection = Literal["normal", "isotropic", "ray"]
Density = Literal["uniform", "falloff", "scan"]
Order = Literal["random", "face", "scan"]

_NEAR = 1.0  # density stops growing nearer to the scanner than this, metres


def sample_scene(
    model: SceneModel,
    num_points: int,
    *,
    noise: float = 0.0,
    seed: int = 0,
    noise_direction: NoiseDirection = "normal",
    density: Density = "uniform",
    outlier_fraction: float = 0.0,
    order: Order = "random",
    colors: bool = False,
) -> Scene:
    """Sample the visible surface of a scene.

    Each point is drawn independently and evenly from all of the surface that has free space in
    front of it, so the number of points of a face is proportional to its visible area. What other
    objects hide from the scanner is sampled as well, but for ``density="scan"``.

    Convention:
        The same seed gives the same places on the surface whatever the noise, so the noise of a
        cloud is its difference to the cloud with ``noise=0``.

    Args:
        model: The scene.
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres.
        seed: Two calls with equal arguments give equal clouds, on every platform.
        noise_direction: ``"normal"``: along the normal of the face. ``"isotropic"``: the same in
            every direction. ``"ray"``: along the line to the nearest viewpoint of the scene.
        density: ``"uniform"``; ``"falloff"``: proportional to 1/r^2 with r the distance to the
            nearest viewpoint of the scene, and even within a metre of it; ``"scan"``: what a laser
            scanner at each viewpoint sees, in equal steps of azimuth and elevation.
        outlier_fraction: Share of points spread over the box around the scene instead, which
            belong to no face.
        order: ``"random"``; ``"face"``: one face after the other, outliers last; ``"scan"``: as
            the scanner turns, outliers last, for ``density="scan"`` only.
        colors: Whether to colour the points by object.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If a setting is not allowed.

    Example:
        >>> from torchrg.scenes import build_room
        >>> sample_scene(build_room(seed=3), 1000, noise=0.002).points.shape
        torch.Size([1000, 3])
    """
    _check_settings(
        num_points,
        noise,
        outlier_fraction,
        noise_direction=(noise_direction, NoiseDirection),
        density=(density, Density),
        order=(order, Order),
    )
    if order == "scan" and density != "scan":
        raise ConfigError(
            f"sample_scene: expected density='scan' for order='scan', got {density!r}."
        )
    places, shake, paint = (random_stream(seed, number) for number in range(3))
    num_outliers = round(num_points * outlier_fraction)
    num_on_faces = num_points - num_outliers
    if density == "scan":
        seen, outwards, labels = scan_places(model, num_on_faces, places)
        points, normals = _float32(seen), _float32(outwards)
    else:
        points, normals, labels = _draw_places(model, num_on_faces, density, places)
    if noise > 0:
        points += np.float32(noise) * _displacements(model, points, normals, noise_direction, shake)
    if num_outliers:
        low, high = model.bounds
        stray = low + places.random((num_outliers, 3)) * (high - low)
        points = np.concatenate([points, stray.astype(np.float32)])
        normals = np.concatenate([normals, np.zeros((num_outliers, 3), dtype=np.float32)])
        labels = np.concatenate([labels, np.full(num_outliers, UNLABELED)])
    if order != "scan":
        rows = places.permutation(num_points) if order == "random" else _by_face(labels)
        points, normals, labels = points[rows], normals[rows], labels[rows]
    return label_points(model, points, labels, normals, paint if colors else None)


def _draw_places(
    model: SceneModel, num_points: int, density: Density, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return points, normals and faces of exactly ``num_points`` places, face after face."""
    areas = np.array([surface.area for surface in model.surfaces])
    drawn: list[tuple[Floats, Floats]] = []
    faces: list[NDArray[np.int64]] = []
    missing, share_kept = num_points, 1.0
    while missing > 0:
        num_tried = int(missing / share_kept * 1.02) + 16
        num_kept = 0
        for face, count in enumerate(rng.multinomial(num_tried, areas / areas.sum())):
            tried = model.surfaces[face].sample(rng, int(count))
            outwards = model.surfaces[face].normals_at(tried)
            kept = model.visible(face, tried, outwards)
            if density == "falloff":
                nearest = np.maximum(_to_viewpoint(model, tried)[1], _NEAR)
                kept &= rng.random(len(tried)) * (nearest * nearest) < _NEAR * _NEAR
            drawn.append((_float32(tried[kept]), _float32(outwards[kept])))
            faces.append(np.full(len(drawn[-1][0]), face))
            num_kept += len(drawn[-1][0])
        missing -= num_kept
        share_kept = max(num_kept, 1) / num_tried
    labels = np.concatenate(faces)
    # A random subset: to keep the first would leave the last faces short of points.
    chosen = np.sort(rng.permutation(len(labels))[:num_points])
    points = np.concatenate([rows for rows, _ in drawn])[chosen]
    normals = np.concatenate([rows for _, rows in drawn])[chosen]
    return points, normals, labels[chosen]


def _by_face(labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the order of points by face, outliers last."""
    return np.argsort(np.where(labels == UNLABELED, labels.max() + 1, labels), kind="stable")


def _displacements(
    model: SceneModel,
    points: Floats,
    normals: Floats,
    direction: NoiseDirection,
    rng: np.random.Generator,
) -> Floats:
    """Return displacements of unit standard deviation, shape ``(N, 3)``."""
    if direction == "isotropic":
        return rng.standard_normal(points.shape, dtype=np.float32)
    lengths = rng.standard_normal((len(points), 1), dtype=np.float32)
    along = normals if direction == "normal" else _float32(_to_viewpoint(model, points)[0])
    return lengths * along


def _to_viewpoint(model: SceneModel, points: Floats | Array) -> tuple[Array, Array]:
    """Return unit vectors to the nearest viewpoint, shape ``(N, 3)``, and its distances."""
    lines = model.viewpoints[0] - points
    distances = np.sqrt(dot(lines, lines))
    for viewpoint in model.viewpoints[1:]:
        others = viewpoint - points
        lengths = np.sqrt(dot(others, others))
        nearer = lengths < distances
        lines[nearer], distances[nearer] = others[nearer], lengths[nearer]
    return lines / distances[:, None], distances


def _float32(values: Array) -> Floats:
    """Return values rounded to float32, in rows of their own."""
    return np.ascontiguousarray(values, dtype=np.float32)


def _check_settings(
    num_points: int, noise: float, outlier_fraction: float, **choices: tuple[str, object]
) -> None:
    """Refuse settings out of range; ``choices`` are pairs of a value and its Literal type."""
    if num_points < 1:
        raise ConfigError(f"sample_scene: expected num_points >= 1, got {num_points}.")
    if not 0 <= noise < float("inf"):
        raise ConfigError(f"sample_scene: expected noise >= 0 metres, got {noise}.")
    if not 0 <= outlier_fraction < 1:
        raise ConfigError(
            f"sample_scene: expected outlier_fraction in [0, 1), got {outlier_fraction}."
        )
    for name, (value, allowed) in choices.items():
        if value not in get_args(allowed):
            options = ", ".join(get_args(allowed))
            raise ConfigError(
                f"sample_scene: expected {name} to be one of {options}, got {value!r}."
            )
