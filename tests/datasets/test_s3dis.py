"""The data set lists rooms in natural order and leaves the release alone."""

import pickle
import warnings

import numpy as np
import pytest
import torch

from tests.datasets.s3dis_tree import digest, rows_of, text_of, write_clean_room, write_objects
from torchrg.datasets import S3DIS, read_room
from torchrg.errors import ConfigError, FormatError

pytest.importorskip("pyarrow", reason="needs torchrg[text]")
pytestmark = pytest.mark.filterwarnings("ignore:.*rooms, got:UserWarning")


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "Stanford3dDataset_v1.2_Aligned_Version"
    for room, seed in (("office_10", 1), ("office_2", 2), ("WC_1", 3)):
        write_clean_room(root / "Area_1" / room, seed, {"wall_1": 30, "chair_2": 20})
    write_objects(
        root / "Area_3" / "hallway_1",
        {"floor_1.txt": text_of(rows_of(9, 10)) + b"1 2 3 4 5 \x16\n", "x.md": b""},
    )
    (root / "Area_1" / ".DS_Store").write_bytes(b"\0")
    return root


def test_rooms_are_in_natural_order_with_all_their_files(root):
    data = S3DIS(root, (1, 3))
    names = [scene.name for scene in data.scenes]
    assert names == ["Area_1/office_2", "Area_1/office_10", "Area_1/WC_1", "Area_3/hallway_1"]
    assert len(data) == 4
    folder = root / "Area_1" / "office_2" / "Annotations"
    assert data.scenes[0].path == folder.parent
    assert data.scenes[0].files == (folder / "chair_2.txt", folder / "wall_1.txt")


def test_a_sample_is_the_room(root):
    data = S3DIS(root, [3])
    sample, room = data[0], read_room(root / "Area_3" / "hallway_1")
    assert list(sample) == ["coord", "color", "segment", "instance", "name"]
    assert sample["name"] == "Area_3/hallway_1"
    dtypes = [torch.float32, torch.uint8, torch.int64, torch.int64]
    for i, name in enumerate(("coord", "color", "segment", "instance")):
        assert sample[name].dtype == dtypes[i]
        expected = room.coordinates if name == "coord" else room.fields[name]
        assert np.array_equal(sample[name].numpy(), expected)
    assert data.classes[sample["segment"][0]] == "floor"


def test_data_sets_survive_pickling(root):
    data = pickle.loads(pickle.dumps(S3DIS(root, [1])))
    assert data[2]["name"] == "Area_1/WC_1"


def test_notes_and_repairs_are_those_of_the_room(root):
    before = digest(root)
    room = S3DIS(root, [3]).read_cloud(0)
    (repair,), (note,) = room.repairs, room.notes
    assert repair == r"floor_1.txt: line 11, column 11: b'1 2 3 4 5 \x16' read as b'1 2 3 4 5 6'"
    assert note == "x.md not read: not named CLASS_NUMBER.txt"
    assert digest(root) == before


def test_a_room_folder_without_annotations_is_named_in_the_warning(root):
    (root / "Area_3" / "lobby_1").mkdir()
    with pytest.warns(UserWarning, match=r"expected 23 rooms, got 1 \(lobby_1: no Annotations\)"):
        assert len(S3DIS(root, [3])) == 1


def test_a_complete_area_warns_of_nothing(tmp_path):
    for i in range(23):
        write_objects(tmp_path / "Area_3" / f"office_{i}", {"wall_1.txt": b"1 2 3 4 5 6\n"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(S3DIS(tmp_path, [3])) == 23


def test_missing_areas_are_errors_with_the_repair(root):
    with pytest.raises(FormatError, match="expected a folder Area_2, got none; select existing"):
        S3DIS(root)
    with pytest.raises(FormatError, match=r"got none; pass .*Aligned_Version"):
        S3DIS(root.parent)
    for folder in ("Area_1", "Area_1/office_0"):
        (root / "Area_1" / "office_0").mkdir(parents=True, exist_ok=True)
        with pytest.raises(FormatError, match=rf"expected a folder Area_1, .* pass {root}\."):
            S3DIS(root / folder)
    with pytest.raises(ConfigError, match="expected areas among 1, 2, 3, 4, 5, 6, got 7"):
        S3DIS(root, [7])


def test_a_room_without_objects_fails_when_it_is_read_and_not_before(root):
    (root / "Area_1" / "office_0" / "Annotations").mkdir(parents=True)
    with pytest.warns(UserWarning, match="rooms"):
        data = S3DIS(root, [1])
    names = [scene.name for scene in data.scenes]
    assert "Area_1/office_0" in names
    with pytest.raises(FormatError, match="expected CLASS_NUMBER"):
        data[names.index("Area_1/office_0")]
