"""The depth buffer against loops over discs and pixels."""

import math

import pytest
import torch

from torchrg.render.raster import DepthBuffer, close_gaps, depth_and_colors

WIDTH, HEIGHT = 23, 17


def random_discs(rng, count=60):
    pixels = torch.rand(count, 2, generator=rng) * torch.tensor([WIDTH + 6.0, HEIGHT + 6.0]) - 3
    inverse = 0.2 + torch.rand(count, generator=rng)
    colors = torch.randint(0, 256, (count, 3), generator=rng, dtype=torch.uint8)
    radii = 4 * torch.rand(count, generator=rng)
    slopes = 0.2 * torch.rand(count, 2, generator=rng) - 0.1
    return pixels, inverse, colors, radii, slopes


def draw_by_loops(pixels, inverse, colors, radii, slopes, max_change):
    depth = [[0.0] * WIDTH for _ in range(HEIGHT)]
    paint = [[[255, 255, 255]] * WIDTH for _ in range(HEIGHT)]
    for disc in range(len(pixels)):
        x, y = (round(float(value)) for value in pixels[disc])
        if not (0 <= x < WIDTH and 0 <= y < HEIGHT):
            continue
        radius = round(2 * float(radii[disc])) / 2
        for row in range(HEIGHT):
            for column in range(WIDTH):
                dx, dy = column - x, row - y
                change = dx * float(slopes[disc, 0]) + dy * float(slopes[disc, 1])
                inside = math.hypot(dx, dy) <= radius and abs(change) <= max_change
                if (inside or (dx, dy) == (0, 0)) and float(inverse[disc]) + change > depth[row][
                    column
                ]:
                    depth[row][column] = float(inverse[disc]) + change
                    paint[row][column] = colors[disc].tolist()
    return torch.tensor(depth), torch.tensor(paint, dtype=torch.uint8)


@pytest.mark.parametrize("tilted", [False, True])
def test_buffer_holds_the_nearest_disc_of_each_pixel(rng, tilted):
    pixels, inverse, colors, radii, slopes = random_discs(rng)
    slopes = slopes if tilted else torch.zeros_like(slopes)
    buffer = DepthBuffer(WIDTH, HEIGHT, max_radius=5)
    tilt = {"slopes": slopes, "max_change": torch.full((60,), 0.15)} if tilted else {}
    buffer.draw_discs(pixels, inverse, colors, radii, **tilt)
    depth, paint = depth_and_colors(buffer.keys())
    true_depth, true_paint = draw_by_loops(pixels, inverse, colors, radii, slopes, 0.15)
    torch.testing.assert_close(depth, true_depth)
    assert torch.equal(paint, true_paint)


def test_picture_does_not_depend_on_the_order_of_equally_near_discs(rng):
    pixels, _, colors, radii, _ = random_discs(rng)
    keys = []
    for order in (torch.arange(60), torch.randperm(60, generator=rng)):
        buffer = DepthBuffer(WIDTH, HEIGHT, max_radius=5)
        buffer.draw_discs(pixels[order], torch.ones(60), colors[order], radii[order])
        keys.append(buffer.keys())
    assert torch.equal(keys[0], keys[1])


def test_drawing_in_parts_is_drawing_at_once(rng):
    pixels, inverse, colors, radii, _ = random_discs(rng)
    whole, parts = (DepthBuffer(WIDTH, HEIGHT, max_radius=5) for _ in range(2))
    whole.draw_discs(pixels, inverse, colors, radii)
    for part in torch.arange(60).split(7):
        parts.draw_discs(pixels[part], inverse[part], colors[part], radii[part])
    assert torch.equal(whole.keys(), parts.keys())


def test_largest_discs_are_as_large_as_allowed():
    buffer = DepthBuffer(WIDTH, HEIGHT, max_radius=2)
    color = torch.zeros(1, 3, dtype=torch.uint8)
    buffer.draw_discs(torch.tensor([[11.0, 8.0]]), torch.ones(1), color, torch.tensor([7.0]))
    drawn = depth_and_colors(buffer.keys())[0] > 0
    assert drawn.nonzero().amin(0).tolist() == [6, 9]
    assert drawn.nonzero().amax(0).tolist() == [10, 13]
    assert int(drawn.sum()) == 13


def test_no_discs_leave_the_picture_white():
    buffer = DepthBuffer(4, 3, max_radius=1)
    buffer.draw_discs(
        torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, 3, dtype=torch.uint8), torch.zeros(0)
    )
    depth, paint = depth_and_colors(buffer.keys())
    assert bool((depth == 0).all())
    assert bool((paint == 255).all())


def wall_with_hole(size, behind):
    """Keys of a red wall at depth 1 with a square hole, and blue at another depth behind it."""
    buffer = DepthBuffer(30, 30, max_radius=0)
    rows, columns = torch.cartesian_prod(torch.arange(30), torch.arange(30)).unbind(dim=1)
    hole = (rows - 15 >= 0) & (rows - 15 < size) & (columns - 15 >= 0) & (columns - 15 < size)
    pixels = torch.stack([columns, rows], dim=1).float()
    for where, depth, color in ((~hole, 1.0, (255, 0, 0)), (hole, behind, (0, 0, 255))):
        count = int(where.sum())
        colors = torch.tensor(color, dtype=torch.uint8).repeat(count, 1)
        inverse = torch.full((count,), 1 / depth)
        buffer.draw_discs(pixels[where], inverse, colors, torch.zeros(count))
    return buffer.keys(), hole.view(30, 30)


@pytest.mark.parametrize(
    ("size", "behind", "closed"),
    [(4, math.inf, True), (4, 3.0, True), (4, 1.01, False), (5, math.inf, False)],
)
def test_only_narrow_gaps_to_something_far_are_closed(size, behind, closed):
    keys, hole = wall_with_hole(size, behind)
    result = close_gaps(keys, reach=2, thickness=0.1)
    paint = depth_and_colors(result)[1]
    assert torch.equal(result[~hole], keys[~hole])
    is_red = (paint[hole] == torch.tensor([255, 0, 0])).all(dim=1)
    assert bool((is_red == closed).all())


def test_a_gap_takes_the_surface_about_it_not_what_is_in_front():
    keys, hole = wall_with_hole(3, 5.0)
    front = DepthBuffer(30, 30, max_radius=0)
    green = torch.tensor([[0, 255, 0]], dtype=torch.uint8)
    front.draw_discs(torch.tensor([[15.0, 14.0]]), torch.tensor([2.0]), green, torch.zeros(1))
    both = torch.maximum(keys, front.keys())
    paint = depth_and_colors(close_gaps(both, reach=2, thickness=0.1))[1]
    assert bool((paint[hole] == torch.tensor([255, 0, 0])).all())
