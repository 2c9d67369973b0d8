"""Clouds sampled from a scene: spread, noise, outliers, order."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import ConfigError
from torchrg.scenes.geometry import Array, Floats
from torchrg.scenes.scene import Scene, SceneModel, label_points, seeded_generator
from torchrg.structures import UNLABELED

NoiseDirection = Literal["normal", "isotropic", "ray"]
Density = Literal["uniform", "falloff"]
Order = Literal["random", "face"]

PLACES, NOISE, COLORS = range(3)
"""What random numbers are drawn for: the same places whatever the noise, and so on."""

_NEAR = 1.0
"""Density stops growing nearer to the scanner than this, metres."""

_SPARE = 1.02
"""How many more points are tried than are expected to be needed: fewer repetitions."""


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
    objects hide from the scanner is sampled as well.

    Convention:
        The same seed gives the same places on the surface whatever the noise, so the noise of a
        cloud is its difference to the cloud with ``noise=0``.

    Args:
        model: The scene.
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres.
        seed: Two calls with equal arguments give equal clouds; on another processor sines of
            slanted and curved parts may differ in the last bit.
        noise_direction: ``"normal"``: along the normal of the face. ``"isotropic"``: the same in
            every direction. ``"ray"``: along the line to the nearest viewpoint of the scene.
        density: ``"uniform"``; ``"falloff"``: proportional to 1/r^2 with r the distance to the
            nearest viewpoint of the scene, and even within a metre of it.
        outlier_fraction: Share of points spread over the box around the scene instead, which
            belong to no face.
        order: ``"random"``; ``"face"``: one face after the other, outliers last.
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
    rng = seeded_generator(seed, PLACES)
    num_outliers = round(num_points * outlier_fraction)
    points, normals, labels = _draw_places(model, num_points - num_outliers, density, rng)
    if noise > 0:
        shifts = _unit_noise(model, points, normals, noise_direction, seeded_generator(seed, NOISE))
        points += np.float32(noise) * shifts
    if num_outliers:
        low, high = model.bounds
        stray = low + rng.random((num_outliers, 3)) * (high - low)
        points = np.concatenate([points, to_float32(stray)])
        normals = np.concatenate([normals, np.zeros((num_outliers, 3), dtype=np.float32)])
        labels = np.concatenate([labels, np.full(num_outliers, UNLABELED)])
    if order == "random":
        rows = rng.permutation(num_points)
    else:
        rows = np.argsort(np.where(labels == UNLABELED, labels.max() + 1, labels), kind="stable")
    points, normals, labels = points[rows], normals[rows], labels[rows]
    shades = _colors(model, labels, seeded_generator(seed, COLORS)) if colors else None
    return label_points(model, points, labels, normals, shades)


def _draw_places(
    model: SceneModel, num_points: int, density: Density, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return points, normals and faces of exactly ``num_points`` places, face after face."""
    areas = np.array([surface.area for surface in model.surfaces])
    drawn: list[tuple[Floats, Floats, NDArray[np.int64]]] = []
    missing, share_kept = num_points, 1.0
    while missing > 0:
        num_tried = int(missing / share_kept * _SPARE) + 16
        num_kept = 0
        for face, count in enumerate(rng.multinomial(num_tried, areas / areas.sum())):
            tried = model.surfaces[face].sample(rng, int(count))
            outwards = model.surfaces[face].normals_at(tried)
            kept = model.is_visible(face, tried, outwards)
            if density == "falloff":
                nearest = np.maximum(_to_viewpoint(model, tried)[1], _NEAR)
                kept &= rng.random(len(tried)) * (nearest * nearest) < _NEAR * _NEAR
            points, normals = to_float32(tried[kept]), to_float32(outwards[kept])
            drawn.append((points, normals, np.full(len(points), face)))
            num_kept += len(points)
        missing -= num_kept
        share_kept = max(num_kept, 1) / num_tried
    points, normals, labels = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    # A random subset: to keep the first would leave the last faces short of points.
    chosen = np.sort(rng.permutation(len(labels))[:num_points])
    return points[chosen], normals[chosen], labels[chosen]


def _unit_noise(
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
    return lengths * (
        normals if direction == "normal" else to_float32(_to_viewpoint(model, points)[0])
    )


def _to_viewpoint(model: SceneModel, points: Floats | Array) -> tuple[Array, Array]:
    """Return unit vectors to the nearest viewpoint, shape ``(N, 3)``, and its distances."""
    lines = np.full(points.shape, np.inf)
    distances = np.full(len(points), np.inf)
    for viewpoint in model.viewpoints:
        others = viewpoint - points
        lengths = np.sqrt(np.vecdot(others, others))
        nearer = lengths < distances
        lines[nearer], distances[nearer] = others[nearer], lengths[nearer]
    return lines / distances[:, None], distances


def _colors(
    model: SceneModel, labels: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return a colour for each point: that of its object or of no object, a little uneven."""
    palette = rng.integers(60, 230, size=(len(model.parts) + 1, 3))
    objects = np.append(model.objects, len(model.parts))[labels]
    shades: NDArray[np.int64] = palette[objects] + rng.integers(-12, 13, size=(len(labels), 1))
    return shades.astype(np.uint8)


def to_float32(values: Array) -> Floats:
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
