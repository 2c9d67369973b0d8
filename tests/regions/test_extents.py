"""Rectangles of least area against a search over all angles, and where the answer is known."""

import math

import numpy as np
import pytest
import torch

from torchrg.linalg.moments import Segments
from torchrg.regions.extents import fit_rectangles


def turned(places, angle):
    cosine, sine = math.cos(angle), math.sin(angle)
    return places @ np.array([[cosine, sine], [-sine, cosine]])


def rectangles(*regions):
    places = torch.from_numpy(np.concatenate(regions))
    labels = torch.arange(len(regions)).repeat_interleave(torch.tensor([len(r) for r in regions]))
    return fit_rectangles(Segments(labels), *places.unbind(1))


def area_at(places, angle):
    return np.prod(np.ptp(turned(places, -angle), axis=0))


def check_holds(places, boxes, row):
    """The rectangle touches the region on all four sides, and nothing is outside."""
    along = places @ boxes.directions[row].numpy().T - boxes.center[row].numpy()
    half, size = boxes.sides[row].numpy() / 2, np.abs(places).max()
    for found, expected in ((along.max(axis=0), half), (along.min(axis=0), -half)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * size)
    directions = boxes.directions[row]
    torch.testing.assert_close(directions @ directions.T, torch.eye(2).double())


def clouds(rng):
    n = int(rng.integers(3, 200))
    places = rng.normal(size=(n, 2))
    yield places
    yield rng.uniform(size=(n, 2)) * [1, 10.0 ** -rng.integers(0, 9)]
    yield np.round(3 * places)
    yield places / np.linalg.norm(places, axis=1, keepdims=True)
    yield places[:, :1] * rng.normal(size=2)


@pytest.mark.parametrize("seed", range(8))
def test_no_angle_gives_a_smaller_rectangle(seed):
    rng = np.random.default_rng(seed)
    regions = [
        (turned(places, rng.uniform(0, 7)) + rng.normal(size=2)) * 10.0 ** rng.integers(-4, 4)
        for places in clouds(rng)
    ]
    boxes = rectangles(*regions)
    for row, places in enumerate(regions):
        check_holds(places, boxes, row)
        area, length = float(boxes.sides[row].prod()), float(boxes.sides[row, 0])
        tried = [area_at(places, math.radians(0.1 * step)) for step in range(900)]
        assert area <= min(tried) + 1e-9 * length**2


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 4, 1.5, math.pi / 2, 3.0])
@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e3])
def test_turned_rectangles_are_found_exactly(angle, unit):
    rng = np.random.default_rng(0)
    corners = np.array([[-2.0, -0.5], [2, -0.5], [2, 0.5], [-2, 0.5]])
    inside = rng.uniform(-1, 1, (300, 2)) * [2, 0.5]
    places = unit * turned(rng.permutation(np.concatenate([corners, inside])), angle)
    for moved in (places, places + unit * np.array([300.0, -70.0])):
        boxes = rectangles(moved)
        assert torch.allclose(boxes.sides[0], torch.tensor([4.0, 1.0]).double() * unit, rtol=1e-9)
        along = boxes.directions[0, 0].numpy() @ turned(np.array([1.0, 0.0]), angle)
        assert math.isclose(abs(along), 1, rel_tol=1e-12)
        check_holds(moved, boxes, 0)


def test_lattices_have_exact_sides_and_the_directions_of_the_coordinates():
    grid = np.stack(np.mgrid[:20, :20], axis=-1).reshape(-1, 2).astype(float)
    boxes = rectangles(grid, grid[:200], np.random.default_rng(0).permutation(grid))
    assert boxes.sides.tolist() == [[19, 19], [19, 9], [19, 19]]
    assert boxes.directions[0].tolist() == boxes.directions[2].tolist() == [[1, 0], [0, 1]]


def test_lines_pairs_and_places_are_rectangles_of_no_area():
    line = np.arange(7.0)[:, None] * [3, 4]
    places = np.full((5, 2), 0.7)
    boxes = rectangles(line, line[::-1] + 0.1, line[:2], line[:1], places, np.zeros((1, 2)))
    expected = [[30.0, 0], [30, 0], [5, 0], [0, 0], [0, 0], [0, 0]]
    torch.testing.assert_close(boxes.sides, torch.tensor(expected).double(), rtol=0, atol=1e-12)
    upright = np.stack([np.zeros(4), np.arange(4.0)], axis=1)
    assert rectangles(upright).sides.tolist() == [[3, 0]]


def test_rectangles_do_not_depend_on_order_or_on_other_regions():
    rng = np.random.default_rng(1)
    regions = [places for _ in range(40) for places in clouds(rng)]
    together = rectangles(*regions)
    for row, places in enumerate(regions):
        alone = rectangles(rng.permutation(places))
        for one, all_ in zip(alone, together, strict=True):
            torch.testing.assert_close(one[0], all_[row], rtol=1e-9, atol=1e-9)


def test_a_circle_of_many_corners_takes_no_square_of_them():
    angle = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    sides = rectangles(np.stack([np.cos(angle), np.sin(angle)], axis=1)).sides
    torch.testing.assert_close(sides, torch.full((1, 2), 2.0).double(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("seed", range(5))
def test_ties_go_to_the_smallest_angle_whatever_rounding_says(seed):
    # The rectangles along the three edges of a hexagon have one area.
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.01, math.radians(29))
    hexagon = np.array([[math.cos(turn), math.sin(turn)] for turn in np.arange(6) * math.pi / 3])
    places = turned(hexagon, angle)[rng.permutation(6)]
    boxes = rectangles(places + rng.normal(size=2))
    along = torch.atan2(boxes.directions[0, :, 1], boxes.directions[0, :, 0]) % (math.pi / 2)
    np.testing.assert_allclose(along, angle, atol=1e-9)
