"""Raw fit to final fit: consistency factors, cut-off and reweighting, side by side."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import at_most
from torchrg.robust.lanes import join_columns, sum_points
from torchrg.robust.scatter import covariance_entries
from torchrg.robust.weights import chi2_quantile, consistency_factor


class Estimate(NamedTuple):
    """A fit of each lane; the fields of :class:`torchrg.robust.RobustFit`, points on axis 0.

    Attributes:
        location: Shape ``(M, P)``.
        covariance: Shape ``(M, P, P)``.
        support: Shape ``(K, M)``, bool.
        sq_distances: Shape ``(K, M)``.
        raw_location: Shape ``(M, P)``.
        raw_covariance: Shape ``(M, P, P)``.
        raw_support: Shape ``(K, M)``, bool.
        objective: What was minimised, a determinant, shape ``(M,)``, float64.
        singular: Whether ``raw_support`` lies on a hyperplane, shape ``(M,)``, bool.
    """

    location: Tensor
    covariance: Tensor
    support: Tensor
    sq_distances: Tensor
    raw_location: Tensor
    raw_covariance: Tensor
    raw_support: Tensor
    objective: Tensor
    singular: Tensor


class Reweighting(NamedTuple):
    """Mean and covariance of the points within the cut-off."""

    location: Tensor
    covariance: Tensor
    support: Tensor


def reweight(
    columns: list[Tensor], distances: Tensor, quantile: float, small_sample: float = 1.0
) -> Reweighting:
    """Take mean and covariance of the points within a chi-square quantile of a raw fit.

    The covariance has its consistency factor, and neither that nor the small-sample factor where
    no point is left out.

    Args:
        columns: P coordinates of shape ``(K, M)``.
        distances: Squared distances to the raw fit, shape ``(K, M)``.
        quantile: Level of the cut-off, below 1.
        small_sample: Factor for the covariance of few points.

    Returns:
        Location ``(M, P)``, covariance ``(M, P, P)`` and the points kept ``(K, M)``, bool.
    """
    size = len(columns)
    bound = distances.new_tensor([chi2_quantile(quantile, size)])
    weights = at_most(distances, bound)
    count = sum_points(weights)
    means = [sum_points(weights * column) / count.clamp(min=1) for column in columns]
    covariance = covariance_entries(columns, means, weights, (count - 1).clamp(min=1))
    factor = consistency_factor(quantile, size) * small_sample
    whole = count == len(distances)
    covariance = torch.where(whole[:, None, None], covariance, covariance * factor)
    return Reweighting(join_columns(means), covariance, weights > 0)
