"""Segmentation of a cloud with checks of its points.

``torchrg segment`` and ``torchrg convert`` call :func:`segment_cloud` for each cloud.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchrg._checks import Arguments
from torchrg._limits import OUT_OF_MEMORY, system_limit
from torchrg.config import NormalsConfig, PipelineConfig, SuperpointsConfig
from torchrg.errors import CloudWarning, ConfigError, FormatError, PrecisionWarning
from torchrg.normals.orient import Orientation
from torchrg.pipeline.planes import segment_planes
from torchrg.pipeline.superpoints import make_superpoints
from torchrg.regions.selection import keep_planes, renumber_planes, selected_rows
from torchrg.structures import FARTHEST, Cloud, Segmentation, Superpoints
from torchrg.structures.points import are_integers, bounding_box
from torchrg.structures.precision import describe_placeholders

Returned = TypeVar("Returned")

_SAMPLE_SIZE = 10_000
"""Number of points from which the quantiles of coordinates are estimated."""
_QUARTILES = (0.25, 0.75)
"""Quantiles of each coordinate that bound the middle half of a cloud."""
_MAX_EXTENT_RATIO = 1000
"""Ratio of the extent of a cloud to that of its middle half above which a warning is issued. With
the seven digits of float32, rounding steps are then 1e-4 of the extent of the middle half."""


def _naming_multipliers(
    segment: Callable[Concatenate[Cloud, PipelineConfig, Arguments], Returned],
) -> Callable[Concatenate[Cloud, PipelineConfig, Arguments], Returned]:
    """Name the settings that multiply memory in an out-of-memory error."""

    @wraps(segment)
    def call(
        cloud: Cloud, settings: PipelineConfig, /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Returned:
        try:
            return segment(cloud, settings, *args, **kwargs)
        except (MemoryError, RuntimeError) as error:
            multipliers = describe_multipliers(settings, kwargs.get("partition"))
            if system_limit(error) != OUT_OF_MEMORY or not multipliers:
                raise
            raise ConfigError(
                f"{cloud.source}: out of memory for {len(cloud):,} points{multipliers}; lower it, "
                "or pass --voxel."
            ) from error

    return call


@_naming_multipliers
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
    """Segment a cloud into planes, and with ``partition`` into superpoints.

    Args:
        cloud: Point cloud with its fields.
        settings: Plane configuration.
        orient: Normal orientation, as in :func:`torchrg.segment_planes`.
        viewpoint: Scanner position, as in :func:`torchrg.segment_planes`.
        partition: Superpoint configuration. Default: no superpoints.
        voxel: Voxel size; one point per voxel is segmented. Default: segment all points.
        within: Name of the field with the object of each point; see :func:`find_objects`.
        begin: Callback that receives the name of each stage at its start.
        warn: Callback that receives the notes of :func:`check_finite` and later warnings.

    Raises:
        FormatError: If no point is finite, or ``within`` is not a field of integers.
        ConfigError: If normals are oriented by viewpoint and the cloud has no scanner positions, or
            if there is not enough memory for settings above their defaults.
    """
    for note in check_finite(cloud):
        warn(note)
    objects = find_objects(cloud, within)
    is_kept = partition is not None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore", PrecisionWarning)  # The notes above.
        warnings.simplefilter("always", CloudWarning)
        seg = segment_planes(
            cloud,
            # Superpoints respect the boundaries of all planes.
            settings.without_selection() if is_kept else settings,
            orient=orient,
            viewpoint=viewpoint,
            voxel=voxel,
            within=objects,
            keep_neighbors=is_kept,
            on_stage=begin,
        )
    for warning in caught:
        if issubclass(warning.category, CloudWarning):
            warn(str(warning.message).rstrip("."))
        else:
            warnings.warn(warning.message, stacklevel=2)
    if partition is None:
        return seg, None
    begin("superpoints")
    colors = cloud.fields.get("color")
    superpoints = make_superpoints(cloud.points, seg, partition, colors=colors, voxel=voxel)
    rows = selected_rows(seg.planes, settings)
    plane = renumber_planes(superpoints.plane, rows, len(seg.planes))
    return keep_planes(seg, rows), replace(superpoints, plane=plane)


def describe_multipliers(settings: PipelineConfig, partition: object = None) -> str:
    """Return the settings that need more memory than their defaults, as flags after "with"."""
    normals, default, flags = settings.normals, NormalsConfig.k, []
    for name, value in (("k", normals.k), ("adaptive-k", normals.adaptive_k or 0)):
        flags += [f"--normals.{name} {value}"] if value > default else []
    if (
        isinstance(partition, SuperpointsConfig)
        and partition.num_levels > SuperpointsConfig().num_levels
    ):
        flags.append(f"{partition.num_levels} levels of superpoints")
    return f" with {' and '.join(flags)}" if flags else ""


def check_finite(cloud: Cloud) -> tuple[str, ...]:
    """Return warnings about different units, missing points, outliers and lost precision.

    Raises:
        FormatError: If no point is finite.
    """
    num_bad = len(cloud) - int(np.count_nonzero(cloud.finite))
    if num_bad == len(cloud):
        raise FormatError(
            f"{cloud.source}: expected finite points, got none in {num_bad:,} points; coordinates "
            f"beyond {FARTHEST:g} count as missing: use another unit, or check the file."
        )
    notes = [cloud.unit_note] if cloud.unit_note else []
    if num_bad:
        notes.append(
            f"{num_bad:,} of {len(cloud):,} points are not finite or beyond {FARTHEST:g}; they "
            "have no normal and no plane"
        )
    finite = cloud.coordinates[cloud.finite] if num_bad else cloud.coordinates
    low, high = bounding_box(finite)
    size = float((high - low).max())
    low, high = np.quantile(finite[:: max(len(cloud) // _SAMPLE_SIZE, 1)], _QUARTILES, axis=0)
    width = float((high - low).max())
    if width > 0 and size > _MAX_EXTENT_RATIO * width:
        notes.append(
            f"half of the points lie within {width:.3g}, but the extent is {size:.3g}, which costs "
            "precision; remove outliers"
        )
    elif cloud.precision_note:
        notes.append(cloud.precision_note)
    if placeholders := describe_placeholders(finite):
        notes.append(placeholders)
    return tuple(notes)


def note_on_copies(num_copies: int, num_points: int) -> tuple[str, ...]:
    """Return a note if a cloud has points with equal coordinates."""
    if not num_copies:
        return ()
    return (
        f"{num_copies:,} of {num_points:,} points are duplicates; duplicates count once and share "
        "one result",
    )


def find_objects(cloud: Cloud, name: str | None) -> NDArray[np.int64] | None:
    """Return the object of each point from a field of the cloud; None without a name.

    ``segment`` falls back to ``segment20``. If a point has several labels, the first one is used.
    Integers stored as floats, as in text and scalar fields of PLY, are accepted.

    Raises:
        FormatError: If the field is missing or does not have one integer per point.
    """
    if name is None:
        return None
    fields: Mapping[str, NDArray[Any]] = cloud.fields
    values, field = fields.get(name, fields.get(f"{name}20")), f"the field {name} of --within"
    if values is None:
        names = ", ".join(sorted(fields)) or "none"
        names += "".join(f" ({note})" for note in cloud.notes if name in note)
        raise FormatError(f"{cloud.source}: expected {field}, got {names}; choose one of these.")
    if values.dtype.kind not in "iubf" or len(values) != len(cloud) or not are_integers(values):
        raise FormatError(
            f"{cloud.source}: expected {field} to have one integer for each of {len(cloud):,} "
            f"points, got {values.dtype} of shape {values.shape}; number the objects."
        )
    return values.reshape(len(values), -1)[:, 0].astype(np.int64)
