"""Clouds sampled from a scene: spread, noise, outliers, order."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import ConfigError
from torchrg.scenes.frames import Array, Floats, dot
from torchrg.scenes.labeling import label_points
from torchrg.scenes.scans import scan_places
from torchrg.scenes.scene import Scene, SceneModel
from torchrg.scenes.streams import random_stream
from torchrg.structures import UNLABELED

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
