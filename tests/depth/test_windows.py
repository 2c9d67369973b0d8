"""Planes through windows of an image, and the noise they tell."""

import pytest
import torch

from torchrg.depth.windows import CELL_SIZES, Image, Windows, fit_windows, noise_by_size


def coordinates(height, width):
    u = torch.arange(width).double() - width / 2
    return u, torch.arange(height).double() - height / 2


def windows_of(*image):
    return {size: Windows(*table) for size, table in fit_windows(Image(*image)).items()}


@pytest.mark.parametrize("size", CELL_SIZES)
def test_windows_are_those_of_a_literal_least_squares_fit(rng, size):
    height, width = 6 * size + 1, 8 * size - 1
    u, v = coordinates(height, width)
    image = torch.randn(height, width, generator=rng, dtype=torch.float64)
    seen = torch.rand(height, width, generator=rng) < 0.8
    planes = windows_of(torch.where(seen, image, 1e6), seen, u, v)[size]
    assert planes.mean.shape == (-(-height // size), -(-width // size))
    for row, column in ((3, 3), (1, 1), (5, 5), (4, 0)):
        rows = slice(max(row - 2, 0) * size, (row + 3) * size)
        columns = slice(max(column - 2, 0) * size, (column + 3) * size)
        inside = torch.zeros_like(seen)
        inside[rows, columns] = seen[rows, columns]
        if int(inside.sum()) < 0.4 * (5 * size) ** 2:
            assert planes.deviation[row, column].isinf()
            continue
        x, y = u.expand_as(image)[inside], v[:, None].expand_as(image)[inside]
        matrix = torch.stack([x, y, torch.ones_like(x)], dim=1)
        solution = torch.linalg.lstsq(matrix, image[inside][:, None]).solution[:, 0]
        rest = image[inside] - matrix @ solution
        found = torch.stack([part[row, column] for part in planes[:5]])
        deviation = (rest.square().sum() / (len(x) - 3)).sqrt()
        expected = torch.stack([*solution, deviation, image[inside].mean()])
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-11)


def test_windows_without_enough_pixels_or_along_a_line_have_no_plane():
    u, v = coordinates(9, 9)
    image, line = torch.ones(9, 9).double(), torch.zeros(9, 9, dtype=torch.bool)
    line[4] = True
    for planes in windows_of(image, line, u, v).values():
        assert planes.deviation.isinf().all()
    thin = torch.ones(1, 9, dtype=torch.bool)
    for planes in windows_of(image[:1], thin, u, v[:1]).values():
        assert planes.deviation.isinf().all()


def test_noise_of_depth_is_found_whatever_its_growth(rng):
    u, v = coordinates(240, 320)
    inverse = 0.25 + (u + 160) * 0.004 + 0 * v[:, None]
    seen = torch.ones_like(inverse, dtype=torch.bool)
    for constant, growth in ((0.004, 0.0), (0.0, 0.002), (0.003, 0.0015)):
        level = growth + constant * inverse**2
        noisy = inverse + level * torch.randn(240, 320, generator=rng, dtype=torch.float64)
        noise = noise_by_size(fit_windows(Image(noisy, seen, u, v)), None, torch.float32)
        for size in CELL_SIZES:
            ratio = (noise[size].evaluate(inverse) / level)[16:-16, 16:-16]
            assert float(ratio.min()) > 0.7, (constant, growth, size)
            assert float(ratio.max()) < 1.3, (constant, growth, size)


def test_noise_that_is_given_is_taken(rng):
    u, v = coordinates(20, 20)
    inverse = 0.5 + torch.rand(20, 20, generator=rng, dtype=torch.float64)
    seen = torch.ones_like(inverse, dtype=torch.bool)
    noise = noise_by_size(fit_windows(Image(inverse, seen, u, v)), (0.01, 0.02), torch.float32)
    torch.testing.assert_close(noise[2].evaluate(inverse), 0.02 + 0.01 * inverse**2)
    assert noise[2] == noise[8]
