"""Discs drawn into an image against loops over discs and pixels."""

import math

import pytest
import torch

from torchrg.render import raster
from torchrg.render.raster import Discs, close_gaps, draw_discs, light_colors, split_keys

WIDTH, HEIGHT = 23, 17


def random_discs(rng, count=60, tilt=0.1, change=0.15, lines=0):
    return Discs(
        pixels=torch.rand(count, 2, generator=rng) * torch.tensor([WIDTH + 6.0, HEIGHT + 6.0]) - 3,
        inverse_depth=0.2 + torch.rand(count, generator=rng),
        colors=torch.randint(0, 256, (count, 3), generator=rng, dtype=torch.uint8),
        radii=4 * torch.rand(count, generator=rng),
        slopes=tilt * (2 * torch.rand(count, 2, generator=rng) - 1),
        max_change=torch.full((count,), change),
        bounds=torch.rand(count, lines, 3, generator=rng) - torch.tensor([0.0, 0.5, 0.5]),
    )


def facing(pixels, inverse_depth, colors, radii):
    """Discs that face the camera, without an end."""
    bounds = torch.zeros(len(pixels), 0, 3)
    flat = torch.zeros_like(pixels)
    return Discs(pixels, inverse_depth, colors, radii, flat, 0 * inverse_depth, bounds)


def drawn(discs, width=WIDTH, height=HEIGHT, max_radius=5):
    return draw_discs(discs, width=width, height=height, max_radius=max_radius)


def draw_by_loops(discs):
    """The depth and the row plus 1 of the nearest disc of each pixel."""
    depth, rows = torch.zeros(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH, dtype=torch.int32)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            for disc in range(len(discs.pixels)):
                x, y = (round(float(value)) for value in discs.pixels[disc])
                if not (0 <= x < WIDTH and 0 <= y < HEIGHT):
                    continue
                step = torch.tensor([float(column - x), float(row - y)])
                away = torch.tensor([float(column), float(row)]) - discs.pixels[disc]
                change, limit = float(away @ discs.slopes[disc]), float(discs.max_change[disc])
                radius = round(2 * float(discs.radii[disc])) / 2
                inside = float(step.norm()) <= radius and abs(change) <= limit
                lines = discs.bounds[disc, :, 0] + discs.bounds[disc, :, 1:] @ away
                if not (inside or (column, row) == (x, y)) or bool((lines < 0).any()):
                    continue
                dome = raster._DOME * limit * float(step @ step) / max(radius, 1) ** 2
                near = float(discs.inverse_depth[disc]) + min(max(change, -limit), limit) - dome
                if near > depth[row, column]:
                    depth[row, column], rows[row, column] = near, disc + 1
    return depth, rows


@pytest.mark.parametrize(
    ("tilt", "change", "lines"), [(0.0, 0.02, 0), (0.1, 0.15, 0), (0.1, 0.15, 2)]
)
def test_pixels_show_the_nearest_disc_that_does_not_end_before_them(rng, tilt, change, lines):
    discs = random_discs(rng, tilt=tilt, change=change, lines=lines)
    depth, rows = split_keys(drawn(discs))
    true_depth, true_rows = draw_by_loops(discs)
    torch.testing.assert_close(depth, true_depth)
    assert torch.equal(rows, true_rows)


def test_picture_does_not_depend_on_the_order_of_equally_near_discs(rng):
    discs = random_discs(rng, tilt=0.0, change=0.0)._replace(inverse_depth=torch.ones(60))
    order = torch.randperm(60, generator=rng)
    colors = []
    for each in (discs.by_color(), discs.select(order).by_color()):
        paint = torch.cat([torch.full((1, 3), 255, dtype=torch.uint8), each.colors])
        colors.append(paint[split_keys(drawn(each))[1]])
    assert torch.equal(*colors)


def test_drawing_in_parts_is_drawing_at_once(rng, monkeypatch):
    discs = random_discs(rng, lines=1)
    whole = drawn(discs)
    monkeypatch.setattr(raster, "_CHUNK_DISCS", 7)
    assert torch.equal(drawn(discs), whole)


def test_largest_discs_are_as_large_as_allowed():
    middle, color = torch.tensor([[11.0, 8.0]]), torch.zeros(1, 3, dtype=torch.uint8)
    keys = drawn(facing(middle, torch.ones(1), color, torch.tensor([7.0])), max_radius=2)
    is_drawn = split_keys(keys)[0] > 0
    assert is_drawn.nonzero().amin(0).tolist() == [6, 9]
    assert is_drawn.nonzero().amax(0).tolist() == [10, 13]
    assert int(is_drawn.sum()) == 13


def test_no_discs_leave_no_keys():
    nothing = facing(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, 3).byte(), torch.zeros(0))
    assert bool((drawn(nothing, width=4, height=3, max_radius=1) == 0).all())


@pytest.mark.parametrize(("size", "closed"), [(4, True), (5, False)])
def test_only_narrow_gaps_are_closed(size, closed):
    keys = torch.full((30, 30), 7)
    keys[15 : 15 + size, 15 : 15 + size] = 0
    found = close_gaps(keys, reach=2)
    assert bool((found == 7).all()) == closed
    assert math.isclose(float((found == 0).sum()), 0 if closed else size * size)


def test_closing_does_not_extend_a_surface():
    keys = torch.zeros(30, 30, dtype=torch.int64)
    keys[5:20, 8:21] = 3
    assert torch.equal(close_gaps(keys, reach=2), keys)


def test_light_does_not_depend_on_the_sign_of_normals(rng):
    normals = torch.nn.functional.normalize(torch.randn(100, 3, generator=rng), dim=1)
    positions = torch.rand(100, 3, generator=rng) + torch.tensor([0.0, 0.0, 2.0])
    colors = torch.randint(0, 256, (100, 3), generator=rng, dtype=torch.uint8)
    assert torch.equal(
        light_colors(colors, normals, positions), light_colors(colors, -normals, positions)
    )


def test_surfaces_that_face_up_are_brighter_than_those_that_face_down():
    position = torch.tensor([[0.0, 0.0, 5.0]])
    colors = torch.full((1, 3), 200, dtype=torch.uint8)
    up, down = (torch.tensor([[0.0, y, -0.7]]) for y in (-0.7, 0.7))
    assert light_colors(colors, up, position)[0, 0] > light_colors(colors, down, position)[0, 0]
