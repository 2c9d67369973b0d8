"""Points of known faces as a cloud with its truth."""

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg.scenes.frames import Floats
from torchrg.scenes.scene import Scene, SceneModel


def label_points(
    model: SceneModel,
    points: Floats,
    labels: NDArray[np.int64],
    normals: Floats,
    paint: np.random.Generator | None,
) -> Scene:
    """Return points of known faces as a cloud with the tables of its scene.

    Args:
        model: The scene.
        points: Shape ``(N, 3)``, float32.
        labels: Faces, or ``UNLABELED``, shape ``(N,)``.
        normals: Shape ``(N, 3)``, float32.
        paint: Generator of the colours; None for none.

    Returns:
        The cloud and its truth.
    """
    colors = None if paint is None else torch.from_numpy(_colors(model, labels, paint))
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
        colors=colors,
    )


def _colors(
    model: SceneModel, labels: NDArray[np.int64], rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return a colour for each point: that of its object, grey for outliers, a little uneven."""
    palette = rng.integers(60, 230, size=(len(model.parts) + 1, 3))
    object_of = np.append(model.objects, len(model.parts))
    shades: NDArray[np.int64] = palette[object_of[labels]] + rng.integers(
        -12, 13, size=(len(labels), 1)
    )
    return shades.astype(np.uint8)
