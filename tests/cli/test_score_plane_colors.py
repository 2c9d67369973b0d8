"""Truth of PlaneRCNN and AirPlanes: planes in the colours of a mesh."""

import json

import numpy as np
import pytest

from tests.datasets.scannet_tree import write_mesh
from torchrg.cli import main
from torchrg.metrics import score_labels
from torchrg.scenes import make_room


def colors_of(planes):
    """The code of a plane, as its writers make it: hundreds of the number and one."""
    code = (planes + 1) * 100
    return np.stack([code // 65536, code // 256 % 256, code % 256], axis=1)


@pytest.fixture(scope="module")
def trees(tmp_path_factory):
    folder = tmp_path_factory.mktemp("colors")
    room = make_room(num_points=3000, noise=0.003, seed=1)
    # Numbers as large as those of a building, with gaps.
    planes = np.where(room.labels < 0, -1, room.labels * 701)
    for scan, below in (("scene0000_00", ""), ("scene0000_01", "annotation")):
        (folder / "truth" / scan / below).mkdir(parents=True)
        path = folder / "truth" / scan / below / "planes.ply"
        write_mesh(path, room.points.float().numpy(), colors_of(planes))
        (folder / "ours").mkdir(exist_ok=True)
        np.save(folder / "in.npy", room.points.float().numpy())
        out = folder / "ours" / f"{scan}.npz"
        command = ["segment", str(folder / "in.npy"), "--out", str(out)]
        assert main([*command, "--preset", "classic"]) == 0
    return folder, planes


def test_scans_are_scored_against_their_planes(trees, capsys):
    folder, planes = trees
    labels = np.load(folder / "ours" / "scene0000_00.npz")["labels"]
    expected = score_labels(labels, planes)
    files = [folder / "ours" / "scene0000_00.npz", folder / "truth" / "scene0000_00" / "planes.ply"]
    capsys.readouterr()
    assert main(["score", *map(str, files), "--plane-colors", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["labels"]
    assert found["faces"] == len(np.unique(planes[planes >= 0]))
    for name in ("voi", "rand", "covering", "ari"):
        assert found[name] == pytest.approx(getattr(expected, name))
    command = ["score", str(folder / "ours"), str(folder / "truth"), "--plane-colors", "--json"]
    assert main(command) == 0
    means = json.loads(capsys.readouterr().out)
    assert set(means["scans"]) == {"scene0000_00", "scene0000_01"}
    assert means["mean"]["labels"]["voi"] == pytest.approx(expected.voi)


def test_truth_without_colours_is_told(trees, capsys):
    folder, _ = trees
    file = str(folder / "ours" / "scene0000_00.npz")
    assert main(["score", file, str(folder / "in.npy"), "--plane-colors"]) == 2
    assert "expected colours for --plane-colors, got none" in capsys.readouterr().err
