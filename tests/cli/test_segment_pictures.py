"""``torchrg segment --picture``: a picture of the planes next to the result."""

import functools

import numpy as np
import pytest

from torchrg.render import render_cloud

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def rooms(folder_of_clouds):
    return folder_of_clouds("room1.npz", "room2.npz")


@pytest.fixture
def segment(run, monkeypatch):
    """``segment(...)``: the command with small pictures."""
    small = functools.partial(render_cloud, width=80)
    monkeypatch.setattr("torchrg.render.gallery.render_cloud", small)
    return functools.partial(run, "segment", "--preset", "classic")


def test_picture_is_what_view_draws_of_the_result(rooms, tmp_path, segment, run):
    result, drawn, viewed = (tmp_path / name for name in ("seg.npz", "seg.png", "viewed.png"))
    assert segment(rooms / "room1.npz", "--out", result, "--picture", drawn).code == 0
    assert run("view", result, "--out", viewed, "--width", "80").code == 0
    assert drawn.read_bytes() == viewed.read_bytes()


def test_several_pictures_go_to_a_directory_under_the_names_of_the_inputs(rooms, tmp_path, segment):
    places = ("--out", tmp_path / "out", "--picture", tmp_path / "pictures")
    assert segment(rooms / "room1.npz", rooms / "room2.npz", *places).code == 0
    pictures = sorted((tmp_path / "pictures").iterdir())
    assert [path.name for path in pictures] == ["room1.png", "room2.png"]
    assert all(path.read_bytes().startswith(PNG) for path in pictures)


@pytest.mark.parametrize(
    ("inputs", "place", "message"),
    [
        (["room1.npz"], "seg.jpg", "expected a file ending in .png"),
        (["room1.npz"], "no/seg.png", "not found; create it first"),
        (["room1.npz", "room2.npz"], "both.png", "expected a directory for several files"),
    ],
)
def test_picture_is_refused_before_the_work(rooms, tmp_path, segment, inputs, place, message):
    out = tmp_path / ("seg.npz" if len(inputs) == 1 else "out")
    paths = [rooms / name for name in inputs]
    assert message in segment(*paths, "--out", out, "--picture", tmp_path / place).error
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_equal_points_give_no_plane_a_warning_and_a_picture(tmp_path, segment):
    np.save(tmp_path / "one.npy", np.ones((300, 3), dtype=np.float32))
    places = ("--out", tmp_path / "seg.npz", "--picture", tmp_path / "seg.png")
    done = segment(tmp_path / "one.npy", *places)
    assert (done.code, done.err.count("\n")) == (0, 1)
    assert "no plane found: all points are identical" in done.err
    assert (tmp_path / "seg.png").read_bytes().startswith(PNG)
