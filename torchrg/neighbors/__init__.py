"""Neighbourhoods: exact search, canonical order, patches, voxels."""

from torchrg.neighbors.knn import gather_columns, gather_patches, search_knn, search_nearest
from torchrg.neighbors.order import ascending_rows, canonical_order, finite_rows, restore_rows
from torchrg.neighbors.sampling import measure_sampling
from torchrg.neighbors.voxels import Voxels, restore_points, sample_voxels

__all__ = [
    "Voxels",
    "ascending_rows",
    "canonical_order",
    "finite_rows",
    "gather_columns",
    "gather_patches",
    "measure_sampling",
    "restore_points",
    "restore_rows",
    "sample_voxels",
    "search_knn",
    "search_nearest",
]
