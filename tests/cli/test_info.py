"""Summary of a file by ``torchrg info``."""

import numpy as np

from torchrg.scenes import make_room


def test_info_says_what_a_file_holds_and_where_it_is(room_file, tmp_path, run):
    shown = run("info", room_file).out
    assert "6,000 of float32" in shown
    assert "labels" in shown
    surfaces = next(line[12:] for line in shown.splitlines() if line.startswith("surfaces"))
    assert surfaces in run("segment", room_file, "--out", tmp_path / "a.npz", "--verbose").out
    far = np.array([[500000.125, 4000000.25, 1], [500001.375, 4000000.5, 2]])
    np.save(tmp_path / "far.npy", far)
    shown = run("info", tmp_path / "far.npy").out
    assert "lowest      500000.125 4000000.25 1" in shown
    assert "extent      1.25 0.25 1" in shown


def test_info_prints_the_likely_up_axis(tmp_path, run):
    points = make_room(6000, noise=0.003, seed=1).points.numpy()
    for name, axes, up in (("z", [0, 1, 2], "z\n"), ("y", [1, 2, 0], "y, whose floor and ceiling")):
        np.save(tmp_path / f"{name}.npy", points[:, axes])
        assert f"up axis     {up}" in run("info", tmp_path / f"{name}.npy").out
