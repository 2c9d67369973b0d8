"""Regions: which neighbours join, growth, plane table, selection, and superpoints.

Everything here takes normals that are there and estimates none. :func:`torchrg.segment_planes`
calls these functions one after the other, with what comes before and after them.
"""

from torchrg.regions.axes import align_axes
from torchrg.regions.growth import grow_regions
from torchrg.regions.selection import select_planes
from torchrg.regions.superpoints import partition_points
from torchrg.regions.table import summarize_planes

__all__ = ["align_axes", "grow_regions", "partition_points", "select_planes", "summarize_planes"]
