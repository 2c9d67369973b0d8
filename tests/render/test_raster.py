"""The depth buffer against loops over discs and pixels."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from torchrg.render import raster
from torchrg.render.raster import DepthBuffer, Discs, close_gaps, depth_and_colors

WIDTH, HEIGHT = 23, 17


def random_discs(rng, count=60, tilt=0.1, change=0.15):
    return Discs(
        pixels=torch.rand(count, 2, generator=rng) * torch.tensor([WIDTH + 6.0, HEIGHT + 6.0]) - 3,
        inverse_depth=0.2 + torch.rand(count, generator=rng),
        colors=torch.randint(0, 256, (count, 3), generator=rng, dtype=torch.uint8),
        radii=4 * torch.rand(count, generator=rng),
        slopes=tilt * (2 * torch.rand(count, 2, generator=rng) - 1),
        max_change=torch.full((count,), change),
    )


def facing(pixels, inverse_depth, colors, radii):
    """Discs that face the camera."""
    return Discs(pixels, inverse_depth, colors, radii, torch.zeros_like(pixels), 0 * inverse_depth)


def drawn(discs, parts=(slice(None),), width=WIDTH, height=HEIGHT, max_radius=5):
    buffer = DepthBuffer(width, height, max_radius=max_radius)
    for part in parts:
        buffer.draw(Discs(*(values[part] for values in discs)))
    buffer.end_drawing()
    for part in parts:
        buffer.paint(Discs(*(values[part] for values in discs)))
    return buffer.keys()


def draw_by_loops(discs):
    """The depth and color of each pixel, from all discs that cover it."""
    depth = torch.zeros(HEIGHT, WIDTH)
    paint = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            covering = []
            for disc in range(len(discs.pixels)):
                x, y = (round(float(value)) for value in discs.pixels[disc])
                if not (0 <= x < WIDTH and 0 <= y < HEIGHT):
                    continue
                place = torch.tensor([float(column), float(row)])
                step = place - torch.tensor([float(x), float(y)])
                change = float((place - discs.pixels[disc]) @ discs.slopes[disc])
                radius = round(2 * float(discs.radii[disc])) / 2
                inside = float(step.norm()) <= radius and abs(change) <= discs.max_change[disc]
                if inside or (column, row) == (x, y):
                    dome = raster._DOME * discs.max_change[disc] * (step @ step)
                    limit = float(discs.max_change[disc])
                    own = float(discs.inverse_depth[disc]) + min(max(change, -limit), limit)
                    covering.append((own - float(dome) / max(radius, 1) ** 2, own, disc))
            if not covering:
                continue
            nearest, _, front = max(covering)
            candidates = []
            for _, own, disc in covering:
                change = float(discs.max_change[disc])
                across = discs.pixels[front] - discs.pixels[disc]
                of_plane = discs.inverse_depth[disc] + float(across @ discs.slopes[disc])
                hidden = of_plane + raster._FLAT * change < discs.inverse_depth[front]
                if own + raster._OVERHANG * change >= nearest and not hidden:
                    away = float((discs.pixels[disc] - place).norm())
                    candidates.append((away, discs.colors[disc].tolist()))
            depth[row, column] = nearest
            paint[row, column] = torch.tensor(min(candidates)[1], dtype=torch.uint8)
    return depth, paint


@pytest.mark.parametrize(("tilt", "change"), [(0.0, 0.02), (0.1, 0.15)])
def test_pixels_have_the_color_of_the_nearest_middle_that_is_not_hidden(rng, tilt, change):
    discs = random_discs(rng, tilt=tilt, change=change)
    depth, paint = depth_and_colors(drawn(discs))
    true_depth, true_paint = draw_by_loops(discs)
    torch.testing.assert_close(depth, true_depth)
    assert torch.equal(paint, true_paint)


def test_picture_does_not_depend_on_the_order_of_equally_near_discs(rng):
    discs = random_discs(rng, tilt=0.0, change=0.0)._replace(inverse_depth=torch.ones(60))
    order = torch.randperm(60, generator=rng)
    assert torch.equal(drawn(discs), drawn(Discs(*(values[order] for values in discs))))


def test_drawing_in_parts_is_drawing_at_once(rng):
    discs = random_discs(rng)
    assert torch.equal(drawn(discs), drawn(discs, parts=torch.arange(60).split(7)))


def test_largest_discs_are_as_large_as_allowed():
    middle, color = torch.tensor([[11.0, 8.0]]), torch.zeros(1, 3, dtype=torch.uint8)
    keys = drawn(facing(middle, torch.ones(1), color, torch.tensor([7.0])), max_radius=2)
    is_drawn = depth_and_colors(keys)[0] > 0
    assert is_drawn.nonzero().amin(0).tolist() == [6, 9]
    assert is_drawn.nonzero().amax(0).tolist() == [10, 13]
    assert int(is_drawn.sum()) == 13


def test_no_discs_leave_the_picture_white():
    nothing = facing(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, 3).byte(), torch.zeros(0))
    for parts in ((), (slice(None),)):
        depth, paint = depth_and_colors(drawn(nothing, parts, width=4, height=3, max_radius=1))
        assert bool((depth == 0).all())
        assert bool((paint == 255).all())


def wall_with_hole(size, behind):
    """Keys of a red wall at depth 1 with a square hole, and blue at another depth behind it."""
    rows, columns = torch.cartesian_prod(torch.arange(30), torch.arange(30)).unbind(dim=1)
    hole = (rows - 15 >= 0) & (rows - 15 < size) & (columns - 15 >= 0) & (columns - 15 < size)
    pixels = torch.stack([columns, rows], dim=1).float()
    colors = torch.tensor([[255, 0, 0], [0, 0, 255]], dtype=torch.uint8)[hole.long()]
    inverse = torch.where(hole, 1 / behind, 1.0)
    keys = drawn(facing(pixels, inverse, colors, torch.zeros(900)), (slice(None),), 30, 30, 0)
    return keys, hole.view(30, 30)


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
    green = torch.tensor([[0, 255, 0]], dtype=torch.uint8)
    front = facing(torch.tensor([[15.0, 14.0]]), torch.tensor([2.0]), green, torch.zeros(1))
    both = torch.maximum(keys, drawn(front, (slice(None),), 30, 30, 0))
    paint = depth_and_colors(close_gaps(both, reach=2, thickness=0.1))[1]
    assert bool((paint[hole] == torch.tensor([255, 0, 0])).all())


def literal_gaps(keys, reach, thickness):
    """Every key around each gap is looked at, one gap after the other."""
    depth = depth_and_colors(keys)[0].numpy()
    side = 2 * reach + 1
    closing = ndimage.maximum_filter(depth, side, mode="constant", cval=0)
    closing = ndimage.minimum_filter(closing, side, mode="constant", cval=np.inf)
    filled = keys.clone()
    for row, column in np.argwhere(closing > depth + thickness * depth * closing):
        rows, columns = (slice(max(place - reach, 0), place + reach + 1) for place in (row, column))
        limit = closing[row, column] / max(1 - thickness * closing[row, column], 0.5)
        behind = torch.from_numpy(depth[rows, columns] <= limit)
        filled[row, column] = keys[rows, columns][behind].max()
    return filled, closing


@pytest.mark.parametrize("reach", [1, 3, 8])
def test_gaps_take_what_a_look_at_every_pixel_around_finds(rng, reach):
    keys = drawn(random_discs(rng, count=40), width=60, height=50)
    for thickness in (0.05, 0.5):
        expected, _ = literal_gaps(keys, reach, thickness)
        found = close_gaps(keys, reach=reach, thickness=thickness)
        assert torch.equal(found, expected)
        assert int((found != keys).sum()) > 10


def test_gaps_of_few_large_discs_take_the_closing(rng):
    keys = drawn(random_discs(rng, count=5), width=90, height=70)
    _, closing = literal_gaps(keys, 21, 0.05)
    found = close_gaps(keys, reach=21, thickness=0.05)
    depth, is_gap = depth_and_colors(found)[0].numpy(), (found != keys).numpy()
    assert (depth[is_gap] == closing[is_gap]).all()
    assert np.isin(found.numpy(), keys.numpy()).all()
    assert is_gap.sum() > 100
