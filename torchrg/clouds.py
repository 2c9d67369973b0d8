"""The planes and superpoints of a cloud as it was read, with checks of its points.

``torchrg segment`` and ``torchrg convert`` call :func:`segment_cloud` for each cloud.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.config import PipelineConfig, SuperpointsConfig
from torchrg.errors import FormatError
from torchrg.io.fields import are_integers
from torchrg.normals.orient import Orientation
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.regions.selection import choose_planes, keep_planes, renumber_planes
from torchrg.structures import FARTHEST, Cloud, Segmentation, Superpoints, bounding_box

__all__ = ["check_finite", "find_objects", "note_on_copies", "segment_cloud"]
__dir__ = __all__.copy

_LOOKED_AT = 10_000
"""Points, spread over a cloud, that tell where most of its points are."""
_MIDDLE = (0.25, 0.75)
"""Quantiles of each coordinate between which the middle half of a cloud lies."""
_FAR_OFF = 1000
"""Ratio of the extent of a cloud to that of its middle half from which on the user is warned. As
float32 has seven digits, its steps are then a ten-thousandth of where most points are."""


def segment_cloud(
    cloud: Cloud,
    settings: PipelineConfig,
    *,
    orient: Orientation = "auto",
    viewpoint: Sequence[float] | None = None,
    partition: SuperpointsConfig | None = None,
    voxel: float | None = None,
    within: str | None = None,
    begin: Callable[[str], None] = lambda stage: None,
    warn: Callable[[str], object] = lambda note: None,
) -> tuple[Segmentation, Superpoints | None]:
    """Return the planes of a cloud, and with a ``partition`` its superpoints.

    Args:
        cloud: The cloud, its labels among its fields.
        settings: How planes are found.
        orient: Side to which normals point; see :func:`torchrg.segment_planes`.
        viewpoint: Where the sensor stood; see there.
        partition: How superpoints are made. Default: none are.
        voxel: Side of voxels, of which one point each is segmented.
        within: Name of the field of objects that contain planes; see :func:`find_objects`.
        begin: Called with the name of each stage when it starts.
        warn: Called with each warning of :func:`check_finite`, before the work.

    Raises:
        FormatError: If no point is finite, or ``within`` is not a field of whole numbers.
        ConfigError: If normals shall point to scanners, and the cloud does not name any.

    Example:
        >>> from torchrg.config import load_config
        >>> from torchrg.scenes import make_room
        >>> cloud = Cloud(make_room(2000).points.numpy())
        >>> seg, superpoints = segment_cloud(cloud, load_config("classic"))
        >>> len(seg.labels), superpoints
        (2000, None)
    """
    for note in check_finite(cloud):
        warn(note)
    objects = find_objects(cloud, within)
    is_kept = partition is not None
    seg = segment_planes(
        cloud,
        # Superpoints keep to the borders of all planes.
        settings.without_selection() if is_kept else settings,
        orient=orient,
        viewpoint=viewpoint,
        voxel=voxel,
        within=objects,
        keep_neighbors=is_kept,
        on_stage=begin,
    )
    if partition is None:
        return seg, None
    begin("superpoints")
    colors = cloud.fields.get("color")
    superpoints = make_superpoints(cloud.points, seg, partition, colors=colors, voxel=voxel)
    rows = choose_planes(seg.planes, settings)
    plane = renumber_planes(superpoints.plane, rows, len(seg.planes))
    return keep_planes(seg, rows), replace(superpoints, plane=plane)


def check_finite(cloud: Cloud) -> tuple[str, ...]:
    """Return warnings if points are missing, far off, or have lost digits; one has to be finite.

    Example:
        >>> check_finite(Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]])))
        ('2 of 3 points are not finite or beyond 1e+12; they stay in place, unlabelled',)
    """
    num_bad = len(cloud) - int(np.count_nonzero(cloud.finite))
    if num_bad == len(cloud):
        raise FormatError(
            f"{cloud.source}: expected finite points, got none in {num_bad:,} points; those beyond "
            f"{FARTHEST:g} count as missing: use another unit, or look where they come from."
        )
    notes = []
    if num_bad:
        notes.append(
            f"{num_bad:,} of {len(cloud):,} points are not finite or beyond {FARTHEST:g}; they "
            "stay in place, unlabelled"
        )
    finite = cloud.coordinates[cloud.finite] if num_bad else cloud.coordinates
    low, high = bounding_box(finite)
    size = float((high - low).max())
    low, high = np.quantile(finite[:: max(len(cloud) // _LOOKED_AT, 1)], _MIDDLE, axis=0)
    width = float((high - low).max())
    if width > 0 and size > _FAR_OFF * width:
        notes.append(
            f"half of its points lie within {width:.3g}, single ones {size:.3g} apart, which costs "
            "the others their precision; remove those that are none"
        )
    elif cloud.precision_note:
        notes.append(cloud.precision_note)
    return tuple(notes)


def note_on_copies(num_copies: int, num_points: int) -> tuple[str, ...]:
    """Return a line for people if points of a cloud repeat the coordinates of others.

    Example:
        >>> note_on_copies(2, 3)
        ('2 of 3 points are copies of others; copies count once and get one result',)
    """
    if not num_copies:
        return ()
    return (
        f"{num_copies:,} of {num_points:,} points are copies of others; copies count once and get "
        "one result",
    )


def find_objects(cloud: Cloud, name: str | None) -> NDArray[np.int64] | None:
    """Return the object of each point of a cloud, the field of a name; None without a name.

    ``segment`` is ``segment20`` where there is only that. Of several labels of a point the first
    is taken; text and scalar fields of PLY have whole numbers as floats.

    Raises:
        FormatError: If there is no such field, or it does not hold a whole number for each point.

    Example:
        >>> cloud = Cloud(np.zeros((2, 3)), {"instance": np.array([[3, 5], [4, -1]])})
        >>> find_objects(cloud, "instance").tolist()
        [3, 4]
    """
    if name is None:
        return None
    fields: Mapping[str, NDArray[Any]] = cloud.fields
    values, wanted = fields.get(name, fields.get(f"{name}20")), f"the field {name} of --within"
    if values is None:
        names = ", ".join(sorted(fields)) or "none"
        names += "".join(f" ({note})" for note in cloud.notes if name in note)
        raise FormatError(f"{cloud.source}: expected {wanted}, got {names}; name one of these.")
    if values.dtype.kind not in "iubf" or len(values) != len(cloud) or not are_integers(values):
        raise FormatError(
            f"{cloud.source}: expected {wanted} to be a whole number for each of {len(cloud):,} "
            f"points, got {values.dtype} of shape {values.shape}; number the objects."
        )
    return values.reshape(len(values), -1)[:, 0].astype(np.int64)
