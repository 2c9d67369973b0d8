"""What a scene is made of, and clouds sampled from it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.scenes.geometry import Array, Floats
from torchrg.scenes.surfaces import Solid, Surface
from torchrg.structures import FARTHEST, MAX_POINTS

NoiseDirection = Literal["normal", "isotropic"]

PLACES, NOISE = range(2)
"""Purposes of the random numbers. Places are the same whatever the noise is."""
_CLEARANCE = 1e-7
"""Share of the size of a scene that must be free in front of a surface for it to be seen."""
_SPARE = 1.02
"""Points that are tried for each one that is expected to be needed, which saves repetitions."""


class Scene(NamedTuple):
    """A cloud with its exact truth.

    Attributes:
        points: Shape ``(N, 3)``, float32, metres.
        labels: Row of each point's face in the tables below, shape ``(N,)``, int64. Curved faces
            have labels too, see ``planar``.
        normals: Unit normals of the faces at the points before noise, towards free space, shape
            ``(N, 3)``, float32.
        planar: Whether each face lies in a plane, shape ``(M,)``, bool.
        face_normals: Normals of the planar faces, shape ``(M, 3)``, float64; zero for curved ones.
        face_offsets: Offsets of their planes, ``normal . x = offset``, shape ``(M,)``, float64.
        face_areas: Areas, covered parts included, shape ``(M,)``, float64.
        kinds: What each face is part of, as in ``"table edge"``, of length M.
        objects: Which object each face belongs to, shape ``(M,)``, int64.
    """

    points: Tensor
    labels: Tensor
    normals: Tensor
    planar: Tensor
    face_normals: Tensor
    face_offsets: Tensor
    face_areas: Tensor
    kinds: tuple[str, ...]
    objects: Tensor


@dataclass(frozen=True)
class Part:
    """An object: its visible surfaces, each a face, and the bodies that hide what is in them."""

    surfaces: tuple[Surface, ...]
    solids: tuple[Solid, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneModel:
    """The description of a scene, to be sampled or rendered.

    Args:
        parts: The objects; their surfaces, in order, are the faces.
        viewpoints: Places in free space where a scanner may stand, shape ``(V, 3)``, at least one.
    """

    parts: tuple[Part, ...]
    viewpoints: Array

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """The faces."""
        return tuple(surface for part in self.parts for surface in part.surfaces)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """Which part each face belongs to, shape ``(M,)``."""
        counts = [len(part.surfaces) for part in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def is_visible(self, face: int, points: Array, normals: Array) -> NDArray[np.bool_]:
        """Return at which points of a face there is free space in front of it, shape ``(N,)``."""
        low, high = self.surfaces[face].bounds + np.outer((-1, 1), np.full(3, self._clearance))
        near = [
            part
            for part in self.parts
            if any((b.bounds[0] <= high).all() and (b.bounds[1] >= low).all() for b in part.solids)
        ]
        return ~is_occupied(near, points + self._clearance * normals)

    @cached_property
    def _clearance(self) -> float:
        """Length by which what is in front of a face is told from what touches it."""
        lowest, highest = zip(*(surface.bounds for surface in self.surfaces), strict=True)
        return _CLEARANCE * float((np.max(highest, axis=0) - np.min(lowest, axis=0)).max())


def sample_scene(
    model: SceneModel,
    num_points: int,
    *,
    noise: float = 0.0,
    seed: int = 0,
    noise_direction: NoiseDirection = "normal",
) -> Scene:
    """Sample the visible surface of a scene.

    Each point is drawn independently and evenly from all of the surface that has free space in
    front of it, so the number of points of a face is proportional to its visible area. What other
    objects hide from a scanner is sampled as well.

    Args:
        model: The scene.
        num_points: Number of points.
        noise: Standard deviation of the noise, in metres: the difference to the cloud of the same
            seed with ``noise=0``.
        seed: Two calls with equal arguments give equal clouds; on another processor sines of
            slanted parts may differ in the last bit.
        noise_direction: ``"normal"``: along the normal of the face. ``"isotropic"``: the same in
            every direction.

    Returns:
        The cloud and its truth, in random order.

    Raises:
        ConfigError: If a setting is not allowed.

    Example:
        >>> from torchrg.scenes import build_room
        >>> sample_scene(build_room(seed=3), 1000, noise=0.002).points.shape
        torch.Size([1000, 3])
    """
    if not 1 <= num_points <= MAX_POINTS:
        raise ConfigError(
            f"sample_scene: expected num_points from 1 to {MAX_POINTS:,}, got {num_points}."
        )
    if not 0 <= noise <= FARTHEST:
        raise ConfigError(
            f"sample_scene: expected noise from 0 to {FARTHEST:g} meters, got {noise}."
        )
    if noise_direction not in get_args(NoiseDirection):
        options = ", ".join(get_args(NoiseDirection))
        raise ConfigError(
            f"sample_scene: expected noise_direction to be one of {options}, got "
            f"{noise_direction!r}."
        )
    rng = seeded_generator(seed, PLACES)
    points, normals, labels = _draw_places(model, num_points, rng)
    if noise > 0:
        shake = seeded_generator(seed, NOISE)
        if noise_direction == "normal":
            shifts = shake.standard_normal((num_points, 1), dtype=np.float32) * normals
        else:
            shifts = shake.standard_normal((num_points, 3), dtype=np.float32)
        points += np.float32(noise) * shifts
    rows = rng.permutation(num_points)
    return label_points(model, points[rows], labels[rows], normals[rows])


def _draw_places(
    model: SceneModel, num_points: int, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return points, normals and faces of exactly ``num_points`` places, face after face."""
    areas = np.array([surface.area for surface in model.surfaces])
    drawn: list[tuple[Floats, Floats, NDArray[np.int64]]] = []
    missing, fraction_kept = num_points, 1.0
    while missing > 0:
        num_tried = int(missing / fraction_kept * _SPARE) + 16
        num_kept = 0
        for face, count in enumerate(rng.multinomial(num_tried, areas / areas.sum())):
            tried = model.surfaces[face].sample(rng, int(count))
            outwards = model.surfaces[face].normals_at(tried)
            is_seen = model.is_visible(face, tried, outwards)
            points, normals = to_float32(tried[is_seen]), to_float32(outwards[is_seen])
            drawn.append((points, normals, np.full(len(points), face)))
            num_kept += len(points)
        missing -= num_kept
        fraction_kept = max(num_kept, 1) / num_tried
    points, normals, labels = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    # A random subset: to keep the first would leave the last faces short of points.
    chosen = np.sort(rng.permutation(len(labels))[:num_points])
    return points[chosen], normals[chosen], labels[chosen]


