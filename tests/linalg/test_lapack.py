"""Eigenvectors by LAPACK."""

import torch

from torchrg.linalg.lapack import eigh3_lapack


def test_a_matrix_that_is_not_finite_spoils_itself_alone():
    matrices = torch.diag(torch.tensor([3.0, 1.0, 2.0])).repeat(2, 1, 1)
    matrices[1, 0, 2] = torch.nan
    values, vectors = eigh3_lapack(matrices)
    assert values[0].tolist() == [1.0, 2.0, 3.0]
    assert vectors[0, :, 0].abs().tolist() == [0.0, 1.0, 0.0]
    assert values[1].isnan().all()
    assert vectors[1].isnan().all()
