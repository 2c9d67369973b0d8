"""Robust normals, curvature and plane labels for indoor point clouds."""

from torchrg import datasets, depth, metrics, nn, normals, robust, scenes, transforms
from torchrg.config import load_config
from torchrg.errors import TorchrgError
from torchrg.io import read_cloud, write_cloud
from torchrg.neighbors import search_knn
from torchrg.normals import estimate_normals
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.regions import grow_regions
from torchrg.structures import UNLABELED, Cloud
from torchrg.tiling import segment_tiles

__version__ = "0.1.0"

__all__ = [
    "UNLABELED",
    "Cloud",
    "TorchrgError",
    "datasets",
    "depth",
    "estimate_normals",
    "grow_regions",
    "load_config",
    "make_superpoints",
    "metrics",
    "nn",
    "normals",
    "read_cloud",
    "robust",
    "scenes",
    "search_knn",
    "segment_planes",
    "segment_tiles",
    "transforms",
    "write_cloud",
]
