"""Importing this module makes the transforms known to Pointcept.

With ``import torchrg.transforms.pointcept`` at the end of ``pointcept/datasets/__init__.py``, a
config can name them: ``dict(type="SegmentPlanes", config="classic")``.
They read and return NumPy arrays there. Where Pointcept is not installed, nothing happens.
"""

import importlib.util

from torchrg.transforms.planes import EstimateNormals, GrowRegions, SegmentPlanes, Superpoints
from torchrg.transforms.sample import CenterCloud, KeepFinite
from torchrg.transforms.voxels import SampleVoxels

if importlib.util.find_spec("pointcept") is not None:
    from pointcept.datasets.transform import TRANSFORMS

    for _transform in (
        CenterCloud,
        EstimateNormals,
        GrowRegions,
        KeepFinite,
        SampleVoxels,
        SegmentPlanes,
        Superpoints,
    ):
        TRANSFORMS.register_module(module=_transform)
