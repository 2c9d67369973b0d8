"""Paraboloids agree with least squares by another route."""

import numpy as np
import torch

from torchrg.linalg.moments import unbind_columns
from torchrg.normals.jet import fit_paraboloids


def literal(patch, up):
    """Fit one height field with numpy's least squares."""
    helper = np.eye(3)[np.argmin(np.abs(up))]
    first = np.cross(up, helper)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    u, v, h = patch @ first, patch @ second, patch @ up
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    a, b, c = (solution := np.linalg.lstsq(design, h, rcond=None)[0])[:3]
    normal = up - b * first - c * second
    length = np.sqrt(1 + b * b + c * c)
    rest = h - design @ solution
    return normal / length, a / length, np.sqrt((rest**2).sum() / (len(u) - 6))


def test_fit_is_that_of_numpy(rng):
    patches = torch.randn(40, 30, 3, generator=rng, dtype=torch.float64)
    patches[:, 0] = 0
    ups = torch.nn.functional.normalize(torch.randn(40, 3, generator=rng).double(), dim=1)
    found = fit_paraboloids(unbind_columns(patches), ups, torch.ones(40, 30).double())
    for row in range(40):
        normal, offset, deviation = literal(patches[row].numpy(), ups[row].numpy())
        assert np.allclose(found[0][row].numpy(), normal, atol=1e-8)
        assert np.isclose(float(found[1][row]), offset, atol=1e-8)
        assert np.isclose(float(found[2][row]), deviation, atol=1e-8)


def test_two_scan_lines_give_their_plane():
    line = torch.linspace(-1, 1, 15)
    lines = torch.stack([line.repeat(2), torch.tensor([0.0, 0.5]).repeat_interleave(15)], dim=1)
    patch = torch.cat([lines, torch.zeros(30, 1)], dim=1)[None]
    up = torch.tensor([[0.0, 0.0, 1.0]])
    normals, offsets, deviations = fit_paraboloids(unbind_columns(patch), up, torch.ones(1, 30))
    assert torch.allclose(normals, up)
    assert float(offsets.abs() + deviations) < 1e-6
