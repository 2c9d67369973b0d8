"""Angle errors of normals against ground truth."""

import math
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ShapeError
from torchrg.linalg import unsigned_angle_deg
from torchrg.metrics.sphere import unit_vectors
from torchrg.structures.points import short_repr

_CHUNK = 2**20
"""Number of points evaluated at a time; bounds the memory."""
_LIMITS_DEG = (5, 10, 20)
"""Limits of the fractions of small errors, in degrees."""


@short_repr
class NormalScore(NamedTuple):
    """Errors of normals; see :func:`score_normals`. ``METRICS["normals"]`` lists the units.

    Attributes:
        msae: Mean squared angle error, degrees^2.
        rms: RMS angle error, degrees.
        mean: Mean angle error, degrees.
        median: Median angle error, degrees.
        under_5_deg: Fraction of points with an error below 5 degrees, in [0, 1]; and so on.
        points: Number of evaluated points.
        invalid: Number of points with ground truth but no estimated normal; not evaluated.
    """

    msae: float
    rms: float
    mean: float
    median: float
    under_5_deg: float
    under_10_deg: float
    under_20_deg: float
    points: int
    invalid: int


def score_normals(
    normals: Tensor | NDArray[Any],
    ground_truth: Tensor | NDArray[Any],
    *,
    valid: Tensor | NDArray[Any] | None = None,
) -> NormalScore:
    """Evaluate normals by their angle to ground truth, ignoring signs.

    The error of a point is ``arccos |n . t|`` in [0, 90] degrees; MSAE is the mean of its square
    (Figure 4 of the paper), RMS the root of MSAE.

    Convention:
        Points without an estimated normal (zero, non-finite, or not ``valid``) are not evaluated
        but counted in ``invalid``: check that count before comparing estimators that may abstain.
        Points without a ground-truth normal are ignored.

    Args:
        normals: Estimated normals of any length, shape ``(*, 3)``, floating point.
        ground_truth: Ground-truth normals, in the same form.
        valid: Mask of points with an estimated normal, shape ``(*)``, bool. Default: all.

    Returns:
        The errors; nan without evaluated points.

    Raises:
        ShapeError: If a shape, dtype or device is invalid.

    Example:
        >>> ground_truth = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1]])
        >>> score = score_normals(torch.tensor([[0.0, 0, -2], [0, 1, 1], [0, 0, 0]]), ground_truth)
        >>> round(score.msae, 6), round(score.mean, 6), score.under_5_deg, score.invalid
        (1012.5, 22.5, 0.5, 1)
    """
    normals = as_tensor("score_normals", "normals", normals)
    ground_truth = as_tensor("score_normals", "ground_truth", ground_truth)
    check_floating("score_normals", normals=normals)
    check_floating("score_normals", ground_truth=ground_truth)
    mask = torch.ones_like(normals[..., 0], dtype=torch.bool) if valid is None else valid
    mask = as_tensor("score_normals", "valid", mask)
    check_shapes(
        "score_normals",
        normals=(normals, "* 3"),
        ground_truth=(ground_truth, "* 3"),
        valid=(mask, "*"),
    )
    if mask.dtype != torch.bool:
        dtype = str(mask.dtype).removeprefix("torch.")
        raise ShapeError(f"score_normals: expected valid of bool, got {dtype}.")
    errors, scored, has_ground_truth = _angle_errors(
        normals.reshape(-1, 3), ground_truth.reshape(-1, 3)
    )
    scored &= mask.reshape(-1)
    invalid, errors = int((has_ground_truth & ~scored).sum()), errors[scored]
    count = len(errors)
    msae = float(errors.square().mean())
    middle = errors.sort().values[(count - 1) // 2 : count // 2 + 1] if count else errors
    under_5, under_10, under_20 = (float((errors < limit).double().mean()) for limit in _LIMITS_DEG)
    return NormalScore(
        msae=msae,
        rms=math.sqrt(msae),
        mean=float(errors.mean()),
        median=float(middle.mean()),
        under_5_deg=under_5,
        under_10_deg=under_10,
        under_20_deg=under_20,
        points=count,
        invalid=invalid,
    )


def _angle_errors(normals: Tensor, ground_truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return errors in degrees, and masks of evaluated points and of ground truth, ``(N,)``."""
    blocks = []
    for estimates, references in zip(
        torch.split(normals, _CHUNK), torch.split(ground_truth, _CHUNK), strict=True
    ):
        estimated, has_estimate = unit_vectors(estimates)
        true, has_ground_truth = unit_vectors(references)
        blocks.append(
            (unsigned_angle_deg(estimated, true), has_estimate & has_ground_truth, has_ground_truth)
        )
    errors, scored, has_ground_truth = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return errors, scored, has_ground_truth
