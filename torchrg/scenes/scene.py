"""What a scene is made of, and what sampling it gives."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import ConfigError
from torchrg.scenes.geometry import Array, Floats
from torchrg.scenes.surfaces import Solid, Surface

_CLEARANCE = 1e-7
"""How far in front of a surface must be free for it to be seen, in sizes of the scene."""


class Scene(NamedTuple):
    """A cloud with its exact truth.

    Attributes:
        points: Shape ``(N, 3)``, float32, metres.
        labels: Row of each point's face in the tables below, shape ``(N,)``, int64;
            ``torchrg.UNLABELED`` for outliers. Curved faces have labels too, see ``planar``.
        normals: Unit normals of the faces at the points before noise, towards free space, shape
            ``(N, 3)``, float32; zero for outliers.
        planar: Whether each face lies in a plane, shape ``(M,)``, bool.
        face_normals: Normals of the planar faces, shape ``(M, 3)``, float64; zero for curved ones.
        face_offsets: Offsets of their planes, ``normal . x = offset``, shape ``(M,)``, float64.
        face_areas: Areas, covered parts included, shape ``(M,)``, float64.
        kinds: What each face is part of, as in ``"table edge"``, of length M.
        objects: Which object each face belongs to, shape ``(M,)``, int64.
        colors: Colours of the objects with some variation, shape ``(N, 3)``, uint8; None unless
            asked for.
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
    colors: Tensor | None = None


@dataclass(frozen=True)
class Part:
    """An object: its visible surfaces, each a face, and the bodies that hide what is in them."""

    surfaces: tuple[Surface, ...]
    solids: tuple[Solid, ...] = ()


@dataclass(frozen=True, eq=False)
class SceneModel:
    """The description of a scene, to be sampled or rendered.

    Args:
        parts: The objects; their surfaces in order are the faces.
        viewpoints: Places in free space where a scanner may stand, shape ``(V, 3)``, at least one.
    """

    parts: tuple[Part, ...]
    viewpoints: Array

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """The faces."""
        return tuple(surface for part in self.parts for surface in part.surfaces)

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """The bodies."""
        return tuple(solid for part in self.parts for solid in part.solids)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """Which part each face belongs to, shape ``(M,)``."""
        counts = [len(part.surfaces) for part in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    @cached_property
    def planes(self) -> tuple[Array, Array]:
        """Normals ``(M, 3)`` and offsets ``(M,)`` of the faces; zero for curved ones."""
        return plane_table(self.surfaces)

    @cached_property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around all faces, shape ``(2, 3)``."""
        boxes = np.stack([surface.bounds for surface in self.surfaces])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    def is_visible(self, face: int, points: Array, normals: Array) -> NDArray[np.bool_]:
        """Return at which points of a face there is free space in front of it, shape ``(N,)``."""
        free = np.ones(len(points), dtype=bool)
        if self._touching[face]:
            front = points + self._clearance * normals
            for solid in self._touching[face]:
                free &= ~solid.contains(front)
        return free

    @cached_property
    def _clearance(self) -> float:
        """Length by which what is in front of a face is told from what touches it."""
        return _CLEARANCE * float((self.bounds[1] - self.bounds[0]).max())

    @cached_property
    def _touching(self) -> tuple[tuple[Solid, ...], ...]:
        """For each face the bodies that may cover part of it."""
        return tuple(
            tuple(
                solid
                for solid in self.solids
                if (solid.bounds[0] <= surface.bounds[1] + self._clearance).all()
                and (solid.bounds[1] >= surface.bounds[0] - self._clearance).all()
            )
            for surface in self.surfaces
        )


def is_occupied(parts: Iterable[Part], points: Array) -> NDArray[np.bool_]:
    """Return which points of shape ``(N, 3)`` are inside a body."""
    inside = np.zeros(len(points), dtype=bool)
    for part in parts:
        for solid in part.solids:
            inside |= solid.contains(points)
    return inside


def plane_table(surfaces: Iterable[Surface]) -> tuple[Array, Array]:
    """Return normals ``(M, 3)`` and offsets ``(M,)`` of surfaces; zero for curved ones."""
    curved = (np.zeros(3), 0.0)
    planes = [curved if surface.plane is None else surface.plane for surface in surfaces]
    normals = np.array([normal for normal, _ in planes]).reshape(-1, 3)
    return normals, np.array([offset for _, offset in planes])


def label_points(
    model: SceneModel,
    points: Floats,
    labels: NDArray[np.int64],
    normals: Floats,
    colors: NDArray[np.uint8] | None = None,
) -> Scene:
    """Return points ``(N, 3)`` of known faces ``(N,)`` as a cloud with the tables of its scene."""
    face_normals, face_offsets = model.planes
    return Scene(
        points=torch.from_numpy(points),
        labels=torch.from_numpy(labels),
        normals=torch.from_numpy(normals),
        planar=torch.tensor([surface.plane is not None for surface in model.surfaces]),
        face_normals=torch.from_numpy(face_normals),
        face_offsets=torch.from_numpy(face_offsets),
        face_areas=torch.tensor([s.area for s in model.surfaces], dtype=torch.float64),
        kinds=tuple(surface.kind for surface in model.surfaces),
        objects=torch.from_numpy(model.objects),
        colors=None if colors is None else torch.from_numpy(colors),
    )


def seeded_generator(seed: int, purpose: int) -> np.random.Generator:
    """Return one of several independent generators that belong to a seed, one for each purpose.

    Raises:
        ConfigError: If the seed is negative.
    """
    if seed < 0:
        raise ConfigError(f"torchrg.scenes: expected seed >= 0, got {seed}.")
    return np.random.Generator(np.random.PCG64([seed, purpose]))
