"""Regions: which neighbours join, growth, the table of planes, and superpoints."""

from torchrg.regions.axes import align_axes
from torchrg.regions.growth import grow_regions
from torchrg.regions.planes import summarize_planes
from torchrg.regions.superpoints import partition_points

__all__ = ["align_axes", "grow_regions", "partition_points", "summarize_planes"]
