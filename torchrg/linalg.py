"""Linear algebra of many tiny matrices, and the only numerical tolerances of the library.

Everything that can decide a label is built from ``+ - * /`` and ``sqrt`` alone: these are exact to
the last bit wherever an element stands in a tensor, so results do not depend on chunk size or on
the number of threads. Vectorised ``acos`` or ``cos`` do not promise that.
"""

import math

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import check_floating, check_shapes

_JACOBI_SWEEPS = 5
_NEWTON_STEPS = 8
_NEARLY_EQUAL = 1e-9
_ASIN_DEGREE = 10


def rank_tolerance(num_values: int, dtype: torch.dtype) -> float:
    """Return the singular value, relative to the largest, at which a direction counts as flat.

    Args:
        num_values: Number of points (or rows) that went into the matrix.
        dtype: Working precision.

    Returns:
        ``max(num_values, 3) * eps``.

    Example:
        >>> rank_tolerance(50, torch.float64) < 1e-13
        True
    """
    return max(num_values, 3) * torch.finfo(dtype).eps


def covariance(patches: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    r"""Return mean and covariance (denominator: the number of points) of each patch, eq. (1).

    Two passes about the first point of each patch: accurate far from the origin.

    Args:
        patches: Points, shape ``(*, K, P)``.
        mask: Which points count, shape ``(*, K)``, bool; the others may hold anything. Default:
            all.

    Returns:
        The mean ``(*, P)`` and the covariance ``(*, P, P)``. A patch without points has zeros.

    Raises:
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> mean, matrix = covariance(torch.tensor([[0.0, 0, 1], [2, 0, 1], [0, 4, 1], [2, 4, 1]]))
        >>> mean, matrix.diagonal()
        (tensor([1., 2., 1.]), tensor([1., 4., 0.]))
    """
    check_shapes("covariance", patches=(patches, "* K P"), mask=(mask, "* K"))
    check_floating("covariance", patches=patches)
    columns = patches.unbind(dim=-1)
    if mask is None:
        first = [column[..., :1] for column in columns]
        shifted = [column - start for column, start in zip(columns, first, strict=True)]
        count: Tensor | int = patches.shape[-2]
    else:
        # Any counted point serves as the local origin: the one with the largest mask value.
        anchor = mask.to(torch.uint8).argmax(dim=-1, keepdim=True)
        first = [column.gather(-1, anchor) for column in columns]
        shifted = [
            torch.where(mask, column - start, 0.0)
            for column, start in zip(columns, first, strict=True)
        ]
        count = mask.sum(dim=-1, keepdim=True).clamp(min=1)
    means = [column.sum(dim=-1, keepdim=True) / count for column in shifted]
    centered = [column - mean for column, mean in zip(shifted, means, strict=True)]
    if mask is not None:
        centered = [torch.where(mask, column, 0.0) for column in centered]
    total = count if isinstance(count, int) else count.squeeze(-1)
    size = len(columns)
    entries = {
        (i, j): (centered[i] * centered[j]).sum(dim=-1) / total
        for i in range(size)
        for j in range(i + 1)
    }
    rows = [
        torch.stack([entries[max(i, j), min(i, j)] for j in range(size)], dim=-1)
        for i in range(size)
    ]
    center = torch.cat([start + mean for start, mean in zip(first, means, strict=True)], dim=-1)
    if mask is not None:
        center = torch.where(mask.any(dim=-1, keepdim=True), center, 0.0)
    return center, torch.stack(rows, dim=-2)


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


def unsigned_angle_deg(a: Tensor, b: Tensor) -> Tensor:
    r"""Return the angle between directions without sign, in [0, 90] degrees, eq. (8).

    From the chord, ``2 asin(min(|a - b|, |a + b|) / 2)``: accurate for small angles, where the
    arc cosine of a float32 product is wrong by up to 0.02 degrees.

    Args:
        a: Unit vectors, shape ``(*, 3)``.
        b: Unit vectors, shape broadcastable to that of ``a``.

    Returns:
        Angles, shape ``(*)``.

    Example:
        >>> a = torch.tensor([[1.0, 0, 0], [1, 0, 0]])
        >>> unsigned_angle_deg(a, torch.tensor([[0.0, 1, 0], [-1, 0, 0]])).tolist()
        [90.0, 0.0]
    """
    dot = (a * b).sum(dim=-1, keepdim=True)
    chord = a - torch.where(dot < 0, -b, b)
    return sq_chord_to_deg((chord * chord).sum(dim=-1))


def sq_chord_to_deg(sq_chord: Tensor) -> Tensor:
    """Return the angle, in degrees, under which a chord of the unit sphere is seen.

    Args:
        sq_chord: Squared length of the chord, in [0, 2].

    Returns:
        Angles in [0, 90], same shape, right to 1e-7 (float32) or 1e-8 degrees (float64).

    Example:
        >>> sq_chord_to_deg(torch.tensor([0.0, 1.0, 2.0]))
        tensor([ 0.0000, 60.0000, 90.0000])
    """
    # asin(x) / x as a polynomial of x^2 on [0, 1/2], where x is half the chord.
    sq_half = (sq_chord / 4).clamp(max=0.5)
    result = torch.full_like(sq_half, _ASIN_SERIES[-1])
    for coefficient in _ASIN_SERIES[-2::-1]:
        result = result.mul_(sq_half).add_(coefficient)
    return result.mul_(sq_half.sqrt_()).mul_(math.degrees(2.0)).clamp_(max=90.0)


def _asin_series(degree: int) -> list[float]:
    """Return the Chebyshev approximation of asin(sqrt(s)) / sqrt(s) on [0, 1/2], lowest first."""
    nodes = 0.25 - 0.25 * np.cos((np.arange(200) + 0.5) * np.pi / 200)
    values = np.arcsin(np.sqrt(nodes)) / np.sqrt(nodes)
    fit = np.polynomial.Chebyshev.fit(nodes, values, degree, domain=[0, 0.5])
    coefficients = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef
    return [float(c) for c in coefficients]


_ASIN_SERIES = _asin_series(_ASIN_DEGREE)