def is_occupied(parts: Iterable[Part], points: Array) -> NDArray[np.bool_]:
    """Return which points of shape ``(N, 3)`` are inside a body."""
    inside = np.zeros(len(points), dtype=bool)
    for solid in (solid for part in parts for solid in part.solids):
        inside |= solid.contains(points)
    return inside


def plane_table(surfaces: Iterable[Surface]) -> tuple[Array, Array]:
    """Return normals ``(M, 3)`` and offsets ``(M,)`` of surfaces; zero for curved ones."""
    curved = (np.zeros(3), 0.0)
    planes = [curved if surface.plane is None else surface.plane for surface in surfaces]
    normals = np.array([normal for normal, _ in planes]).reshape(-1, 3)
    return normals, np.array([offset for _, offset in planes])


def label_points(
    model: SceneModel, points: Floats, labels: NDArray[np.int64], normals: Floats
) -> Scene:
    """Return points ``(N, 3)`` of known faces ``(N,)`` as a cloud with the tables of its scene."""
    face_normals, face_offsets = plane_table(model.surfaces)
    return Scene(
        points=torch.from_numpy(points),
        labels=torch.from_numpy(labels),
        normals=torch.from_numpy(normals),
        planar=torch.from_numpy(np.array([s.plane is not None for s in model.surfaces])),
        face_normals=torch.from_numpy(face_normals),
        face_offsets=torch.from_numpy(face_offsets),
        face_areas=torch.from_numpy(np.array([s.area for s in model.surfaces])),
        kinds=tuple(surface.kind for surface in model.surfaces),
        objects=torch.from_numpy(model.objects),
    )


def seeded_generator(seed: int, purpose: int) -> np.random.Generator:
    """Return one of several independent generators that belong to a seed, one for each purpose."""
    if seed < 0:
        raise ConfigError(f"torchrg.scenes: expected seed >= 0, got {seed}.")
    return np.random.Generator(np.random.PCG64([seed, purpose]))


def to_float32(values: Array) -> Floats:
    """Return values rounded to float32, in rows of their own."""
    return np.ascontiguousarray(values, dtype=np.float32)
