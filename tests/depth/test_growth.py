"""Borders of regions move to the lines where their planes meet."""

from collections import Counter

import numpy as np
import pytest
import torch

from torchrg.depth.growth import PixelGrid, move_to_creases
from torchrg.depth.pixels import InverseCloud
from torchrg.linalg.moments import Segments
from torchrg.regions.fit import fit_planes


def moved(image, step, *, fill):
    """Return for each pixel the value of the one a step away."""
    wide = torch.nn.functional.pad(image, (6, 6, 6, 6), value=fill)
    return wide[6 + step[0] :, 6 + step[1] :][: image.shape[0], : image.shape[1]]


def move(surface, labels, *, truth, reach):
    """Return labels whose borders moved, on planes fitted to the true regions."""
    height, width = surface.shape
    x, y = torch.arange(width).double() / 100, torch.arange(height).double() / 100
    noise, seen = torch.zeros_like(surface), torch.ones_like(surface, dtype=torch.bool)
    cloud = InverseCloud(surface, x, y, noise, seen)
    fit = fit_planes(Segments(truth.flatten()), cloud.points, torch.ones_like(cloud.points))
    return move_to_creases(cloud, labels.flatten(), fit, torch.tensor(reach).double()).view(
        height, width
    )


def roof(height=40, width=60):
    """Return two planes that meet at a slanted line, and which is which."""
    x = torch.arange(width).double() / 100
    y = torch.arange(height).double()[:, None] / 100
    left, right = 2 + 0.5 * x + 0.1 * y, 2.36 - 0.7 * x + 0.2 * y
    return torch.minimum(left, right), (right < left).long()


def test_a_displaced_border_goes_back_to_the_crease():
    surface, truth = roof()
    displaced = moved(truth, (0, -6), fill=0)
    assert int((displaced != truth).sum()) > 200
    back = move(surface, displaced, truth=truth, reach=[0.1, 0.1])
    # Pixels on the crease itself are on both sides.
    assert int((back != truth).sum()) <= 6


def test_pixels_off_the_other_plane_stay():
    surface, truth = roof()
    displaced = moved(truth, (0, -6), fill=0)
    left = 2 + 0.5 * torch.arange(60) / 100 + 0.1 * torch.arange(40)[:, None] / 100
    overhang = torch.where(displaced == 0, left, surface)
    back = move(overhang, displaced, truth=truth, reach=[0.003, 0.003])
    # The overhang leaves the other plane within a pixel of where they meet.
    assert int((back != displaced).sum()) <= 2 * 40
    curved = move(surface, displaced, truth=truth, reach=[0.1, float("nan")])
    assert torch.equal(curved, displaced)


def test_borders_do_not_run_along_the_crease():
    # A leg stands on a floor: next to the leg, the floor goes on behind the line where they meet.
    x = torch.arange(60).double() / 100
    y = torch.arange(60).double()[:, None] / 100
    floor = 1 + 2 * (y - 0.2) + 0 * x
    is_leg = (y < 0.2) & (x > 0.2) & (x < 0.3)
    surface, truth = torch.where(is_leg, 1.0, floor), is_leg.long()
    back = move(surface, truth, truth=truth, reach=[0.1, 0.1])
    # Only pixels on the crease itself, where leg and floor meet, are on both sides.
    assert not bool((back != truth)[y.squeeze(1) != 0.2].any())


def test_unlabelled_pixels_and_whole_images_stay():
    surface, truth = roof()
    labels = moved(truth, (0, -6), fill=0)
    labels[10:20] = -1
    back = move(surface, labels, truth=truth, reach=[0.1, 0.1])
    assert bool((back[10:20] == -1).all())
    one = torch.zeros_like(truth)
    assert torch.equal(move(surface, one, truth=truth, reach=[0.1, 0.1]), one)


@pytest.mark.parametrize("num_regions", [3, 60])
def test_contacts_are_those_of_each_pixel_with_its_eight_neighbors(num_regions):
    # With more pairs of regions than pixels there is no table of all pairs.
    labels = torch.randint(-1, num_regions, (9, 7), generator=torch.Generator().manual_seed(0))
    expected = Counter()
    for row, column in np.ndindex(9, 7):
        for down, right in np.ndindex(3, 3):
            other = row + down - 1, column + right - 1
            if 0 <= other[0] < 9 and 0 <= other[1] < 7:
                pair = sorted((int(labels[row, column]), int(labels[other])))
                expected[tuple(pair)] += pair[0] >= 0 and pair[0] != pair[1]
    pairs, counts = PixelGrid(labels.shape).contacts(labels.flatten())
    assert dict(zip(map(tuple, pairs.tolist()), counts.tolist(), strict=True)) == +expected
