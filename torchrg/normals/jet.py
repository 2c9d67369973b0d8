"""Quadratic height fields: normals and curvatures of curved surfaces.

Jets support gradients and match CGAL's accuracy in float64, so they are fitted by
orthogonalization. The consensus paraboloids need three digits and no gradient: normal equations
square the condition number but take half the time.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._checks import disable_autocast
from torchrg.linalg.eigen import PrincipalFrame
from torchrg.linalg.moments import Columns, project, sq_lengths, sum_neighbors
from torchrg.linalg.precision import rank_tolerance, rounded_sqrt, safe_sqrt
from torchrg.normals.pca import center_on_first, check_patches, fit_plane, patch_resolution
from torchrg.structures.points import NormalFit, short_repr

_NUM_TERMS = 6
"""Number of terms of a quadratic in two coordinates, and the minimum number of points."""
FLAT_PIVOT = 1e-5
"""Minimum fraction of its squared length that a paraboloid term must retain after the terms before
it are removed. Normal equations in float32 then give the retained length fraction, the root of
this, 3e-3, to within one percent."""


def fit_normals_jet(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> NormalFit:
    """Fit a quadratic surface to each patch and return its normal at the point itself.

    See :func:`fit_jet`, which also returns the principal curvatures. ``curvature`` is the surface
    variation of PCA; ``residual_rms`` belongs to the quadratic surface.

    Example:
        >>> x, y = torch.meshgrid(torch.arange(-2.0, 3), torch.arange(-2.0, 3), indexing="ij")
        >>> bowl = torch.stack([x, y, (x**2 + y**2) / 9], dim=-1).reshape(25, 3)
        >>> fit_normals_jet(bowl.roll(13, dims=0)).normals.abs().round(decimals=4)
        tensor([0., 0., 1.])
    """
    fit = fit_jet(patches, mask, resolution=resolution)
    return NormalFit(fit.normals, fit.curvature, fit.valid, fit.residual_rms)


@short_repr
class JetFit(NamedTuple):
    """A quadratic surface per neighborhood, zero if not valid; see :func:`fit_jet`.

    Attributes:
        normals: Unit normals of the surface at the point itself, shape ``(*, 3)``, of any sign.
        foot: Point of the surface above or below it, shape ``(*, 3)``.
        principal_curvatures: Maximum and minimum, shape ``(*, 2)``, in 1 / coordinate unit;
            positive if the surface bends towards ``normals``.
        principal_directions: Their unit tangents, shape ``(*, 2, 3)``, of arbitrary sign; any two
            orthogonal ones if the curvatures are equal.
        curvature: Surface variation, as in :func:`torchrg.normals.fit_normals_pca`, shape ``(*)``.
        valid: Whether there is a plane, shape ``(*)``, bool.
        residual_rms: RMS distance of the points to the surface along the normal of their plane,
            shape ``(*)``.
    """

    normals: Tensor
    foot: Tensor
    principal_curvatures: Tensor
    principal_directions: Tensor
    curvature: Tensor
    valid: Tensor
    residual_rms: Tensor


@disable_autocast
def fit_jet(
    patches: Tensor, mask: Tensor | None = None, *, resolution: Tensor | None = None
) -> JetFit:
    """Fit a quadratic height field to each patch: a jet of degree 2 [1].

    In the PCA frame of the patch about the point itself, the first counted one of the patch, the
    height ``w`` is fitted by least squares as ``a0 + a1 u + a2 v + a3 u^2/2 + a4 u v + a5 v^2/2``.
    The normal at the point is ``(-a1, -a2, 1)`` rotated back, and the principal curvatures are the
    eigenvalues of the shape operator. This equals CGAL's ``jet_estimate_normals`` of degree 2.

    For arguments and errors see :func:`torchrg.normals.fit_normals_pca`. Gradients flow through
    everything but the principal directions, and are finite if two eigenvalues are equal.

    Returns:
        The fit. Terms not determined by the points are omitted, the last ones first. Two straight
        scan lines have no ``v^2``; fewer than six points have no quadratic terms, which leaves the
        PCA plane. For ``valid`` see :func:`torchrg.normals.fit_normals_pca`.

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
    plane, frame = fit_plane(patches, mask, resolution)
    position, offsets = center_on_first(patches, mask)
    axes = _tangent_axes(frame)
    u, v, w = (offsets @ axes).unbind(dim=-1)
    rounding = patch_resolution(patches, mask) if resolution is None else resolution
    (height, *derivatives), residual = _fit_height(u, v, w, mask, rounding)
    normal, curvatures, directions = _principal_curvatures(*derivatives)
    count = residual.shape[-1] if mask is None else mask.sum(dim=-1).clamp(min=1)
    valid = plane.valid
    return JetFit(
        torch.where(valid[..., None], (axes @ normal[..., None]).squeeze(-1), 0.0),
        torch.where(valid[..., None], position + height[..., None] * axes[..., 2], 0.0),
        torch.where(valid[..., None], curvatures, 0.0),
        torch.where(valid[..., None, None], directions @ axes.mT, 0.0),
        plane.curvature,
        valid,
        torch.where(valid, safe_sqrt((residual * residual).sum(dim=-1) / count), 0.0),
    )


