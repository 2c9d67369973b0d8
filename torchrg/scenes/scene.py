"""Scene models, and point clouds sampled from them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import check_choices
from torchrg.errors import ConfigError
from torchrg.scenes.geometry import Doubles, Floats
from torchrg.scenes.surfaces import Solid, Surface
from torchrg.structures.points import FARTHEST, MAX_POINTS, short_repr

NoiseDirection = Literal["normal", "isotropic"]

POSITIONS, NOISE = range(2)
"""Purposes of the random numbers; positions do not depend on the noise."""
_CLEARANCE = 1e-7
"""Free space required in front of a visible surface, as a fraction of the scene size."""
_OVERSAMPLING = 1.02
"""Oversampling factor, which avoids repetitions."""


@short_repr
class Scene(NamedTuple):
    """A point cloud with exact ground truth.

    Attributes:
        points: Shape ``(N, 3)``, float32, in meters.
        labels: Face of each point as a row of the tables below, shape ``(N,)``, int64. Curved faces
            have labels too, see ``planar``.
        normals: Unit normals at the noise-free points, toward free space, ``(N, 3)``, float32.
        planar: Mask of planar faces, shape ``(M,)``, bool.
        face_normals: Normals of the planar faces, shape ``(M, 3)``, float64; zero for curved ones.
        face_offsets: Offsets of their planes, ``normal . x = offset``, shape ``(M,)``, float64.
        face_areas: Areas including covered parts, shape ``(M,)``, float64.
        kinds: Kind of each face, such as ``"table edge"``, of length M.
        objects: Object of each face, shape ``(M,)``, int64.
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
    """An object: its visible surfaces (faces), and the solids that occlude."""

    surfaces: tuple[Surface, ...]
    solids: tuple[Solid, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Model of a scene, for sampling or rendering.

    Args:
        parts: The objects; their surfaces, in order, are the faces.
    """

    parts: tuple[Part, ...]

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """All faces."""
        return tuple(surface for part in self.parts for surface in part.surfaces)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """Part of each face, shape ``(M,)``."""
        counts = [len(part.surfaces) for part in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def is_visible(self, face: int, points: Doubles, normals: Doubles) -> NDArray[np.bool_]:
        """Return the mask of points of a face with free space in front, shape ``(N,)``."""
        low, high = self.surfaces[face].bounds + np.outer((-1, 1), np.full(3, self._clearance))
        near = [
            part
            for part in self.parts
            if any((b.bounds[0] <= high).all() and (b.bounds[1] >= low).all() for b in part.solids)
        ]
        return ~is_occupied(near, points + self._clearance * normals)

    @cached_property
    def _clearance(self) -> float:
        """Minimum length of free space in front of a visible face."""
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

    Points are drawn independently and uniformly from all surfaces with free space in front of them.
    The number of points of a face is proportional to its visible area. Surfaces occluded from a
    scanner are sampled as well.

    Args:
        model: The scene.
        num_points: Number of points.
        noise: Standard deviation, in meters, from the cloud of the same seed with ``noise=0``.
        seed: Identical arguments give identical clouds; on another processor, sines of slanted
            parts may differ in the last bit.
        noise_direction: ``"normal"``: along the face's normal. ``"isotropic"``: in all directions.

    Returns:
        The cloud and its ground truth, in random order.

    Raises:
        ConfigError: If a setting is invalid.

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
        raise ConfigError(f"sample_scene: expected noise from 0 to {FARTHEST:g} m, got {noise}.")
    check_choices("sample_scene", noise_direction=(noise_direction, NoiseDirection))
    rng = seeded_generator(seed, POSITIONS)
    points, normals, labels = _sample_faces(model, num_points, rng)
    if noise > 0:
        shake = seeded_generator(seed, NOISE)
        if noise_direction == "normal":
            shifts = shake.standard_normal((num_points, 1), dtype=np.float32) * normals
        else:
            shifts = shake.standard_normal((num_points, 3), dtype=np.float32)
        points += np.float32(noise) * shifts
    rows = rng.permutation(num_points)
    return label_points(model, points[rows], labels[rows], normals[rows])


def _sample_faces(
    model: SceneModel, num_points: int, rng: np.random.Generator
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Sample exactly ``num_points`` points with normals and faces, face by face."""
    areas = np.array([surface.area for surface in model.surfaces])
    drawn: list[tuple[Floats, Floats, NDArray[np.int64]]] = []
    missing, fraction_kept = num_points, 1.0
    while missing > 0:
        num_tried = int(missing / fraction_kept * _OVERSAMPLING) + 16
        num_kept = 0
        for face, count in enumerate(rng.multinomial(num_tried, areas / areas.sum())):
            tried = model.surfaces[face].sample(rng, int(count))
            outwards = model.surfaces[face].normals_at(tried)
            is_seen = model.is_visible(face, tried, outwards)
            points, normals = (
                np.ascontiguousarray(values[is_seen], np.float32) for values in (tried, outwards)
            )
            drawn.append((points, normals, np.full(len(points), face)))
            num_kept += len(points)
        missing -= num_kept
        fraction_kept = max(num_kept, 1) / num_tried
    points, normals, labels = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
    # A random subset: the first points would underrepresent the last faces.
    chosen = np.sort(rng.permutation(len(labels))[:num_points])
    return points[chosen], normals[chosen], labels[chosen]


def is_occupied(parts: Iterable[Part], points: Doubles) -> NDArray[np.bool_]:
    """Return the mask of points of shape ``(N, 3)`` inside a solid."""
    inside = np.zeros(len(points), dtype=bool)
    for solid in (solid for part in parts for solid in part.solids):
        inside |= solid.contains(points)
    return inside


def plane_equations(surfaces: Iterable[Surface]) -> tuple[Doubles, Doubles]:
    """Return normals ``(M, 3)`` and offsets ``(M,)`` of surfaces; zero for curved ones."""
    curved = (np.zeros(3), 0.0)
    planes = [curved if surface.plane is None else surface.plane for surface in surfaces]
    normals = np.array([normal for normal, _ in planes]).reshape(-1, 3)
    return normals, np.array([offset for _, offset in planes])


def label_points(
    model: SceneModel, points: Floats, labels: NDArray[np.int64], normals: Floats
) -> Scene:
    """Combine points ``(N, 3)`` of known faces ``(N,)`` with the tables of their scene."""
    face_normals, face_offsets = plane_equations(model.surfaces)
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
    """Return an independent generator for a seed and purpose."""
    if seed < 0:
        raise ConfigError(f"torchrg.scenes: expected seed >= 0, got {seed}.")
    return np.random.Generator(np.random.PCG64([seed, purpose]))
