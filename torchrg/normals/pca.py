"""Least-squares planes: the classic estimator, and the last step of every robust one."""

import torch
from torch import Tensor

from torchrg._checks import check_floating, check_shapes
from torchrg.linalg import covariance, eigh3, rank_tolerance
from torchrg.structures import NormalFit


def fit_normals_pca(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> NormalFit:
    r"""Fit a plane to each patch by least squares and return its normal.

    The normal is the eigenvector of the smallest eigenvalue ``l0`` of the covariance [1], eq. (1);
    the curvature is the surface variation ``l0 / (l0 + l1 + l2)`` [2], eq. (2).

    Convention:
        The sign of a normal is arbitrary. Gradients flow through normals, curvature and residual,
        and are finite where two eigenvalues are equal: the turn between the two is left out.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold anything, NaN
            included. Default: all.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``, in the unit
            of the cloud. Default: rounding of the patch's own coordinates.

    Returns:
        The fit. A patch of fewer than three points, or whose points lie on one line, is not an
        error: it has ``valid`` False, a zero normal and curvature 0.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    References:
        [1] H. Hoppe et al. Surface reconstruction from unorganized points. SIGGRAPH, 1992.
        [2] M. Pauly, M. Gross, L. Kobbelt. Efficient simplification of point-sampled surfaces.
        IEEE Visualization, 2002.

    Example:
        >>> patches = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
        >>> fit_normals_pca(patches).normals.abs()
        tensor([0., 0., 1.])
    """
    check_shapes("fit_normals_pca", patches=(patches, "* K 3"), mask=(mask, "* K"))
    check_shapes("fit_normals_pca", patches=(patches[..., 0, 0], "*"), resolution=(resolution, "*"))
    check_floating("fit_normals_pca", patches=patches, resolution=resolution)
    _, matrix = covariance(patches, mask)
    with torch.no_grad():
        values, vectors = eigh3(matrix)
        valid = _spans_a_plane(patches, mask, values, resolution)
    normals, smallest = vectors[..., 0], values[..., 0].clamp(min=0)
    if matrix.requires_grad:
        normals, smallest = _differentiable(matrix, values, vectors)
    total = matrix.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    curvature = (smallest / torch.where(total > 0, total, 1.0)).clamp(max=1 / 3)
    rms = torch.where(smallest > 0, smallest, 1.0).sqrt() * (smallest > 0)
    return NormalFit(
        torch.where(valid[..., None], normals, 0.0),
        torch.where(valid, curvature, 0.0),
        valid,
        residual_rms=torch.where(valid, rms, 0.0),
    )


def _spans_a_plane(
    patches: Tensor, mask: Tensor | None, values: Tensor, resolution: Tensor | None
) -> Tensor:
    """Return whether the second direction of each patch is more than rounding.

    A covariance holds squares, so its own rounding hides widths below 1e-3 of the length in
    float32; the few patches as narrow as that are decided in double precision.
    """
    num_points = patches.shape[-2]
    longest, second = values[..., 2], values[..., 1]
    valid = longest > 0
    narrow = valid & (second < 1e-3 * longest)
    if patches.dtype == torch.float32 and bool(narrow.any()):
        inside = None if mask is None else mask[narrow]
        exact, _ = eigh3(covariance(patches[narrow].double(), inside)[1])
        longest, second = longest.double(), second.double()
        longest[narrow], second[narrow] = exact[:, 2], exact[:, 1]
    flat = rank_tolerance(num_points, patches.dtype) * longest.clamp(min=0).sqrt()
    if resolution is not None:
        flat = torch.maximum(flat, resolution.to(flat.dtype))
    valid = valid & (second.clamp(min=0).sqrt() > flat)
    if mask is not None:
        valid = valid & (mask.sum(dim=-1) >= 3)
    return valid


def _differentiable(matrix: Tensor, values: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the first eigenvector and eigenvalue with their first-order gradients.

    With the decomposition held constant, one step of perturbation theory changes nothing in value
    and everything in gradient: ``dn = sum_j v_j (v_j . dA n) / (l0 - l_j)``.
    """
    smallest, normal = values[..., :1], vectors[..., :1]
    gap = smallest - values[..., 1:]
    distinct = gap.abs() > rank_tolerance(3, values.dtype) * values[..., 2:]
    turn = (vectors[..., 1:].mT @ (matrix @ normal)).squeeze(-1)
    turn = turn - turn.detach()
    step = torch.where(distinct, turn / torch.where(distinct, gap, 1.0), 0.0)
    moved = normal.squeeze(-1) + (vectors[..., 1:] @ step[..., None]).squeeze(-1)
    value = (normal.mT @ matrix @ normal).squeeze(-1)
    value = smallest + value - value.detach()
    return moved, value.squeeze(-1).clamp(min=0)
