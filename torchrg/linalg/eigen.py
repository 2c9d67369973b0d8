"""Eigenvectors of many symmetric 3x3 matrices in closed form."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrg._checks import (
    check_floating,
    check_shapes,
    is_concrete,
    is_jit_traced,
    raise_forward_mode,
)
from torchrg.linalg.precision import rank_tolerance, rounded_sqrt

_JACOBI_SWEEPS = 5
"""Number of sweeps over all three pairs after which 3x3 matrices are diagonal to rounding in either
dtype."""
_FIRST_STEPS, _MAX_MORE_STEPS = 4, 36
"""Number of Newton steps for a simple root, and maximum number of further steps for a nearly double
one, where each step halves the distance until the two roots separate."""
_STEPS_AT_ONCE = 6
"""Number of further steps before converged roots leave: counting them waits for a device."""
_CONVERGED = 1e-9
"""Maximum last step of a converged root, as a fraction of the trace."""
_NEARLY_EQUAL = 1e-9
"""Fraction of the squared largest eigenvalue below which the adjugate gives no direction."""


def eigh3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Eigen-decompose symmetric 3x3 matrices ``(*, 3, 3)`` by a fixed number of Jacobi rotations.

    Scale-free (each matrix is first divided by its largest entry), branch-free and elementwise. It
    is memory-bound on any device, whereas ``torch.linalg.eigh`` is slow on tiny matrices. Cyclic
    Jacobi [1] keeps eigenvectors orthogonal to rounding even for equal eigenvalues, unlike closed
    formulas with ``acos``. Only the upper triangle is read.

    Returns:
        Eigenvalues in ascending order ``(*, 3)`` and unit eigenvectors as columns ``(*, 3, 3)``.
        Signs are arbitrary. Gradients equal those of :func:`torch.linalg.eigh`, but are finite for
        equal eigenvalues: the undetermined rotation between their vectors is ignored, so that
        projectors and vectors of other eigenvalues have correct gradients.

    Raises:
        ShapeError: If the shape or dtype is invalid.

    References:
        [1] G. Golub, C. Van Loan. Matrix Computations, 4th ed., section 8.5.

    Example:
        >>> values, vectors = eigh3(torch.diag(torch.tensor([3.0, 1.0, 2.0])))
        >>> values, vectors[:, 0].abs()
        (tensor([1., 2., 3.]), tensor([0., 1., 0.]))
    """
    check_shapes("eigh3", matrices=(matrices, "* 3 3"))
    check_floating("eigh3", matrices=matrices)
    if not matrices.requires_grad and (is_concrete(matrices) or is_jit_traced()):
        return _jacobi(matrices)
    operation = _Eigh3 if torch.compiler.is_compiling() else _ReverseOnly
    values, vectors = operation.apply(matrices)  # type: ignore[no-untyped-call]
    return values, vectors


class _Eigh3(torch.autograd.Function):
    """Jacobi rotations with the gradient of eigenvalues and eigenvectors [1].

    With the off-diagonal ``W = V^T dV`` divided by ``l_j - l_i``, ``dA = V (diag(dl) + W) V^T``.

    References:
        [1] M. Giles. Collected matrix derivative results for forward and reverse mode algorithmic
        differentiation. Advances in Automatic Differentiation, 2008, section 3.1.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(matrices: Tensor) -> tuple[Tensor, Tensor]:
        return _jacobi(matrices)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:  # noqa: ANN401
        ctx.save_for_backward(*output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:  # noqa: ANN401
        (values, vectors), (of_values, of_vectors) = ctx.saved_tensors, gradients
        gap = values[..., None, :] - values[..., :, None]
        largest = values.detach().abs().amax(dim=-1)[..., None, None]
        distinct = gap.detach().abs() > rank_tolerance(3, values.dtype) * largest
        turn = (vectors.mT @ of_vectors) / torch.where(distinct, gap, 1.0)
        inner = torch.where(distinct, turn, 0.0) + torch.diag_embed(of_values)
        gradient: Tensor = vectors @ inner @ vectors.mT
        # Only the upper triangle is read, but both halves share the gradient, as in
        # torch.linalg.eigh.
        return (gradient + gradient.mT) / 2


class _ReverseOnly(_Eigh3):
    """The same outside of compilers, which reject operations with a rule for forward mode."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:  # noqa: ANN401
        raise_forward_mode("eigh3")


def rounded_eigenvectors3(matrices: Tensor) -> Tensor:
    """Return the eigenvectors of :func:`eigh3` without gradient, rounded as in kernels."""
    return _jacobi(matrices, rounded_sqrt)[1]


