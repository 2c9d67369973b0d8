"""Planes chosen for the pixels of depth images."""

import torch

from tests.depth.test_windows import coordinates
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
    found = fit_pixels(image, focal=FOCAL, noise=None, dtype=torch.float32).choice
    assert found.flat.all()
    assert found.edge[0].any()
    assert not found.edge.all()
