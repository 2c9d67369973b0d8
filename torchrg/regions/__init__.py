"""Region growing, plane table, plane selection and superpoints.

These functions use existing normals and estimate none. :func:`torchrg.segment_planes` runs them in
order.
"""

from torchrg.regions.axes import align_axes
from torchrg.regions.growth import grow_regions
from torchrg.regions.selection import select_planes
from torchrg.regions.superpoints import partition_points
from torchrg.regions.table import summarize_planes

__all__ = ["align_axes", "grow_regions", "partition_points", "select_planes", "summarize_planes"]
__dir__ = __all__.copy
