"""Classes of the planes of a cloud, with a check of the axis that is up."""

from torch import Tensor

from torchrg.axes import likely_up
from torchrg.errors import CloudWarning, warn
from torchrg.regions.classes import classify_planes
from torchrg.structures import Planes


def find_kinds(planes: Planes, points: Tensor, labels: Tensor, up: Tensor) -> Tensor:
    """Return :func:`torchrg.regions.classes.classify_planes`; warn if another axis is likely up.

    Warns:
        CloudWarning: If the floor and ceiling of another axis are far larger than what faces up.
    """
    columns = (planes.normal, planes.centroid, planes.area, up)
    axis = likely_up(*(values.numpy(force=True).astype("f8") for values in columns))
    if axis:
        warn(
            f"the largest floor and ceiling face {axis}, so planes may have wrong classes: pass "
            f"--up {axis} (in Python planes.up={axis!r}) if {axis} is up.",
            CloudWarning,
        )
    return classify_planes(planes, points, labels, up)
