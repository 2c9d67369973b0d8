"""Exact neighbor search, canonical order, distinct points and voxels."""

from torchrg.neighbors.knn import search_knn
from torchrg.neighbors.order import canonical_order, distinct_points, expand_to_points
from torchrg.neighbors.sampling import measure_sampling
from torchrg.neighbors.voxels import sample_voxels

__all__ = [
    "canonical_order",
    "distinct_points",
    "expand_to_points",
    "measure_sampling",
    "sample_voxels",
    "search_knn",
]
__dir__ = __all__.copy
