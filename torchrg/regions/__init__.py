"""Regions: which neighbours join, growth, and the table of planes."""

from torchrg.regions.growth import grow_regions
from torchrg.regions.planes import planes_to_json, planes_to_rows, summarize_planes

__all__ = ["grow_regions", "planes_to_json", "planes_to_rows", "summarize_planes"]
