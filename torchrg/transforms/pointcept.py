"""Importing this module makes torchrg known to Pointcept.

Put ``import torchrg.transforms.pointcept`` at the end of ``pointcept/datasets/__init__.py``, where
every process meets it. From then on

* a config can name the transforms: ``dict(type="SegmentPlanes", config="classic")``, before or
  after points are taken out. They read and return NumPy arrays there, and have two axes for one
  number a point, as ``strength`` has, so that ``Collect`` can join ``curvature`` to the features;
* the data sets load ``plane.npy``, ``curvature.npy`` and ``superpoint.npy``, which ``torchrg
  convert`` wrote;
* what takes points out takes them out of these entries too;
* ``point_collate_fn`` with ``mix_prob`` numbers the planes of two mixed rooms anew, so that they
  stay apart.

Where Pointcept is not installed, nothing happens.
"""

import importlib.util
from collections.abc import Callable, Sequence

import numpy as np

from torchrg.errors import MissingDependencyError
from torchrg.transforms import planes
from torchrg.transforms.planes import AlignAxes, GrowRegions, MakeSuperpoints, OrientNormals
from torchrg.transforms.rows import (
    OUR_KEYS,
    Entries,
    Sample,
    SampleDict,
    recognized_keys,
    with_listed,
)
from torchrg.transforms.sample import CenterCloud, KeepFinite, SampleTransform, SampleVoxels

_FEATURES = ("curvature", "residual")
"""Entries of one number a point that may become features."""
_LABELS = ("plane", "superpoint")
"""Entries whose numbers begin again in each room."""
_FILES = ("plane", "curvature", "superpoint")
"""Arrays of a scene folder that the data sets of Pointcept pass over by themselves."""


class _WithColumns(SampleTransform):
    """Gives features two axes, as Pointcept's ``Collect`` joins them."""

    def changed(
        self,
        sample: Sample,
        values: Entries,
        *,
        per_point: Sequence[str] = (),
    ) -> Sample:
        """Return a new sample of the same kind with other values by key."""
        columns = {self.key(sample, name) for name in _FEATURES}
        wide = {
            key: value[:, None] if key in columns and value.ndim == 1 else value
            for key, value in values.items()
        }
        return super().changed(sample, wide, per_point=per_point)


class EstimateNormals(_WithColumns, planes.EstimateNormals):
    """:class:`torchrg.transforms.EstimateNormals`; ``curvature``, ``residual`` are ``(N, 1)``."""


class SegmentPlanes(_WithColumns, planes.SegmentPlanes):
    """:class:`torchrg.transforms.SegmentPlanes`; ``curvature`` is ``(N, 1)``."""


def point_collate_fn(batch: Sequence[Entries], mix_prob: float = 0) -> SampleDict:
    """Join samples as Pointcept does; where two rooms become one, their planes stay apart.

    Of each pair the planes of the second are numbered after those of the first.
    """
    joined: SampleDict = _OWN["point_collate_fn"](batch, mix_prob=mix_prob)
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
"""Transforms that configs can name."""
_OWN: dict[str, Callable[..., SampleDict]] = {}
"""Pointcept's own functions, behind those that take their places."""


def index_operator(data_dict: SampleDict, index: object, duplicate: bool = False) -> SampleDict:
    """Take points out as Pointcept does, and out of all entries with a row for each point."""
    others = recognized_keys(data_dict, len(data_dict["coord"]))
    data_dict.update(with_listed(data_dict, [*OUR_KEYS, *_LABELS, *others]))
    return _OWN["index_operator"](data_dict, index, duplicate)


def _make_known() -> None:
    """Name the transforms and files, and take the places of two functions, once a process."""
    from pointcept import datasets
    from pointcept.datasets import transform, utils
    from pointcept.datasets.builder import DATASETS

    for replaced in _TRANSFORMS:
        transform.TRANSFORMS.register_module(module=replaced, force=True)
    for data_set in DATASETS.module_dict.values():
        for assets in ("VALID_ASSETS", "PC_VALID_ASSETS"):
            files = getattr(data_set, assets, None)
            if files is not None:
                setattr(data_set, assets, list(dict.fromkeys([*files, *_FILES])))
    if not hasattr(transform, "index_operator"):
        raise MissingDependencyError(
            "torchrg.transforms.pointcept: expected a Pointcept whose transforms take points out "
            "by index_operator, got an older one; update it."
        )
    for module, ours in ((transform, index_operator), (utils, point_collate_fn)):
        # Kept there, so that another import of this module finds them and not our own.
        name = ours.__name__
        _OWN[name] = vars(module).setdefault(f"_{name}_of_pointcept", getattr(module, name))
        setattr(module, name, ours)
    datasets.point_collate_fn = point_collate_fn


if importlib.util.find_spec("pointcept") is not None:
    _make_known()
