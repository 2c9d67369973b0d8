"""Regions: which neighbours join, growth, the table of planes, and superpoints."""

from torchrg.regions.axes import align_axes
from torchrg.regions.growth import grow_regions
from torchrg.regions.superpoints import partition_points
from torchrg.regions.table import summarize_planes

__all__ = ["align_axes", "grow_regions", "partition_points", "summarize_planes"]
