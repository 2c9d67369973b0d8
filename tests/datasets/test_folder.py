"""A folder of clouds lists every readable file, in natural order, by a name of its own."""

import traceback
import warnings

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from torchrg.datasets import FolderOfClouds, RGBDFrames
from torchrg.datasets.folder import add_note, natural_key
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


@pytest.mark.parametrize("other", ["scan_10.npy", "scan_10.Ply", "scan_10/coord.npy"])
def test_two_of_one_name_are_refused_whatever_their_suffixes(root, other):
    assert names_of(FolderOfClouds(root))[-1] == "scan_10"
    (root / other).parent.mkdir(exist_ok=True)
    np.save(root / "array.npy", COORDINATES)
    (root / "array.npy").rename(root / other)
    names = sorted(["scan_10.ply", other.removesuffix("/coord.npy")], key=natural_key)
    with pytest.raises(FormatError, match=f"one file per scan, got {' and '.join(names)};"):
        FolderOfClouds(root)


def test_a_name_does_not_depend_on_what_else_there_is(root):
    write_cloud(root / "b" / "scan.ply", Cloud(COORDINATES))
    (root / "b" / "scan.ply").rename(root / "b" / "scan.pcd.ply")
    before = {scene.path: scene.name for scene in FolderOfClouds(root).scenes}
    assert before[root / "b" / "scan.pcd.ply"] == "b/scan.pcd"
    write_cloud(root / "b" / "scan.pcd", Cloud(COORDINATES))
    after = {scene.path: scene.name for scene in FolderOfClouds(root).scenes}
    assert after == {**before, root / "b" / "scan.pcd": "b/scan"}
    write_cloud(root / "b" / "scan.npz", Cloud(COORDINATES))
    with pytest.raises(FormatError, match=r"got b/scan.npz and b/scan.pcd; .*by suffix"):
        FolderOfClouds(root)
    assert "b/scan" in names_of(FolderOfClouds(root, suffixes=[".ply", ".pcd", ".xyz"]))


def warned(root):
    """Return the names of the clouds of a folder, and the one warning about links, or nothing."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        names = names_of(FolderOfClouds(root))
    assert len(caught) <= 1
    return names, str(caught[0].message) if caught else ""


def test_links_in_a_loop_are_passed_over(root):
    expected = names_of(FolderOfClouds(root))
    (root / "b" / "loop").symlink_to("..")
    (root / "b" / "deep" / "again").symlink_to(root / "b")
    (root / "self").symlink_to(".")
    (root / "above").symlink_to("../..")
    names, warning = warned(root)
    assert names == expected
    assert warning.startswith(f"{root}: skipped above and 3 more: links to files")


def test_links_to_other_places_are_followed_and_each_file_counts_once(root, tmp_path):
    other = tmp_path / "other"
    (other / "sub").mkdir(parents=True)
    for name in ("x.ply", "sub/y.ply"):
        write_cloud(other / name, Cloud(COORDINATES))
    (other / "back").symlink_to(root)
    expected = names_of(FolderOfClouds(root))
    (root / "c").symlink_to(other)
    (root / "file.ply").symlink_to(other / "x.ply")
    (root / "gone.ply").symlink_to(other / "nothing.ply")
    names, warning = warned(root)
    # The link to the folder comes first; what it leads back to has a name without links.
    assert names == sorted([*expected, "c/sub/y", "c/x", "gone"], key=natural_key)
    assert "skipped file.ply and 1 more: links" in warning
    # A link comes after what is there itself, whatever their order.
    (root / "a").symlink_to("b")
    assert warned(root)[0] == names


def test_a_folder_of_links_is_a_data_set(root, tmp_path):
    farm = tmp_path / "farm"
    farm.mkdir()
    for number, path in enumerate(sorted(root.rglob("*.ply"))):
        (farm / f"{number}.ply").symlink_to(path)
    assert warned(farm) == (["0", "1", "2"], "")
    (farm / "scans").symlink_to(root)
    names, warning = warned(farm)
    assert names == ["0", "1", "2", "scans/b/a", "scans/b/deep/x", "scans/scan_9"]
    assert warning.startswith(f"{farm}: skipped scans/scan_10.ply: ")


def test_suffixes_can_be_chosen(root):
    assert names_of(FolderOfClouds(root, suffixes=[".ply"])) == ["scan_10"]
    with pytest.raises(FormatError, match=r"expected files ending in \.e57, got none"):
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


def raise_of_third(sample):
    if sample["name"] == "scan_9":
        raise IndexError("no rows")
    return sample


@pytest.mark.parametrize("num_workers", [None, 0, 1])
def test_an_error_of_the_transform_names_the_scan(root, num_workers):
    data = FolderOfClouds(root, transform=raise_of_third)
    loader = data
    if num_workers is not None:
        loader = DataLoader(data, batch_size=None, num_workers=num_workers)
    with pytest.raises(IndexError) as info:
        list(loader)
    text = "".join(traceback.format_exception(info.value))
    assert f"Sample 2, scan_9, was read from {root / 'scan_9.PCD'}." in text


def test_an_index_error_does_not_end_a_loop(root):
    seen = []
    with pytest.raises(IndexError, match="no rows"):
        seen.extend(sample["name"] for sample in FolderOfClouds(root, transform=raise_of_third))
    with pytest.raises(IndexError, match="list index"):
        FolderOfClouds(root)[4]


def test_slices_are_subsets(root):
    data = FolderOfClouds(root, transform=lambda sample: sample["name"])
    assert [*data[1:3]] == [data[1], data[2]]
    assert len(data[:-1]) == 3


def test_a_data_set_is_shown_by_its_folder(root):
    assert repr(FolderOfClouds(root)) == f"FolderOfClouds('{root}', 4 scenes)"
    assert repr(RGBDFrames([])) == "RGBDFrames(0 scenes)"


def test_files_without_points_are_skipped_with_one_line(root):
    (root / "readme.txt").write_text("Scans of a house.\n1. Look at 3 of them.\n")
    np.save(root / "labels.npy", np.arange(3))
    with pytest.warns(UserWarning, match=r"skipped labels\.npy and 1 more: files without points"):
        assert names_of(FolderOfClouds(root))[-1] == "scan_10"


@pytest.mark.parametrize("content", [b"0 1\0", b"1 2 3\n", b"", b"\xff\xfe garbage"])
def test_damaged_files_stay_scans(root, content):
    (root / "z.txt").write_bytes(content)
    (root / "y.npy").write_bytes(content)
    assert names_of(FolderOfClouds(root))[-2:] == ["y", "z"]


def test_arrays_of_a_scene_need_its_coordinates(root):
    (root / "room").mkdir()
    np.save(root / "room" / "color.npy", COORDINATES)
    np.save(root / "room" / "segment.npy", np.zeros(3, int))
    with pytest.raises(FormatError, match=r"room: expected coord\.npy next to color\.npy"):
        FolderOfClouds(root)
    np.save(root / "room" / "coord.npy", COORDINATES)
    assert "room" in names_of(FolderOfClouds(root))


def test_add_note_by_example():
    error = ValueError("expected a floor")
    add_note(error, "This was room 3.")
    assert "room 3" in "".join(traceback.format_exception(error))


def test_rooms_of_s3dis_are_told(root):
    (root / "office_1" / "Annotations").mkdir(parents=True)
    write_cloud(root / "office_1" / "Annotations" / "wall_1.txt", Cloud(COORDINATES))
    with pytest.warns(
        UserWarning, match=r"scans: folders Annotations .* use torchrg convert s3dis"
    ):
        FolderOfClouds(root)
