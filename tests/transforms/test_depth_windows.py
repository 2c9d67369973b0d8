"""Planes through windows of an image, and the noise they tell."""

import torch

from torchrg.depth.normals import (
    RADII,
    fit_pixels,
    fit_windows,
    least_in_windows,
    moved,
    noise_by_radius,
)


def coordinates(height, width):
    u = torch.arange(width).double() - width / 2
    return u, torch.arange(height).double()[:, None] - height / 2


def test_windows_are_those_of_a_literal_least_squares_fit(rng):
    u, v = coordinates(11, 13)
    image = torch.randn(11, 13, generator=rng, dtype=torch.float64)
    seen = torch.rand(11, 13, generator=rng) < 0.8
    planes = fit_windows(torch.where(seen, image, 1e6), seen, u, v, 2)
    for row, column in ((5, 6), (1, 1), (10, 12), (4, 0)):
        rows, columns = slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3)
        inside = torch.zeros_like(seen)
        inside[rows, columns] = seen[rows, columns]
        if int(inside.sum()) < 10:
            assert planes.deviation[row, column].isinf()
            continue
        x, y = u.expand_as(image)[inside], v.expand_as(image)[inside]
        matrix = torch.stack([x, y, torch.ones_like(x)], dim=1)
        solution = torch.linalg.lstsq(matrix, image[inside][:, None]).solution[:, 0]
        rest = image[inside] - matrix @ solution
        found = torch.stack([part[row, column] for part in planes])
        expected = [*solution, (rest.square().sum() / (len(x) - 3)).sqrt()]
        torch.testing.assert_close(found, torch.stack(expected), rtol=1e-9, atol=1e-11)


def test_windows_without_enough_pixels_or_along_a_line_have_no_plane():
    u, v = coordinates(9, 9)
    image, line = torch.ones(9, 9).double(), torch.zeros(9, 9, dtype=torch.bool)
    line[4] = True
    assert fit_windows(image, line, u, v, 2).deviation.isinf().all()
    thin = torch.ones(1, 9, dtype=torch.bool)
    assert fit_windows(image[:1], thin, u, v[:1], 2).deviation.isinf().all()


def test_least_in_windows_is_that_of_a_literal_search(rng):
    image = torch.rand(7, 9, generator=rng)
    values, places = least_in_windows(image, 2)
    for row in range(7):
        for column in range(9):
            window = image[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
            assert values[row, column] == window.min()
    assert torch.equal(image.flatten()[places], values)


def test_moved_looks_at_the_pixel_a_step_away():
    image = torch.arange(12).view(3, 4)
    assert moved(image, (1, -1), fill=-1).tolist() == [[-1, 4, 5, 6], [-1, 8, 9, 10], [-1] * 4]
    assert moved(image, (4, -5), fill=7).eq(7).all()


def test_noise_of_depth_is_found_whatever_its_growth(rng):
    u, v = coordinates(240, 320)
    inverse = 0.25 + (u + 160) * 0.004 + 0 * v
    seen = torch.ones_like(inverse, dtype=torch.bool)
    for constant, growth in ((0.004, 0.0), (0.0, 0.002), (0.003, 0.0015)):
        level = growth + constant * inverse**2
        noisy = inverse + level * torch.randn(240, 320, generator=rng, dtype=torch.float64)
        windows = {radius: fit_windows(noisy, seen, u, v, radius) for radius in RADII}
        noise = noise_by_radius(windows, noisy, seen, None, torch.float32)
        for radius in RADII:
            ratio = (noise[radius] / level)[16:-16, 16:-16]
            assert float(ratio.min()) > 0.7, (constant, growth, radius)
            assert float(ratio.max()) < 1.3, (constant, growth, radius)


def test_noise_that_is_given_is_taken(rng):
    u, v = coordinates(20, 20)
    inverse = 0.5 + torch.rand(20, 20, generator=rng, dtype=torch.float64)
    seen = torch.ones_like(inverse, dtype=torch.bool)
    windows = {radius: fit_windows(inverse, seen, u, v, radius) for radius in (2, 4)}
    noise = noise_by_radius(windows, inverse, seen, (0.01, 0.02), torch.float32)
    torch.testing.assert_close(noise[2], 0.02 + 0.01 * inverse**2)
    assert torch.equal(noise[2], noise[4])


def test_windows_beside_a_step_are_flat_and_tell_the_edge():
    u, v = coordinates(30, 40)
    inverse = torch.where(u < 0, 0.5, 0.4).double().expand(30, 40)
    seen = torch.ones(30, 40, dtype=torch.bool)
    found = fit_pixels(inverse, seen, u, v, noise=None, dtype=torch.float32)
    assert found.flat.all()
    assert found.edge[0].any()
    assert not found.edge.all()
