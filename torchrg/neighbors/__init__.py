"""Exact neighbor search, canonical order, patches and voxels."""

from torchrg.neighbors.knn import (
    check_neighbors,
    gather_columns,
    gather_patches,
    prepare_search,
    search_knn,
    search_nearest,
)
from torchrg.neighbors.order import (
    DistinctPoints,
    ascending_rows,
    canonical_order,
    distinct_points,
    distinct_rows,
    expand_to_points,
    finite_rows,
    mark_distinct,
    scatter_rows,
)
from torchrg.neighbors.sampling import measure_sampling
from torchrg.neighbors.voxels import Voxels, sample_voxels

__all__ = [
    "DistinctPoints",
    "Voxels",
    "ascending_rows",
    "canonical_order",
    "check_neighbors",
    "distinct_points",
    "distinct_rows",
    "expand_to_points",
    "finite_rows",
    "gather_columns",
    "gather_patches",
    "mark_distinct",
    "measure_sampling",
    "prepare_search",
    "sample_voxels",
    "scatter_rows",
    "search_knn",
    "search_nearest",
]
__dir__ = __all__.copy
