"""Eigenvectors of many symmetric 3x3 matrices."""

import torch
from torch import Tensor

from torchrg._checks import check_floating, check_shapes

_JACOBI_SWEEPS = 5
_NEWTON_STEPS = 8
_NEARLY_EQUAL = 1e-9
"""Share of the squared largest eigenvalue below which the adjugate has no direction."""


def eigh3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    r"""Eigen-decompose symmetric 3x3 matrices by a fixed number of Jacobi rotations.

    Scale-free (each matrix is first divided by its largest entry), branch-free and elementwise, so
    it runs at the speed of memory on any device, where ``torch.linalg.eigh`` on tiny matrices is
    slow on the CPU and much slower on a GPU. Cyclic Jacobi keeps eigenvectors orthogonal to
    rounding even for equal eigenvalues, which closed formulas with ``acos`` do not.

    Args:
        matrices: Symmetric matrices, shape ``(*, 3, 3)``; only the upper triangle is read.

    Returns:
        Eigenvalues in ascending order ``(*, 3)`` and unit eigenvectors as columns ``(*, 3, 3)``.
        Signs are arbitrary. Gradients do not flow well through repeated eigenvalues.

    Raises:
        ShapeError: If the shape or dtype is not as above.

    References:
        [1] G. Golub, C. Van Loan. Matrix Computations, 4th ed., section 8.5.

    Example:
        >>> values, vectors = eigh3(torch.diag(torch.tensor([3.0, 1.0, 2.0])))
        >>> values, vectors[:, 0].abs()
        (tensor([1., 2., 3.]), tensor([0., 1., 0.]))
    """
    check_shapes("eigh3", matrices=(matrices, "* 3 3"))
    check_floating("eigh3", matrices=matrices)
    scale = matrices.abs().amax(dim=(-2, -1))
    safe = torch.where(scale > 0, scale, 1.0)[..., None, None]
    scaled = matrices / safe
    # Adding the scale's tiny reciprocal would overflow for denormal input; division does not.
    a = [[scaled[..., min(i, j), max(i, j)].contiguous() for j in range(3)] for i in range(3)]
    one, zero = torch.ones_like(a[0][0]), torch.zeros_like(a[0][0])
    v = [[one if i == j else zero for j in range(3)] for i in range(3)]
    for _ in range(_JACOBI_SWEEPS):
        for p, q, r in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            _rotate(a, v, p, q, r)
    values = torch.stack([a[i][i] for i in range(3)], dim=-1)
    vectors = torch.stack([torch.stack(row, dim=-1) for row in v], dim=-2)
    values, order = torch.sort(values, dim=-1)
    vectors = vectors.gather(-1, order[..., None, :].expand_as(vectors))
    return values * safe.squeeze(-1), vectors


def smallest_eigenvector3(matrices: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return eigenvalues and the first eigenvector of positive semi-definite 3x3 matrices.

    A third of the time of :func:`eigh3`, and more accurate for matrices of thin neighbourhoods: the
    smallest root of the characteristic polynomial by Newton's method from 0, which it approaches
    from one side, then a column of the adjugate of :math:`A - \lambda I`, both in double
    precision. Where the first two eigenvalues are equal to rounding, :func:`eigh3` answers.

    Args:
        matrices: Symmetric matrices without negative eigenvalues beyond rounding, shape
            ``(*, 3, 3)``; only the upper triangle is read.

    Returns:
        Eigenvalues in ascending order ``(*, 3)``, not negative, right to 1e-8 of the largest or to
        rounding, and unit eigenvectors of the first ``(*, 3)``. Signs are arbitrary.

    Raises:
        ShapeError: If the shape or dtype is not as above.

    Example:
        >>> values, normals = smallest_eigenvector3(torch.diag(torch.tensor([3.0, 1.0, 2.0])))
        >>> values, normals.abs()
        (tensor([1., 2., 3.]), tensor([0., 1., 0.]))
    """
    check_shapes("smallest_eigenvector3", matrices=(matrices, "* 3 3"))
    check_floating("smallest_eigenvector3", matrices=matrices)
    scale = matrices.abs().amax(dim=(-2, -1))
    safe = torch.where(scale > 0, scale, 1.0)
    upper = [matrices[..., i, j] for i in range(3) for j in range(i, 3)]
    xx, xy, xz, yy, yz, zz = torch.stack(upper).double() / safe
    trace = xx + yy + zz
    minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz)
    determinant = zz * (xx * yy - xy * xy) - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    root = torch.zeros_like(trace)
    for _ in range(_NEWTON_STEPS):
        value = ((root - trace) * root + minors) * root - determinant
        slope = (3 * root - 2 * trace) * root + minors
        root = root - value / slope
    root = torch.where(root.isfinite(), root, 0.0)
    x, y, z = xx - root, yy - root, zz - root
    diagonal = [y * z - yz * yz, x * z - xz * xz, x * y - xy * xy]
    a01, a02, a12 = xz * yz - xy * z, xy * yz - xz * y, xy * xz - x * yz
    use, best = diagonal[1] > diagonal[0], torch.maximum(diagonal[0], diagonal[1])
    vector = [
        torch.where(use, b, a) for a, b in ((diagonal[0], a01), (a01, diagonal[1]), (a02, a12))
    ]
    use, best = diagonal[2] > best, torch.maximum(best, diagonal[2])
    vector = [torch.where(use, b, a) for a, b in zip(vector, (a02, a12, diagonal[2]), strict=True)]
    length = (vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]).sqrt()
    u, v, w = (part / length for part in vector)
    # Where Newton's steps were still on their way, the quotient is right to second order.
    smallest = u * (u * xx + 2 * (v * xy + w * xz)) + v * (v * yy + 2 * w * yz) + w * w * zz
    smallest = smallest.clamp(min=0)
    rest = trace - smallest
    spread = (rest * rest - 4 * (minors - smallest * rest)).clamp(min=0).sqrt()
    ordered = torch.stack([smallest, (rest - spread) / 2, (rest + spread) / 2], dim=-1)
    values = (ordered.clamp(min=0) * safe[..., None]).to(matrices.dtype)
    vectors = torch.stack([u, v, w], dim=-1).to(matrices.dtype)
    equal = best < _NEARLY_EQUAL
    if bool(equal.any()):
        exact_values, exact_vectors = eigh3(matrices[equal])
        values[equal], vectors[equal] = exact_values.clamp(min=0), exact_vectors[..., 0]
    return values, vectors


def _rotate(a: list[list[Tensor]], v: list[list[Tensor]], p: int, q: int, r: int) -> None:
    """Zero the entry ``a[p][q]`` of symmetric matrices by one Jacobi rotation, in place."""
    apq = a[p][q]
    active = apq != 0
    tau = (a[q][q] - a[p][p]) / (2 * torch.where(active, apq, 1.0))
    # tau may overflow to infinity for a negligible apq; then t = 0, as it should be.
    t = torch.where(tau >= 0, 1.0, -1.0) / (tau.abs() + (1 + tau * tau).sqrt())
    t = torch.where(active, t, 0.0)
    c = 1 / (1 + t * t).sqrt()
    s = t * c
    a[p][p] = a[p][p] - t * apq
    a[q][q] = a[q][q] + t * apq
    arp, arq = a[r][p], a[r][q]
    a[r][p] = a[p][r] = c * arp - s * arq
    a[r][q] = a[q][r] = s * arp + c * arq
    a[p][q] = a[q][p] = torch.zeros_like(apq)
    for i in range(3):
        vip, viq = v[i][p], v[i][q]
        v[i][p] = c * vip - s * viq
        v[i][q] = s * vip + c * viq
