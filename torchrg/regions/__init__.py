"""Regions: which neighbours join, growth, and the table of planes."""

from torchrg.regions.grow import grow_regions
from torchrg.regions.planes import summarize_planes
from torchrg.regions.table import planes_to_json, planes_to_rows

__all__ = ["grow_regions", "planes_to_json", "planes_to_rows", "summarize_planes"]
