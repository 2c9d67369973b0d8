"""Pictures side by side."""

import sys

import pytest
import torch
from reproduction.tiles import tile_pictures

from torchrg.errors import ConfigError, MissingDependencyError, ShapeError


def solid(height, width, value):
    return torch.full((height, width, 3), value, dtype=torch.uint8)


def test_pictures_stand_in_the_middle_of_their_tiles():
    tiles = tile_pictures([solid(40, 100, 0), solid(20, 50, 9), solid(30, 100, 7)], columns=2)
    assert tiles.shape == (40 + 2 + 30, 202, 3)
    assert bool((tiles[:40, :100] == 0).all())
    assert bool((tiles[10:30, 127:177] == 9).all())
    assert bool((tiles[42:, :100] == 7).all())
    used = torch.zeros(tiles.shape[:2], dtype=torch.bool)
    used[:40, :100] = used[10:30, 127:177] = used[42:, :100] = True
    assert bool((tiles[~used] == 255).all())


def test_titles_are_dark_letters_over_each_picture():
    pytest.importorskip("matplotlib")
    plain = tile_pictures([solid(40, 300, 255)] * 2)
    titled = tile_pictures([solid(40, 300, 255)] * 2, titles=["classic", "consensus"])
    assert titled.shape[1] == plain.shape[1]
    strip = titled[:-40].float().mean(dim=-1)
    left, right = strip[:, :300], strip[:, 306:]
    assert 0 < int((left < 100).sum()) < int((right < 100).sum())


def test_titles_without_matplotlib_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingDependencyError, match="torchrg\\[report\\]"):
        tile_pictures([solid(9, 9, 0)], titles=["a"])


@pytest.mark.parametrize(
    ("pictures", "settings", "error", "message"),
    [
        ([], {}, ConfigError, "at least one picture"),
        ([solid(2, 2, 0)], {"columns": 0}, ConfigError, "at least one picture and column"),
        ([solid(2, 2, 0)], {"titles": ["a", "b"]}, ConfigError, "expected 1 titles"),
        ([torch.zeros(2, 2)], {}, ShapeError, "pictures of shape"),
    ],
)
def test_wrong_arguments_are_refused(pictures, settings, error, message):
    with pytest.raises(error, match=message):
        tile_pictures(pictures, **settings)
