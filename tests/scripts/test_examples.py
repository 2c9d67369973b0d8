"""The scripts that people copy run, where their libraries are installed, and are short."""

import runpy
import sys

import guide_pages
import numpy as np
import pytest
import torch

from tests.datasets.captures_tree import write_nerfstudio
from torchrg import read_cloud, write_cloud
from torchrg.scenes import make_room

FOLDER = guide_pages.GUIDES.parent / "examples"
pytestmark = pytest.mark.filterwarnings("ignore")  # Of the libraries.


@pytest.fixture
def scans(tmp_path):
    """Return a folder with two rooms."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for seed in range(2):
        room = make_room(2_000 + 500 * seed, noise=0.003, seed=seed)
        write_cloud(folder / f"room{seed}.ply", room.points)
    return folder


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Return a function that runs a script, and returns its names and what it printed."""

    def start(name, *arguments):
        path = FOLDER / f"{name}.py"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        return runpy.run_path(str(path)), capsys.readouterr().out

    return start


def test_scripts_are_short_and_in_the_guide():
    guide = (guide_pages.GUIDES / "bridges.md").read_text(encoding="utf-8")
    scripts = sorted(FOLDER.iterdir())
    assert len([path for path in scripts if path.suffix == ".py"]) == 5
    for path in scripts:
        if path.suffix == ".py":
            assert len(path.read_text(encoding="utf-8").splitlines()) <= 40, path.name
            assert f"examples/{path.name}" in guide


def test_open3d_gets_normals_colors_and_labels(scans, tmp_path, run):
    open3d = pytest.importorskip("open3d")
    names, _ = run("open3d_in_and_out", scans / "room0.ply", tmp_path / "planes.ply")
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "planes.ply"))
    assert np.array_equal(cloud.point.normals.numpy(), names["seg"].normals.numpy())
    assert np.array_equal(cloud.point.label.numpy()[:, 0], names["seg"].labels.numpy())
    assert len(names["largest"].points) == names["seg"].planes.count[0]


def test_pyg_keeps_the_superpoints_of_two_clouds_apart(scans, run):
    pytest.importorskip("torch_geometric")
    names, _ = run("pyg_superpoints", scans)
    batch, part, pooled = names["batch"], names["part"], names["pooled"]
    each = [int(room.superpoint_index.max()) + 1 for room in names["rooms"]]
    assert len(pooled) == sum(each)
    assert not set(part[batch.batch == 0].tolist()) & set(part[batch.batch == 1].tolist())
    mean = names["features"][part == 3].mean(dim=0)
    assert torch.allclose(pooled[3], mean, atol=1e-5)


def test_lightning_trains_on_ragged_batches(scans, run):
    pytest.importorskip("lightning")
    names, _ = run("lightning_training", scans)
    assert names["trainer"].global_step == 2


def test_hugging_face_stores_normals_and_planes(scans, tmp_path, run):
    datasets = pytest.importorskip("datasets")
    _, printed = run("hugging_face_dataset", scans, tmp_path / "planes")
    rooms = datasets.load_from_disk(tmp_path / "planes").with_format("torch")
    assert [len(room["plane"]) for room in rooms] == [2_000, 2_500]
    assert f"room1 (2500, 3) {int(rooms[1]['plane'].max()) + 1} planes" in printed


def test_a_capture_of_a_phone_becomes_one_segmented_cloud(tmp_path, run):
    capture = write_nerfstudio(tmp_path / "capture")
    names, printed = run("phone_capture", capture, tmp_path / "room.ply")
    cloud = read_cloud(tmp_path / "room.ply")
    assert np.array_equal(cloud.fields["labels"], names["seg"].labels.numpy())
    assert len(names["seg"].planes) >= 3
    assert printed.count("of the pixels are in planes") == 2
