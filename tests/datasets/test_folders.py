"""A folder of clouds lists every readable file, in natural order, by a name of its own."""

import numpy as np
import pytest
import torch

from torchrg.datasets import FolderOfClouds
from torchrg.errors import FormatError
from torchrg.io import write_cloud
from torchrg.structures import Cloud

COORDINATES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]], np.float32)


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "scans"
    (root / "b" / "deep").mkdir(parents=True)
    (root / ".hidden").mkdir()
    for name in ("scan_10.ply", "scan_9.PCD", "b/deep/x.xyz", "b/a.npz", ".hidden/y.ply"):
        write_cloud(root / name, Cloud(COORDINATES))
    for name in (".z.ply", "README.md"):
        (root / name).write_bytes(b"0 0 0\n")
    return root


def names_of(data):
    return [scene.name for scene in data.scenes]


def test_files_are_found_in_natural_order(root):
    data = FolderOfClouds(root)
    assert names_of(data) == ["b/a", "b/deep/x", "scan_9", "scan_10"]
    assert [scene.files for scene in data.scenes] == [(scene.path,) for scene in data.scenes]
    for i in range(4):
        assert torch.equal(data[i]["coord"], torch.from_numpy(COORDINATES))
        assert data[i]["name"] == names_of(data)[i]


def test_equal_names_keep_their_suffix(root):
    write_cloud(root / "scan_10.npy", Cloud(COORDINATES))
    assert names_of(FolderOfClouds(root))[-2:] == ["scan_10.npy", "scan_10.ply"]


def test_suffixes_can_be_chosen(root):
    assert names_of(FolderOfClouds(root, suffixes=[".ply"])) == ["scan_10"]
    with pytest.raises(FormatError, match=r"expected files that end in one of \.e57, got none"):
        FolderOfClouds(root, suffixes=[".e57"])


def test_fields_and_far_origins_are_kept(tmp_path):
    fields = {
        "normals": np.eye(3, dtype=np.float32),
        "color": np.full((3, 3), 7, np.uint8),
        "labels": np.array([0, 1, -1]),
    }
    far = COORDINATES.astype(np.float64) + np.array([5e6, 4e6, 10.5])
    write_cloud(tmp_path / "far.npz", Cloud(far, fields))
    sample = FolderOfClouds(tmp_path)[0]
    assert set(sample) == {"coord", "origin", "normal", "color", "labels", "name"}
    assert sample["coord"].dtype == torch.float32
    assert (sample["origin"].shape, sample["origin"].dtype) == ((1, 3), torch.float64)
    assert torch.equal(sample["coord"].double() + sample["origin"], torch.from_numpy(far))
    assert torch.equal(sample["normal"], torch.eye(3))
    assert sample["labels"].tolist() == [0, 1, -1]


def test_folders_of_pointcept_are_clouds(tmp_path):
    scene = tmp_path / "Area_1" / "office_1"
    scene.mkdir(parents=True)
    np.save(scene / "coord.npy", COORDINATES)
    np.save(scene / "segment.npy", np.zeros((3, 1), np.int16))
    np.save(scene / "unknown.npy", np.zeros(5))
    data = FolderOfClouds(tmp_path)
    assert names_of(data) == ["Area_1/office_1"]
    assert data.scenes[0].files == (scene / "coord.npy", scene / "segment.npy")
    assert data[0]["segment"].tolist() == [0, 0, 0]


def test_the_transform_is_called(root):
    assert FolderOfClouds(root, transform=lambda sample: len(sample["coord"]))[1] == 3


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FormatError, match="no such folder"):
        FolderOfClouds(tmp_path / "scans")
