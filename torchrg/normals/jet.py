"""Quadratic height fields: normals and curvatures of curved surfaces."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.linalg import rank_tolerance
from torchrg.normals.frame import PrincipalFrame, root
from torchrg.normals.least_squares import least_squares
from torchrg.normals.pca import check_patches, fit_plane, patch_resolution
from torchrg.normals.query import about_query
from torchrg.normals.shape_operator import principal_curvatures, shape_operator
from torchrg.structures import NormalFit

_NUM_TERMS = 6


class JetFit(NamedTuple):
    """A quadratic surface through each neighbourhood; see :func:`fit_jet`.

    Attributes:
        normals: Unit normals of the surface at the query point, shape ``(*, 3)``; zero where not
            ``valid``. The sign is arbitrary.
        foot: Point of the surface above or below the query point, shape ``(*, 3)``.
        principal_curvatures: The larger and the smaller one, shape ``(*, 2)``, in 1 / unit of the
            cloud; positive where the surface bends towards ``normals``.
        principal_directions: Unit tangents of these, shape ``(*, 2, 3)``, of arbitrary sign; any
            two orthogonal ones where the two curvatures are equal.
        curvature: Surface variation, as of :func:`fit_normals_pca`, shape ``(*)``.
        valid: Whether there is a plane, shape ``(*)``, bool; all else is zero where not.
        residual_rms: Root mean square distance of the points to the surface along the normal of
            their plane, shape ``(*)``.
    """

    normals: Tensor
    foot: Tensor
    principal_curvatures: Tensor
    principal_directions: Tensor
    curvature: Tensor
    valid: Tensor
    residual_rms: Tensor


def fit_normals_jet(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> NormalFit:
    """Fit a quadratic surface to each patch and return its normal at the query point.

    See :func:`fit_jet`, which gives the principal curvatures too. ``curvature`` is the surface
    variation of PCA, so that regions grow in the same order; ``residual_rms`` belongs to the
    quadratic surface.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``, the query point first.
        mask: Which points count, shape ``(*, K)``, bool. Default: all.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``.

    Returns:
        The fit.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> x, y = torch.meshgrid(torch.arange(-2.0, 3), torch.arange(-2.0, 3), indexing="ij")
        >>> bowl = torch.stack([x, y, (x**2 + y**2) / 9], dim=-1).reshape(25, 3)
        >>> fit_normals_jet(bowl.roll(13, dims=0)).normals.abs().round(decimals=4)
        tensor([0., 0., 1.])
    """
    fit = fit_jet(patches, mask, resolution=resolution)
    return NormalFit(fit.normals, fit.curvature, fit.valid, fit.residual_rms)


def fit_jet(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> JetFit:
    r"""Fit a quadratic height field to each patch: a jet of degree 2 [1].

    In the frame of the patch's PCA with the query point as origin, the height ``w`` is fitted by
    least squares as ``a0 + a1 u + a2 v + a3 u^2/2 + a4 u v + a5 v^2/2``; the normal at the query
    is ``(-a1, -a2, 1)`` turned back, and the principal curvatures are the eigenvalues of the shape
    operator there. This is what CGAL's ``jet_estimate_normals`` does in degree 2.

    Convention:
        The query point is the first point of the patch that counts. Gradients flow through
        everything but the principal directions, and are finite where two eigenvalues are equal.

    Args:
        patches: Points of each neighbourhood, shape ``(*, K, 3)``, the query point first.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold anything, NaN
            included. Default: all.
        resolution: Size below which a coordinate difference is rounding, shape ``(*)``, in the unit
            of the cloud. Default: rounding of the patch's own coordinates.

    Returns:
        The fit. Terms that the points do not determine are left out, the last ones first: two
        straight scan lines have no ``v^2``; fewer than six points have no quadratic terms, which
        leaves the plane of PCA. ``valid`` is that of :func:`fit_normals_pca`.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    References:
        [1] F. Cazals, M. Pouget. Estimating differential quantities using polynomial fitting of
        osculating jets. Computer Aided Geometric Design 22(2), 2005.

    Example:
        >>> angle = torch.linspace(-0.3, 0.3, 7)
        >>> angle, along = torch.meshgrid(angle.roll(4), torch.arange(3.0) / 10, indexing="ij")
        >>> pipe = torch.stack([2 * angle.sin(), along, 2 * angle.cos()], dim=-1).reshape(21, 3)
        >>> fit_jet(pipe).principal_curvatures.abs().amax()
        tensor(0.5...)
    """
    check_patches("fit_jet", patches, mask, resolution)
    plane, frame = fit_plane(patches, mask, resolution=resolution)
    query, offsets = about_query(patches, mask)
    axes = _tangent_axes(frame)
    u, v, w = (offsets @ axes).unbind(dim=-1)
    rounding = patch_resolution(patches, mask) if resolution is None else resolution
    sides = [_mean_size(u), _mean_size(v)]
    terms, residual = _fit_height(u, v, w, sides, mask, rounding)
    height, slope_u, slope_v, *bend = terms
    normal, shape, tangents = shape_operator(slope_u, slope_v, *bend)
    curvatures, directions = principal_curvatures(shape, tangents)
    count = residual.shape[-1] if mask is None else mask.sum(dim=-1).clamp(min=1)
    valid = plane.valid
    return JetFit(
        torch.where(valid[..., None], (axes @ normal[..., None]).squeeze(-1), 0.0),
        torch.where(valid[..., None], query + height[..., None] * axes[..., 2], 0.0),
        torch.where(valid[..., None], curvatures, 0.0),
        torch.where(valid[..., None, None], directions @ axes.mT, 0.0),
        plane.curvature,
        valid,
        torch.where(valid, root((residual * residual).sum(dim=-1) / count), 0.0),
    )


def _tangent_axes(frame: PrincipalFrame) -> Tensor:
    """Return the longest, the middle and the normal direction as columns.

    The fit is the same for any two tangents, so only the normal needs gradients; the tangents just
    have to stay orthogonal to it.
    """
    normal, longest = frame.normals, frame.vectors[..., 2]
    tangent = longest - (longest * normal).sum(dim=-1, keepdim=True) * normal
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=-1)


def _mean_size(values: Tensor) -> Tensor:
    """Return the mean absolute value of each row, 1 for a row of zeros, shape ``(*, 1)``."""
    size = values.detach().abs().mean(dim=-1, keepdim=True)
    return torch.where(size > 0, size, 1.0)


def _fit_height(
    u: Tensor,
    v: Tensor,
    w: Tensor,
    sides: list[Tensor],
    mask: Tensor | None,
    rounding: Tensor,
) -> tuple[list[Tensor], Tensor]:
    """Return the six coefficients of the height field, shape ``(*)`` each, and the residuals."""
    count = u.shape[-1] if mask is None else mask.sum(dim=-1, keepdim=True)
    ones = torch.ones_like(u) if mask is None else mask.to(u.dtype)
    a, b = u / sides[0], v / sides[1]
    # Rounding of a coordinate, relative to the size of each column, hides dependent columns.
    rough = [rounding[..., None] / side for side in sides]
    exact = rank_tolerance(u.shape[-1], u.dtype)
    quadratic = torch.where(torch.as_tensor(count, device=u.device) < _NUM_TERMS, torch.inf, exact)
    columns: list[tuple[Tensor, Tensor | float]] = [
        (ones, exact),
        (a, exact + rough[0]),
        (b, exact + rough[1]),
        (a * a / 2, quadratic + 2 * rough[0]),
        (a * b, quadratic + rough[0] + rough[1]),
        (b * b / 2, quadratic + 2 * rough[1]),
    ]
    coefficients, residual = least_squares(columns, w)
    p, q = sides
    units = (torch.ones_like(p), p, q, p * p, p * q, q * q)
    terms = [(c / unit).squeeze(-1) for c, unit in zip(coefficients, units, strict=True)]
    return terms, residual
