"""Height fields of degree two: what a smooth surface looks like from one of its points."""

from itertools import combinations_with_replacement

import torch
from torch import Tensor

from torchrg.normals.columns import Columns, along, sq_lengths

_NUM_TERMS = 6
_FLAT_PIVOT = 1e-5


def fit_paraboloids(
    columns: Columns, normals: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Fit ``h(u, v) = a + b u + c v + d u^2 + e u v + f v^2`` over a plane through each point.

    The normal at the point is that of the height field at ``u = v = 0``: a 2-jet [1], by normal
    equations. Terms that the neighbours cannot tell from the ones before, as on two scan lines,
    are left out.

    Args:
        columns: Coordinates of the neighbours about each point.
        normals: Directions of the heights, shape ``(n, 3)``, within some 60 degrees of the surface
            normal.
        counted: Weights 0 or 1, shape ``(n, K)``.

    Returns:
        Unit normals ``(n, 3)``, offsets ``(n,)`` of the tangent planes ``normal . q = offset``, and
        standard deviations of the residuals ``(n,)``: root of their sum of squares by the number of
        points less six.

    References:
        [1] F. Cazals, M. Pouget. Estimating differential quantities using polynomial fitting of
        osculating jets. Computer Aided Geometric Design 22, 2005.

    Example:
        >>> from torchrg.normals.columns import split_columns
        >>> grid = torch.cartesian_prod(torch.arange(-2.0, 3), torch.arange(-2.0, 3))
        >>> bowl = torch.cat([grid, grid.square().sum(dim=1, keepdim=True)], dim=1)[None]
        >>> up = torch.tensor([[0.0, 0.0, 1.0]])
        >>> normals, _, deviations = fit_paraboloids(split_columns(bowl), up, torch.ones(1, 25))
        >>> bool((normals - up).abs().max() < 1e-6), bool(deviations < 1e-5)
        (True, True)
    """
    radius = sq_lengths(columns).mul_(counted).amax(dim=1).sqrt_()
    scale = torch.where(radius > 0, 1 / radius, 0.0)[:, None]
    first, second = _tangents(normals)
    u, v, height = (along(columns, axis) * scale for axis in (first, second, normals))
    terms = [counted, u * counted, v * counted, u * u * counted, u * v * counted, v * v * counted]
    matrix = {
        (j, i): (terms[i] * terms[j]).sum(dim=1)
        for i, j in combinations_with_replacement(range(_NUM_TERMS), 2)
    }
    a, b, c, *bend = _solve(matrix, [(term * height).sum(dim=1) for term in terms])
    rest = height * counted
    for coefficient, term in zip((a, b, c, *bend), terms, strict=True):
        rest = rest.sub_(term * coefficient[:, None])
    freedom = (counted.sum(dim=1) - _NUM_TERMS).clamp_(min=1)
    deviations = (rest.square_().sum(dim=1) / freedom).sqrt_() * radius
    length = (1 + b * b + c * c).sqrt_()
    tilted = normals - b[:, None] * first - c[:, None] * second
    return tilted / length[:, None], a * radius / length, deviations


def _tangents(normals: Tensor) -> tuple[Tensor, Tensor]:
    """Return two unit vectors that complete each normal to an orthonormal frame [Duff 2017]."""
    x, y, z = normals.unbind(dim=-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    return first, torch.stack([b, sign + y * y * a, -y], dim=-1)


def _solve(matrix: dict[tuple[int, int], Tensor], right: list[Tensor]) -> list[Tensor]:
    """Solve positive semi-definite systems by LDL^T; a term without a pivot of its own gets 0."""
    size = len(right)
    lower: dict[tuple[int, int], Tensor] = {}
    inverse: list[Tensor] = []
    for j in range(size):
        column = {i: matrix[i, j] for i in range(j, size)}
        for k in range(j):
            scaled = lower[j, k] * inverse[k]
            for i in range(j, size):
                column[i] = column[i] - lower[i, k] * scaled
        usable = column[j] > _FLAT_PIVOT * matrix[j, j]
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
