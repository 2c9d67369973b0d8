"""Eigenvalues and eigenvectors of 3x3 matrices."""

import pytest
import torch

from torchrg.linalg import eigh3
from torchrg.linalg.eigen import principal_frame, smallest_eigenvector3

EIGEN_TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-14}


def random_symmetric(rng, dtype, count=500):
    half = torch.randn(count, 3, 3, generator=rng, dtype=torch.float64)
    spread = 10 ** (-6 * torch.rand(count, 1, 3, generator=rng, dtype=torch.float64))
    return ((half * spread) @ (half * spread).mT).to(dtype)


@pytest.mark.parametrize("unit", [1e-18, 1.0, 1e18])
def test_eigenvalues_and_vectors_agree_with_lapack(rng, dtype, unit):
    matrices = random_symmetric(rng, torch.float64).to(dtype) * unit
    values, vectors = eigh3(matrices)
    expected, _ = torch.linalg.eigh(matrices.double())
    largest = expected[:, 2:]
    assert ((values.double() - expected) / largest).abs().max() < EIGEN_TOLERANCE[dtype]
    residual = matrices.double() @ vectors.double() - vectors.double() * values.double()[:, None]
    assert (residual.abs().amax(dim=(1, 2)) / largest[:, 0]).max() < 4 * EIGEN_TOLERANCE[dtype]
    identity = vectors.double().mT @ vectors.double()
    assert (identity - torch.eye(3)).abs().max() < 4 * EIGEN_TOLERANCE[dtype]
    tolerance = max(EIGEN_TOLERANCE[dtype], 1e-8)
    values, smallest = smallest_eigenvector3(matrices)
    assert (values >= 0).all()
    assert ((values.double() - expected) / largest).abs().max() < tolerance
    residual = (matrices.double() @ smallest.double()[..., None]).squeeze(-1)
    residual -= smallest.double() * expected[:, :1]
    assert (residual.abs().amax(dim=1) / largest[:, 0]).max() < 4 * tolerance
    assert (smallest.double().norm(dim=1) - 1).abs().max() < 4 * EIGEN_TOLERANCE[dtype]


@pytest.mark.parametrize(
    "diagonal", [(0.0, 0, 0), (1, 1, 1), (1, 1, 2), (1, 1.001, 2), (1, 2, 2), (0, 0, 5), (0, 5, 5)]
)
def test_repeated_eigenvalues_give_orthonormal_vectors(dtype, diagonal):
    rotation = torch.linalg.qr(torch.tensor([[1.0, 2, 3], [0, 1, 4], [5, 6, 0]]).double())[0]
    matrix = (rotation @ torch.diag(torch.tensor(diagonal).double()) @ rotation.mT).to(dtype)
    values, vectors = eigh3(matrix)
    expected = torch.tensor(diagonal).double().sort().values
    assert torch.allclose(values.double(), expected, atol=1e-5)
    assert (vectors.mT @ vectors - torch.eye(3, dtype=dtype)).abs().max() < 1e-6
    values, vector = smallest_eigenvector3(matrix)
    assert torch.allclose(values.double(), expected, atol=1e-3)
    assert torch.allclose(matrix @ vector, values[0] * vector, atol=1e-3)


def test_normal_of_a_thin_neighborhood_is_right_to_rounding(rng):
    sides = torch.tensor([1.0, 0.5, 1e-4], dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(500, 3, 3, generator=rng, dtype=torch.float64))[0]
    matrices = (turn * sides**2) @ turn.mT
    values, vectors = smallest_eigenvector3(matrices)
    off = torch.linalg.cross(vectors, turn[..., 2]).norm(dim=1)
    assert off.max() < 1e-14
    assert (values[:, 0] / sides[2] ** 2 - 1).abs().max() < 1e-6


@pytest.mark.parametrize("gap", [1e-2, 3e-3, 1e-4, 1e-6])
def test_normal_beside_a_near_double_root_is_right(rng, gap):
    turn = torch.linalg.qr(torch.randn(4000, 3, 3, generator=rng, dtype=torch.float64))[0]
    values = 0.5 + 0.5 * torch.rand(4000, 1, generator=rng, dtype=torch.float64)
    values = values * torch.tensor([1.0, 1 + gap, 1.1], dtype=torch.float64)
    values[::2, 2] *= 20
    found, vectors = smallest_eigenvector3((turn * values[:, None]) @ turn.mT)
    off = torch.linalg.cross(vectors, turn[..., 0]).norm(dim=1)
    assert off.max() < 3e-14 / gap**2  # rounding, as of any root next to another
    assert (found[:, 1] / found[:, 0] - 1 - gap).abs().max() < 1e-6


def test_gradient_of_the_smallest_eigenvalue_is_that_of_its_direction():
    matrix = torch.diag(torch.tensor([3.0, 1.0, 2.0])).requires_grad_()
    principal_frame(matrix).smallest.backward()
    assert matrix.grad.diagonal().tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize("solve", [eigh3, smallest_eigenvector3])
def test_eigenvectors_do_not_depend_on_the_batch(rng, solve):
    matrices = random_symmetric(rng, torch.float32, count=257)
    values, vectors = solve(matrices)
    for start in (0, 1, 3, 100):
        part_values, part_vectors = solve(matrices[start : start + 77])
        assert torch.equal(part_values, values[start : start + 77])
        assert torch.equal(part_vectors, vectors[start : start + 77])
