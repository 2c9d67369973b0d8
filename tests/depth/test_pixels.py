"""Windows that contain pixels."""

import torch

from tests.depth.test_normals import FOCAL
from tests.depth.test_windows import coordinates
from torchrg.depth.normals import fit_pixels
from torchrg.depth.pixels import contain
from torchrg.depth.windows import CELL_SIZES, Image


def test_a_window_holds_the_pixels_of_its_square(rng):
    height, width = 26, 37
    u, v = coordinates(height, width)
    image = 1 + 0.05 * torch.randn(height, width, generator=rng, dtype=torch.float64)
    image += torch.where(u < 3, 0.0, 2.0)
    seen = torch.ones(height, width, dtype=torch.bool)
    found = fit_pixels(Image(image, seen, u, v), focal=FOCAL, noise=None, dtype=torch.float32)
    squares = [
        (size * (row - 2), size * (row + 3), size * (column - 2), size * (column + 3))
        for size in sorted(CELL_SIZES)
        for row in range(-(-height // size))
        for column in range(-(-width // size))
    ]
    pixels, others = torch.randint(height * width, (2, 400), generator=rng)
    _, sides, middles = found.select(pixels)
    expected, lengths = [], []
    for pixel, other in zip(pixels.tolist(), others.tolist(), strict=True):
        top, bottom, left, right = squares[int(found.window.flatten()[pixel])]
        row, column = divmod(other, width)
        expected.append(top <= row < bottom and left <= column < right)
        lengths.append([bottom - top, right - left])
    assert sides.T.tolist() == lengths
    assert contain(sides, middles, others, width).tolist() == expected
    assert any(expected)
    assert not all(expected)
