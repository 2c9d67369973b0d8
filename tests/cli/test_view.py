"""``torchrg view``: one picture of a file, or two side by side; pages have tests of their own."""

import numpy as np
import pytest

from torchrg.io import read_cloud

image_file = pytest.importorskip("PIL.Image", reason="needs pillow to read pictures")


@pytest.fixture(scope="module")
def room_file(folder_of_clouds):
    return folder_of_clouds("room.npz", num_points=6000) / "room.npz"


def test_view_draws_a_picture(room_file, tmp_path, run):
    out = tmp_path / "room.png"
    assert run("view", room_file, "--out", out, "--width", "200").code == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    for flags, message in (
        (["--color", "curvature"], "missing curvature, required by --color curvature"),
        (["--azimuth-deg", "inf"], "expected azimuth_deg to be finite, got inf"),
        (["--azimuth-deg", "nan"], "expected --azimuth-deg to be a number or none, got 'nan'"),
        (["--out", "room.jpg"], "room.jpg: expected a file ending in .png or .html"),
    ):
        assert message in run("view", room_file, "--out", out, *flags).error


def test_view_shows_colours_of_sixteen_bits_as_those_of_eight(room_file, tmp_path, run):
    points = read_cloud(room_file).coordinates
    color = np.random.default_rng(0).integers(0, 256, points.shape, dtype=np.uint8)
    wide = color.astype(np.uint16) * 257
    wide[0, 0] += 1 if wide[0, 0] < 65535 else -1
    pictures = []
    for name, values in (("narrow", color), ("wide", wide)):
        cloud, picture = tmp_path / f"{name}.npz", tmp_path / f"{name}.png"
        np.savez(cloud, points=points, color=values)
        assert read_cloud(cloud).fields["color"].dtype == values.dtype
        assert run("view", cloud, "--out", picture, "--width", "100").code == 0
        pictures.append(picture.read_bytes())
    assert pictures[0] == pictures[1]


def test_view_draws_the_same_planes_beside_each_other_from_one_place_in_one_color(
    room_file, tmp_path, run
):
    cloud, out = read_cloud(room_file), tmp_path / "both.png"
    labels = cloud.fields["labels"]
    np.savez(tmp_path / "renumbered.npz", points=cloud.coordinates, labels=labels.max() - labels)
    np.savez(tmp_path / "room.npz", points=cloud.coordinates, labels=labels)
    pair = (tmp_path / "room.npz", "--compare", tmp_path / "renumbered.npz")
    assert "(240 x " in run("view", *pair, "--out", out, "--width", "240").out
    both = image_file.open(out)
    left, right = (both.crop((x, 0, x + 120, both.height)).tobytes() for x in (0, 120))
    assert left == right
    assert run("view", tmp_path / "room.npz", "--out", out, "--width", "120").code == 0
    assert image_file.open(out).tobytes() == left


def test_view_puts_clouds_of_two_heights_beside_each_other(tmp_path, run):
    flat = np.random.default_rng(0).random((400, 3)) * [4.0, 1.0, 0.01]
    np.save(tmp_path / "wide.npy", flat)
    np.save(tmp_path / "square.npy", flat * [1.0, 4.0, 1.0])
    out, flags = tmp_path / "both.png", ("--view", "above", "--width", "160")
    files = (tmp_path / "wide.npy", "--compare", tmp_path / "square.npy")
    assert run("view", *files, "--out", out, *flags).code == 0
    both = np.asarray(image_file.open(out))
    assert both.shape[1] == 160
    assert (both[-10:, :80] == 255).all()
    assert (both[-10:, 80:] < 255).any()