def fit_paraboloids(
    columns: Columns, normals: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit ``h(u, v) = a + b u + c v + d u^2 + e u v + f v^2`` over a plane through each point.

    The normal at the point is that of the height field at ``u = v = 0``: the 2-jet of
    :func:`fit_jet` in another frame, by normal equations. Terms not determined by the neighbors, as
    on two scan lines, are omitted. The heights are along ``normals`` ``(n, 3)``, within about 60
    degrees of the surface normal; ``counted`` are weights 0 or 1.

    Returns unit normals ``(n, 3)``, offsets ``(n,)`` of the tangent planes ``normal . q = offset``,
    and standard deviations of the residuals ``(n,)``, with six degrees of freedom less.
    """
    radius = rounded_sqrt(sq_lengths(columns).mul_(counted).amax(dim=1))
    scale = torch.where(radius > 0, 1 / radius, 0.0)[:, None] * counted
    first, second = _tangents(normals)
    u, v, height = (project(columns, axis) * scale for axis in (first, second, normals))
    terms = _quadratic_terms(counted, u, v)
    matrix = {
        (j, i): sum_neighbors(terms[i] * terms[j])
        for i, j in combinations_with_replacement(range(_NUM_TERMS), 2)
    }
    solution = _solve(matrix, [sum_neighbors(term * height) for term in terms])
    for coefficient, term in zip(solution, terms, strict=True):
        height.sub_(term * coefficient[:, None])
    freedom = (counted.sum(dim=1) - _NUM_TERMS).clamp_(min=1)
    deviations = rounded_sqrt(sum_neighbors(height.square_()) / freedom) * radius
    a, b, c = solution[:3]
    length = rounded_sqrt(1 + b * b + c * c)
    tilted = normals - b[:, None] * first - c[:, None] * second
    return tilted / length[:, None], a * radius / length, deviations


def _tangent_axes(frame: PrincipalFrame) -> Tensor:
    """Return the longest, the middle and the normal direction as columns.

    The fit is the same for any two tangents, so only the normal needs gradients; the tangents only
    have to stay orthogonal to it.
    """
    normal, longest = frame.normals, frame.vectors[..., 2]
    tangent = longest - (longest * normal).sum(dim=-1, keepdim=True) * normal
    return torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], dim=-1)


def _fit_height(
    u: Tensor, v: Tensor, w: Tensor, mask: Tensor | None, rounding: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Return height, slopes and second derivatives, shape ``(*)`` each, and the residuals."""
    count = u.shape[-1] if mask is None else mask.sum(dim=-1, keepdim=True)
    ones = torch.ones_like(u) if mask is None else mask.to(u.dtype)
    sides = [_mean_size(u), _mean_size(v)]
    # Coordinate rounding, relative to the column size, hides dependent columns.
    rounding_ratio = [rounding[..., None] / side for side in sides]
    exact = rank_tolerance(u.shape[-1], u.dtype)
    quadratic = torch.where(torch.as_tensor(count, device=u.device) < _NUM_TERMS, torch.inf, exact)
    fractions = (
        exact,
        exact + rounding_ratio[0],
        exact + rounding_ratio[1],
        quadratic + 2 * rounding_ratio[0],
        quadratic + rounding_ratio[0] + rounding_ratio[1],
        quadratic + 2 * rounding_ratio[1],
    )
    terms = _quadratic_terms(ones, u / sides[0], v / sides[1])
    coefficients, residual = least_squares(list(zip(terms, fractions, strict=True)), w)
    p, q = sides
    units = (torch.ones_like(p), p, q, p * p / 2, p * q, q * q / 2)
    derivatives = [(c / unit).squeeze(-1) for c, unit in zip(coefficients, units, strict=True)]
    return derivatives, residual


def _mean_size(values: Tensor) -> Tensor:
    """Return the mean absolute value of each row, 1 for a row of zeros, shape ``(*, 1)``."""
    size = values.detach().abs().mean(dim=-1, keepdim=True)
    return torch.where(size > 0, size, 1.0)


def _quadratic_terms(ones: Tensor, u: Tensor, v: Tensor) -> list[Tensor]:
    """Return the terms of a quadratic height field, all zero for points that do not count."""
    return [ones, u, v, u * u, u * v, v * v]


def least_squares(
    columns: Sequence[tuple[Tensor, Tensor | float]], target: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Fit a target ``(*, K)`` by columns, omitting columns that depend on previous ones.

    Modified Gram-Schmidt with the target as the last column: as accurate as Householder QR. Made
    only of sums of products, it is batched on any device and differentiable. Each column comes with
    the minimum fraction of its length that must remain. Returns the coefficient of each column,
    shape ``(*, 1)``, 0 if omitted, and the residual.
    """
    basis: list[Tensor] = []
    mixing: list[list[Tensor]] = []
    for column, fraction in columns:
        residual, mix = column, []
        for direction in basis:
            mix.append((direction * residual).sum(dim=-1, keepdim=True))
            residual = residual - mix[-1] * direction
        square = (residual * residual).sum(dim=-1, keepdim=True)
        is_independent = square > fraction * fraction * (column * column).sum(dim=-1, keepdim=True)
        length = torch.where(is_independent, square, 1.0).sqrt()
        basis.append(torch.where(is_independent, residual / length, 0.0))
        mixing.append([*mix, length])
    projections = []
    for direction in basis:
        projections.append((direction * target).sum(dim=-1, keepdim=True))
        target = target - projections[-1] * direction
    coefficients: list[Tensor] = []
    for row in reversed(range(len(basis))):
        total = sum(
            (mixing[row + 1 + i][row] * c for i, c in enumerate(coefficients)),
            start=torch.zeros_like(projections[row]),
        )
        coefficients.insert(0, (projections[row] - total) / mixing[row][row])
    return coefficients, target


def _principal_curvatures(
    slope_u: Tensor, slope_v: Tensor, uu: Tensor, uv: Tensor, vv: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return unit normals of height fields, principal curvatures and their directions.

    The inputs are first and second derivatives. Returns normals of positive height ``(*, 3)``,
    curvatures ``(*, 2)``, larger first, and directions ``(*, 2, 3)``, without gradient. Curvatures
    are the eigenvalues of the shape operator with entries aa, ab, bb in an orthonormal tangent
    basis.
    """
    one = torch.ones_like(slope_u)
    gradient = (slope_u * slope_u + slope_v * slope_v + 1).sqrt()
    normal = torch.stack([-slope_u, -slope_v, one], dim=-1) / gradient[..., None]
    length = (slope_u * slope_u + 1).sqrt()
    first = torch.stack([one, torch.zeros_like(one), slope_u], dim=-1) / length[..., None]
    second = torch.linalg.cross(normal, first)
    au, bu, bv = first[..., 0], second[..., 0], second[..., 1]
    aa = au * au * uu / gradient
    ab = au * (bu * uu + bv * uv) / gradient
    bb = (bu * bu * uu + 2 * bu * bv * uv + bv * bv * vv) / gradient
    middle, half = (aa + bb) / 2, (aa - bb) / 2
    radius = safe_sqrt(half * half + ab * ab)
    values = torch.stack([middle + radius, middle - radius], dim=-1)
    with torch.no_grad():
        # The longer of the two rows of (S - k1) is orthogonal to the first direction.
        a = torch.where(half >= 0, half + radius, ab)
        b = torch.where(half >= 0, ab, radius - half)
        size = safe_sqrt(a * a + b * b)
        umbilic = size == 0
        a = torch.where(umbilic, 1.0, a / torch.where(umbilic, 1.0, size))
        b = torch.where(umbilic, 0.0, b / torch.where(umbilic, 1.0, size))
        turn = torch.stack([torch.stack([a, b], dim=-1), torch.stack([-b, a], dim=-1)], dim=-2)
        directions = turn @ torch.stack([first, second], dim=-2)
    return normal, values, directions


def _tangents(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors that complete each normal to an orthonormal frame [Duff 2017]."""
    x, y, z = normals.unbind(dim=-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    return first, torch.stack([b, sign + y * y * a, -y], dim=-1)


def _solve(matrix: dict[tuple[int, int], Tensor], right: list[Tensor]) -> list[Tensor]:
    """Solve positive semidefinite systems by LDL^T; terms without a usable pivot are 0."""
    size = len(right)
    lower: dict[tuple[int, int], Tensor] = {}
    inverse: list[Tensor] = []
    for j in range(size):
        column = {i: matrix[i, j] for i in range(j, size)}
        for k in range(j):
            scaled = lower[j, k] * inverse[k]
            for i in range(j, size):
                column[i] = column[i] - lower[i, k] * scaled
        usable = column[j] > FLAT_PIVOT * matrix[j, j]
        inverse.append(torch.where(usable, 1 / torch.where(usable, column[j], 1.0), 0.0))
        lower.update({(i, j): column[i] for i in range(j, size)})
    forward: list[Tensor] = []
    for i in range(size):
        value = right[i]
        for k in range(i):
            value = value - lower[i, k] * forward[k]
        forward.append(value * inverse[i])
    solution: list[Tensor] = forward
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            solution[i] = solution[i] - lower[k, i] * inverse[i] * solution[k]
    return solution
