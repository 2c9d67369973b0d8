"""Registration of torchrg with Pointcept, on import.

Put ``import torchrg.transforms.pointcept`` at the end of ``pointcept/datasets/__init__.py``, which
every process imports. Then

* a config can name the transforms: ``dict(type="SegmentPlanes", config="classic")``, before or
  after points are removed. They read and return NumPy arrays, with two axes for scalars per point,
  like ``strength``, so that ``Collect`` can concatenate ``curvature`` with the features;
* the data sets load ``plane.npy``, ``curvature.npy`` and ``superpoint.npy``, as written by
  ``torchrg convert``;
* operations that remove points remove them from these entries too;
* ``point_collate_fn`` with ``mix_prob`` keeps the plane IDs of two mixed rooms distinct.

Without Pointcept, the import has no effect.
"""

import importlib.util
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from torch import Tensor

from torchrg.errors import MissingDependencyError
from torchrg.transforms import planes
from torchrg.transforms.planes import AlignAxes, GrowRegions, MakeSuperpoints, OrientNormals
from torchrg.transforms.rows import TORCHRG_KEYS, Entries, SampleDict, extend_list, per_point_keys
from torchrg.transforms.sample import (
    CenterCloud,
    CloudTransform,
    KeepFinite,
    NeighborSearch,
    SampleVoxels,
)

__all__ = ["EstimateNormals", "SegmentPlanes", "index_operator", "point_collate_fn"]
__dir__ = __all__.copy

_FEATURES = ("curvature", "residual")
"""Scalar per-point entries that can be features."""
_LABELS = ("plane", "superpoint")
"""Entries whose IDs start at 0 in each room."""
_FILES = ("plane", "curvature", "superpoint")
"""Arrays of a scene folder that Pointcept's data sets would ignore."""


class _ColumnFeatures(CloudTransform):
    """Mixin that adds a second axis to features, as Pointcept's ``Collect`` requires."""

    def add(self, cloud: Mapping[str, Tensor], search: NeighborSearch) -> dict[str, Tensor]:
        """Return the new entries of one cloud from the entries that are read."""
        added = super().add(cloud, search)
        return {name: v[:, None] if name in _FEATURES else v for name, v in added.items()}


class EstimateNormals(_ColumnFeatures, planes.EstimateNormals):
    """:class:`torchrg.transforms.EstimateNormals`; ``curvature``, ``residual`` are ``(N, 1)``."""


class SegmentPlanes(_ColumnFeatures, planes.SegmentPlanes):
    """:class:`torchrg.transforms.SegmentPlanes`; ``curvature`` is ``(N, 1)``."""


def point_collate_fn(batch: Sequence[Entries], mix_prob: float = 0) -> SampleDict:
    """Collate samples as Pointcept does, and keep the planes of mixed rooms distinct.

    Of each pair of rooms, the plane IDs of the second are offset.
    """
    joined: SampleDict = _ORIGINALS["point_collate_fn"](batch, mix_prob=mix_prob)
    labels = [joined[name] for name in _LABELS if name in joined]
    if not labels or "offset" not in joined:
        return joined
    sizes = [size for sample in batch for size in np.diff(sample["offset"], prepend=0).tolist()]
    if len(joined["offset"]) == len(sizes):
        return joined
    ends = np.cumsum(sizes)
    for start, middle, end in zip([0, *ends[1::2]], ends[::2], ends[1::2], strict=False):
        for values in labels:
            first, second = values[start:middle], values[middle:end]
            second[second >= 0] += int(first.max()) + 1
    return joined


_TRANSFORMS = (
    AlignAxes,
    CenterCloud,
    EstimateNormals,
    GrowRegions,
    KeepFinite,
    SampleVoxels,
    SegmentPlanes,
    MakeSuperpoints,
    OrientNormals,
)
"""Transforms available in configs."""
_ORIGINALS: dict[str, Callable[..., SampleDict]] = {}
"""Pointcept's original functions by name."""


def index_operator(data_dict: SampleDict, index: object, duplicate: bool = False) -> SampleDict:
    """Select points as Pointcept does, from all per-point entries."""
    keys = per_point_keys(data_dict, len(data_dict["coord"]))
    data_dict.update(extend_list(data_dict, [*TORCHRG_KEYS, *_LABELS, *keys]))
    return _ORIGINALS["index_operator"](data_dict, index, duplicate)


def _register() -> None:
    """Register transforms and files, and wrap two functions, once per process."""
    from pointcept import datasets
    from pointcept.datasets import transform, utils
    from pointcept.datasets.builder import DATASETS

    for transform_class in _TRANSFORMS:
        transform.TRANSFORMS.register_module(module=transform_class, force=True)
    for data_set in DATASETS.module_dict.values():
        for assets in ("VALID_ASSETS", "PC_VALID_ASSETS"):
            files = getattr(data_set, assets, None)
            if files is not None:
                setattr(data_set, assets, list(dict.fromkeys([*files, *_FILES])))
    if not hasattr(transform, "index_operator"):
        raise MissingDependencyError(
            "torchrg.transforms.pointcept: expected a Pointcept version with "
            "transform.index_operator, got an older one; update it."
        )
    for module, wrapper in ((transform, index_operator), (utils, point_collate_fn)):
        # Stored in the module, so that a repeated import finds the original, not the wrapper.
        name = wrapper.__name__
        _ORIGINALS[name] = vars(module).setdefault(f"_{name}_of_pointcept", getattr(module, name))
        setattr(module, name, wrapper)
    datasets.point_collate_fn = point_collate_fn


if importlib.util.find_spec("pointcept") is not None:
    _register()
