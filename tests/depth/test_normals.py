"""Planes chosen for the pixels of depth images."""

import pytest
import torch

from tests.depth.test_windows import coordinates
from torchrg.depth import normals
from torchrg.depth.normals import fit_pixels, min_in_windows
from torchrg.depth.windows import Image

FOCAL = (525.0, 525.0)


def test_least_in_windows_is_that_of_a_literal_search(rng):
    image = torch.rand(7, 9, generator=rng)
    values, places = min_in_windows(image, 2)
    for row in range(7):
        for column in range(9):
            window = image[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            assert values[row, column] == window.min()
    assert torch.equal(image.flatten()[places], values)


def test_windows_beside_a_step_are_flat_and_tell_the_edge():
    u, v = coordinates(30, 40)
    inverse = torch.where(u < 0, 0.5, 0.4).double().expand(30, 40)
    seen = torch.ones(30, 40, dtype=torch.bool)
    image = Image(inverse, seen, u, v)
    found = fit_pixels(image, focal=FOCAL, noise=None, dtype=torch.float32)
    assert found.flat.all()
    assert found.edge[0].any()
    assert not found.edge.all()


def test_narrow_windows_allow_for_the_jitter_of_rays(rng, monkeypatch):
    u, v = torch.arange(160).double() - 79.5, torch.arange(120).double() - 59.5
    moved = [torch.randn(120, 160, generator=rng).double() * 0.1 for _ in range(2)]
    inverse = 0.5 + 0.001 * (u + moved[0]).abs() + 0.0005 * (v[:, None] + moved[1])
    image = Image(inverse, torch.ones(120, 160, dtype=torch.bool), u, v)
    jitters = []

    def rate(*arguments, jitter=0.0, **options):
        jitters.append(jitter)
        rate_windows(*arguments, jitter=jitter, **options)

    rate_windows = normals.rate_windows
    monkeypatch.setattr(normals, "rate_windows", rate)
    fit_pixels(image, focal=FOCAL, noise=None, dtype=torch.float64)
    assert jitters[:-1] == [0.0] * len(normals.CELL_SIZES)
    assert jitters[-1] == pytest.approx(0.1, rel=0.15)
