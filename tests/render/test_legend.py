"""Legends of images."""

import pytest
import torch

from torchrg import segment_planes
from torchrg.config import load_config
from torchrg.io.result import Result
from torchrg.render.gallery import draw_planes
from torchrg.render.legend import Legend, add_legend
from torchrg.render.pictures import render_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

RED = torch.tensor([220, 30, 30], dtype=torch.uint8)


def white(width=600, height=50):
    return torch.full((height, width, 3), 255, dtype=torch.uint8)


def legend(image, entries=(), pixels_per_unit=100.0, title="room"):
    return add_legend(image, Legend(title, entries, "m"), pixels_per_unit)


@pytest.mark.parametrize(("pixels_per_unit", "length"), [(100.0, 100), (40.0, 80), (7.0, 140)])
def test_the_scale_bar_is_a_round_number_of_units(pixels_per_unit, length):
    strip = legend(white(), pixels_per_unit=pixels_per_unit)[50:]
    middle = strip[48, :, 0] < 100
    # The bar, then the text.
    bar = int((~middle[10:]).nonzero()[0])
    assert bar == length


def test_entries_have_their_color_below_an_unchanged_image():
    image = white()
    image[:] = torch.arange(600)[:, None] % 200
    found = legend(image, [(RED, "wall 3: 18.4 m²")] * 4)
    assert torch.equal(found[:50], image)
    assert int((found[50:] == RED).all(dim=2).sum()) == 4 * 18 * 18


def test_text_differs_and_unknown_characters_are_question_marks():
    one, other = (legend(white(), title=title) for title in ("wall", "walk"))
    assert not torch.equal(one, other)
    assert torch.equal(legend(white(), title="\u4e2d"), legend(white(), title="?"))


def test_narrow_images_have_no_legend_and_wide_ones_larger_letters():
    narrow = white(width=200)
    assert legend(narrow) is narrow
    small, large = legend(white(width=1400)), legend(white(width=2800))
    assert len(large) - 50 == 2 * (len(small) - 50)
    assert large.shape[1] == 2800


def test_the_image_of_a_result_names_its_largest_planes():
    room = make_room(4000, seed=2)
    seg = segment_planes(room.points, load_config("classic"))
    result = Result.from_segmentation(Cloud(room.points.numpy()), seg)
    drawn = draw_planes(result, width=300)
    plain = draw_planes(Result(Cloud(room.points.numpy())), width=300)
    assert drawn.shape[0] > plain.shape[0]
    assert drawn.shape[1] == 300


def test_the_scale_is_that_of_the_middle_of_the_cloud():
    """A square of 2 m, seen from above."""
    line = torch.linspace(-1, 1, 80)
    points = torch.cartesian_prod(line, line, torch.zeros(1))
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    image = render_cloud(points, colors, view="above", width=600, legend=Legend("", (), "m"))
    across = int((image[: len(image) - 74].float().mean(dim=2) < 128).any(dim=0).sum())
    # The bar is half a meter: 1 m would be too long.
    bar = int((image[-26, 10:, 0] >= 100).nonzero()[0])
    assert across == pytest.approx(4 * bar, rel=0.05)