def _jacobi(
    matrices: Tensor, root: Callable[[Tensor], Tensor] = torch.sqrt
) -> tuple[Tensor, Tensor]:
    """Implement :func:`eigh3` without gradient, with square roots by ``root``."""
    scale = matrices.abs().amax(dim=(-2, -1))
    safe = torch.where(scale > 0, scale, 1.0)[..., None, None]
    scaled = matrices / safe
    # Multiplying by the reciprocal of a tiny scale would overflow for denormal input.
    a = [[scaled[..., min(i, j), max(i, j)].contiguous() for j in range(3)] for i in range(3)]
    one, zero = torch.ones_like(a[0][0]), torch.zeros_like(a[0][0])
    v = [torch.stack([one if i == j else zero for i in range(3)]) for j in range(3)]
    for _ in range(_JACOBI_SWEEPS):
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            _rotate(a, v, (p, q, r), root)
    values = torch.stack([a[i][i] for i in range(3)], dim=-1)
    vectors = torch.stack(v, dim=-1).movedim(0, -2)
    values, order = values.sort(dim=-1)
    vectors = vectors.gather(-1, order[..., None, :].expand_as(vectors))
    return values * safe.squeeze(-1), vectors


def smallest_eigenvector3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return eigenvalues and the first eigenvector of positive semidefinite 3x3 matrices.

    Takes a third of the time of :func:`eigh3`, and is more accurate for thin neighborhoods.
    Newton's method from 0 approaches the smallest root of the characteristic polynomial from one
    side; a column of the adjugate of :math:`A - \lambda I` is the eigenvector. Both are computed in
    double precision. If the first two eigenvalues are equal to rounding, it is any vector
    orthogonal to the third eigenvector.

    Returns ascending nonnegative eigenvalues ``(*, 3)``, accurate to 1e-8 of the largest or to
    rounding, and unit eigenvectors of the first ``(*, 3)``, of arbitrary sign.
    """
    scale = matrices.abs().amax(dim=(-2, -1))
    safe = torch.where(scale > 0, scale, 1.0)
    upper = [matrices[..., i, j] for i in range(3) for j in range(i, 3)]
    xx, xy, xz, yy, yz, zz = torch.stack(upper).double() / safe
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz)
    determinant = zz * (xx * yy - xy * xy) - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    root = _smallest_root(trace, minors, determinant)
    u, v, w = _null_vectors((xx - root, yy - root, zz - root), (yz, xz, xy))
    # If Newton's method has not converged, the Rayleigh quotient is accurate to second order.
    smallest = u * (u * xx + 2 * (v * xy + w * xz)) + v * (v * yy + 2 * w * yz) + w * w * zz
    smallest = smallest.clamp(min=0)
    others = trace - smallest
    spread = (others * others - 4 * (minors - smallest * others)).clamp(min=0).sqrt()
    ordered = torch.stack([smallest, (others - spread) / 2, (others + spread) / 2], dim=-1)
    values = ordered.clamp(min=0) * safe[..., None]
    return values.to(matrices.dtype), torch.stack([u, v, w], dim=-1).to(matrices.dtype)


def _smallest_root(trace: Tensor, minors: Tensor, determinant: Tensor) -> Tensor:
    """Return the smallest root of a characteristic polynomial without negative roots."""
    coefficients = torch.stack([values.reshape(-1) for values in (trace, minors, determinant)])
    root, step = _newton(torch.zeros_like(coefficients[0]), coefficients, _FIRST_STEPS)
    # Convergence is quadratic except near a double root, so few need more steps.
    rows = (step.abs() > _CONVERGED * coefficients[0]).nonzero().squeeze(1)
    for _ in range(_MAX_MORE_STEPS // _STEPS_AT_ONCE):
        if len(rows) == 0:
            break
        near, entries = root[rows], coefficients[:, rows]
        limit, moving = _CONVERGED * entries[0], torch.ones_like(near, dtype=torch.bool)
        for _ in range(_STEPS_AT_ONCE):
            new, step = _newton(near, entries, 1)
            near, moving = torch.where(moving, new, near), (step.abs() > limit) & moving
        root[rows], rows = near, rows[moving]
    return root.view_as(trace)


def _newton(root: Tensor, coefficients: Tensor, num_steps: int) -> tuple[Tensor, Tensor]:
    """Run Newton steps on trace, principal minors and determinant; return root and last step."""
    trace, minors, determinant = coefficients
    twice, step = 2 * trace, root
    for _ in range(num_steps):
        value = (root - trace).mul_(root).add_(minors).mul_(root).sub_(determinant)
        slope = (3 * root).sub_(twice).mul_(root).add_(minors)
        # At a multiple root both may be zero.
        step = value.div_(slope).nan_to_num_(0.0, 0.0, 0.0)
        root = root - step
    return root, step


def _null_vectors(
    diagonal: tuple[Tensor, Tensor, Tensor], off_diagonal: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return unit vectors in the kernel of singular semidefinite matrices.

    ``off_diagonal`` are the off-diagonal entries without coordinate 0, 1 and 2, respectively.
    """
    x, y, z = diagonal
    yz, xz, xy = off_diagonal
    # Any column of the adjugate works; the one with the largest diagonal entry is the longest.
    a, b, c = y * z - yz * yz, x * z - xz * xz, x * y - xy * xy
    ab, ac, bc = xz * yz - xy * z, xy * yz - xz * y, xy * xz - x * yz
    use, best = b > a, torch.maximum(a, b)
    u, v, w = torch.where(use, ab, a), torch.where(use, b, ab), torch.where(use, bc, ac)
    use, best = c > best, torch.maximum(best, c)
    u, v, w = torch.where(use, ac, u), torch.where(use, bc, v), torch.where(use, c, w)
    length = (u * u + v * v + w * w).sqrt()
    u, v, w = u / length, v / length, w / length
    rows = (best < _NEARLY_EQUAL).flatten().nonzero().squeeze(1)
    if len(rows):
        x, y, z, yz, xz, xy = (entry.take(rows) for entry in (*diagonal, *off_diagonal))
        others = _orthogonal((x, xy, xz), (xy, y, yz), (xz, yz, z))
        u, v, w = (old.put(rows, new) for old, new in zip((u, v, w), others, strict=True))
    return u, v, w


