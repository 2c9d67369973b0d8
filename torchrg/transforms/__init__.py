"""Modules for data pipelines: a dict of tensors in, a new dict out."""

from torchrg.transforms.planes import EstimateNormals, GrowRegions, SegmentPlanes

__all__ = ["EstimateNormals", "GrowRegions", "SegmentPlanes"]
