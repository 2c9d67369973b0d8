"""``torchrg segment --picture``: a picture of the planes beside the result."""

import functools

import numpy as np
import pytest

from torchrg.cli import main
from torchrg.render import render_cloud

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    for number in (1, 2):
        path = folder / f"room{number}.npz"
        assert main(["sample", str(path), "--num-points", "3000", "--seed", str(number)]) == 0
    return folder


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    small = functools.partial(render_cloud, width=80)
    monkeypatch.setattr("torchrg.render.gallery.render_cloud", small)


def segment(*arguments):
    return main(["segment", *map(str, arguments), "--preset", "classic"])


def test_picture_is_what_view_draws_of_the_result(rooms, tmp_path):
    result, drawn = tmp_path / "seg.npz", tmp_path / "seg.png"
    assert segment(rooms / "room1.npz", "--out", result, "--picture", drawn) == 0
    viewed = tmp_path / "viewed.png"
    assert main(["view", str(result), "--out", str(viewed), "--width", "80"]) == 0
    assert drawn.read_bytes() == viewed.read_bytes()


def test_several_pictures_go_to_a_directory_under_the_names_of_the_inputs(rooms, tmp_path):
    inputs = [rooms / "room1.npz", rooms / "room2.npz"]
    assert segment(*inputs, "--out", tmp_path / "out", "--picture", tmp_path / "pictures") == 0
    found = sorted((tmp_path / "pictures").iterdir())
    assert [path.name for path in found] == ["room1.png", "room2.png"]
    assert all(path.read_bytes().startswith(PNG) for path in found)


@pytest.mark.parametrize(
    ("inputs", "place", "message"),
    [
        (["room1.npz"], "seg.jpg", "expected a file that ends in .png"),
        (["room1.npz"], "no/seg.png", "there is no folder"),
        (["room1.npz", "room2.npz"], "both.png", "expected a directory for 2 pictures"),
    ],
)
def test_picture_is_refused_before_the_work(rooms, tmp_path, capsys, inputs, place, message):
    out = tmp_path / ("seg.npz" if len(inputs) == 1 else "out")
    paths = [rooms / name for name in inputs]
    assert segment(*paths, "--out", out, "--picture", tmp_path / place) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_cloud_without_a_plane_has_a_picture_too(tmp_path):
    np.save(tmp_path / "one.npy", np.ones((300, 3), dtype=np.float32))
    arguments = ["--out", tmp_path / "seg.npz", "--picture", tmp_path / "seg.png"]
    assert segment(tmp_path / "one.npy", *arguments) == 0
    assert (tmp_path / "seg.png").read_bytes().startswith(PNG)