def _orthogonal(*rows: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return unit vectors orthogonal to the direction of rank-one matrices, given by their rows."""
    first, second, third = rows
    # The row of the largest diagonal entry, and the axis with its smallest component.
    use = second[1] > first[0]
    a, b, c = (torch.where(use, q, p) for p, q in zip(first, second, strict=True))
    use = third[2] > torch.maximum(first[0], second[1])
    a, b, c = (torch.where(use, q, p) for p, q in zip((a, b, c), third, strict=True))
    sizes = a.abs(), b.abs(), c.abs()
    y = sizes[1] < sizes[0]
    z = sizes[2] < torch.minimum(sizes[0], sizes[1])
    i, j, k = (~y & ~z).to(a.dtype), (y & ~z).to(a.dtype), z.to(a.dtype)
    u, v, w = b * k - c * j, c * i - a * k, a * j - b * i
    length = (u * u + v * v + w * w).sqrt()
    exists = length > 0
    return (
        torch.where(exists, u / length, i),
        torch.where(exists, v / length, j),
        torch.where(exists, w / length, k),
    )


def _rotate(
    a: list[list[Tensor]],
    v: list[Tensor],
    axes: tuple[int, int, int],
    root: Callable[[Tensor], Tensor],
) -> None:
    """Zero the entry of the first two axes of matrices by one Jacobi rotation, in place.

    ``a`` are the entries ``(*)``, ``v`` the columns ``(3, *)`` of the eigenvectors.
    """
    p, q, r = axes
    apq, zero = a[p][q], torch.zeros_like(a[p][q])
    # tau may overflow to infinity for a negligible apq, and is infinite or NaN for a zero.
    tau = (a[q][q] - a[p][p]) / (2 * apq)
    t = 1 / (tau.abs() + root(1 + tau * tau))
    t = torch.where(apq != 0, torch.where(tau >= 0, t, -t), zero)
    c = 1 / root(1 + t * t)
    s = t * c
    a[p][p] = a[p][p] - t * apq
    a[q][q] = a[q][q] + t * apq
    arp, arq = a[r][p], a[r][q]
    a[r][p] = a[p][r] = c * arp - s * arq
    a[r][q] = a[q][r] = s * arp + c * arq
    a[p][q] = a[q][p] = zero
    v[p], v[q] = c * v[p] - s * v[q], s * v[p] + c * v[q]


class PrincipalFrame(NamedTuple):
    """Eigen-decomposition of covariances; gradients flow through the first two fields.

    Unit eigenvectors ``(*, 3)`` of the smallest eigenvalues; these eigenvalues clamped to
    nonnegative ``(*)``; all eigenvalues ascending ``(*, 3)``; their unit eigenvectors as columns
    ``(*, 3, 3)``.
    """

    normals: Tensor
    smallest: Tensor
    values: Tensor
    vectors: Tensor


def principal_frame(matrices: Tensor) -> PrincipalFrame:
    """Decompose symmetric 3x3 matrices, with gradients of normal and smallest eigenvalue."""
    values, vectors = eigh3(matrices)
    smallest = values[..., 0].clamp(min=0)
    return PrincipalFrame(vectors[..., 0], smallest, values.detach(), vectors.detach())
