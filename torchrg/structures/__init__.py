"""Data structures passed between pipeline stages, and checks of their values."""

import torch

from torchrg.structures.cloud import Cloud
from torchrg.structures.planes import (
    PLANE_KINDS,
    Plane,
    PlaneAdjacency,
    PlaneKind,
    Planes,
    Segmentation,
    Superpoints,
)
from torchrg.structures.points import (
    FARTHEST,
    MAX_POINTS,
    UNLABELED,
    FilePath,
    Neighbors,
    NormalFit,
    Points,
    Sampling,
)

__all__ = [
    "FARTHEST",
    "MAX_POINTS",
    "PLANE_KINDS",
    "UNLABELED",
    "AnyCloud",
    "Cloud",
    "Neighbors",
    "NormalFit",
    "Plane",
    "PlaneAdjacency",
    "PlaneKind",
    "Planes",
    "Sampling",
    "Segmentation",
    "Superpoints",
]
__dir__ = __all__.copy

AnyCloud = Points | Cloud | FilePath
"""Points ``(N, 3)`` as a tensor or an array, a cloud, or the path of a file."""

# Lets torch.load(weights_only=True) read results and samples.
torch.serialization.add_safe_globals(
    [Neighbors, NormalFit, Plane, PlaneAdjacency, Planes, Sampling, Segmentation, Superpoints]
)
