"""What a robust fit returns."""

from typing import NamedTuple

import torch
from torch import Tensor


class RobustFit(NamedTuple):
    """Robust location and scatter of each patch.

    Attributes:
        location: Mean of the points in ``support``, shape ``(*, P)``.
        covariance: Their covariance with its consistency factor, shape ``(*, P, P)``. Of an exact
            fit: that of the points on the plane, singular, so that its eigenvector of the
            smallest eigenvalue is the plane's normal.
        support: Points that are not outliers, shape ``(*, K)``, bool.
        sq_distances: Squared Mahalanobis distances to the raw fit, shape ``(*, K)``; these decide
            ``support``. Of an exact fit: 0 on the plane and inf off it. Points that do not count,
            and all points of a patch that is not valid: inf.
        raw_location: Location before reweighting, shape ``(*, P)``.
        raw_covariance: Scatter before reweighting with its consistency factor, ``(*, P, P)``.
        raw_support: The points that ``raw_location`` and ``raw_covariance`` come from, ``(*, K)``.
        log_det: What the estimator minimised, shape ``(*)``; see its function. -inf for an exact
            fit, NaN where not valid.
        exact_fit: Whether the points in ``support`` lie exactly on one plane (a hyperplane of P
            coordinates) and are a majority, shape ``(*)``, bool.
        valid: Whether there is a fit, shape ``(*)``, bool. Where not, everything else is zero.
    """

    location: Tensor
    covariance: Tensor
    support: Tensor
    sq_distances: Tensor
    raw_location: Tensor
    raw_covariance: Tensor
    raw_support: Tensor
    log_det: Tensor
    exact_fit: Tensor
    valid: Tensor


def no_fit(batch: torch.Size, num_points: int, num_coordinates: int, like: Tensor) -> RobustFit:
    """Fits that are not valid, of the dtype and on the device of ``like``."""
    vector = like.new_zeros(*batch, num_coordinates)
    matrix = like.new_zeros(*batch, num_coordinates, num_coordinates)
    points = like.new_zeros(*batch, num_points, dtype=torch.bool)
    flag = like.new_zeros(batch, dtype=torch.bool)
    return RobustFit(
        location=vector,
        covariance=matrix,
        support=points,
        sq_distances=like.new_full((*batch, num_points), torch.inf),
        raw_location=vector.clone(),
        raw_covariance=matrix.clone(),
        raw_support=points.clone(),
        log_det=like.new_full(batch, torch.nan),
        exact_fit=flag,
        valid=flag.clone(),
    )
