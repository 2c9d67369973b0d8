"""Regions: which neighbours join, growth, and the table of planes."""

from torchrg.regions.growth import grow_regions
from torchrg.regions.planes import summarize_planes

__all__ = ["grow_regions", "summarize_planes"]
