"""Neighbourhoods: exact search, canonical order, patches."""

from torchrg.neighbors.knn import gather_patches, search_knn
from torchrg.neighbors.order import canonical_order, finite_rows, restore_rows

__all__ = ["canonical_order", "finite_rows", "gather_patches", "restore_rows", "search_knn"]
