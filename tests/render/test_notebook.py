"""How a segmentation shows itself in a notebook."""

import re
from dataclasses import replace

import pytest
import torch

import torchrg
from torchrg.errors import ConfigError

pytestmark = pytest.mark.usefixtures("small_pictures")


@pytest.fixture(scope="module")
def seg():
    points = torchrg.scenes.make_room(num_points=3000, seed=0).points
    return torchrg.segment_planes(points, torchrg.load_config("classic"))


def test_a_notebook_shows_a_picture_and_the_number_of_planes(seg):
    text = seg._repr_html_()
    assert "data:image/png;base64,iVBORw0KGgo" in text
    assert "3,000 points" in text
    assert f"{len(seg.planes):,} planes" in text


def test_without_points_there_is_no_picture(seg):
    text = replace(seg, points=None)._repr_html_()
    assert "<img" not in text
    assert "wall" in text
    with pytest.raises(ConfigError, match=re.escape("use dataclasses.replace(seg, points=points)")):
        replace(seg, points=None).show()


@pytest.mark.filterwarnings("ignore:expected finite points")
def test_a_cloud_without_planes_shows_itself():
    assert "0 planes" in torchrg.segment_planes(torch.full((5, 3), torch.nan))._repr_html_()


def test_show_gives_the_page_in_a_frame_of_its_own(seg):
    pytest.importorskip("pydeck", reason="needs the extra view")
    page = seg.show(title='a "quoted" <title>')
    assert page.num_points == (3000,)
    frame = page._repr_html_()
    assert frame.startswith("<iframe ")
    assert frame.count("<") == 2
    assert frame.count('"') == 2 * len(re.findall(r'[a-z]="', frame))
