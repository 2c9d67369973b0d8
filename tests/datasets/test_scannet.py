"""ScanNet and ScanNet++ read as Pointcept's preprocessing defines their labels."""

import json

import numpy as np
import pytest

from tests.datasets.scannet_tree import ALIGNMENT, write_scan, write_scan_plus, write_tables
from torchrg.datasets import ScanNet
from torchrg.datasets.scannet import IDS_200
from torchrg.errors import ConfigError, FormatError

SEGMENTS = np.array([40, 40, 7, 7, 3, 3, 12, 12])
OBJECTS = [("office chair", [7]), ("floor", [40]), ("lamp", [12])]
CATEGORY = [2, 2, 5, 5, 0, 0, 35, 35]
"""In NYU40; a lamp is none of the 20 classes."""


@pytest.fixture
def scans():
    random = np.random.default_rng(0)
    coord = random.normal(size=(8, 3)).astype(np.float32)
    return coord, random.integers(0, 256, (8, 3)).astype(np.uint8)


@pytest.fixture
def tree(scans, tmp_path):
    write_scan(tmp_path / "scans", "scene0010_00", *scans, SEGMENTS, OBJECTS)
    write_scan(tmp_path / "scans", "scene0002_01", *scans, SEGMENTS, OBJECTS)
    write_scan(tmp_path / "scans_test", "scene0707_00", *scans, None, None)
    return tmp_path


def test_vertices_are_points_and_have_the_classes_of_their_objects(tree, scans):
    write_tables(tree, ["scene0010_00"], ["scene0002_01"])
    data = ScanNet(tree)
    names = ["val/scene0002_01", "train/scene0010_00", "test/scene0707_00"]
    assert [scene.name for scene in data.scenes] == names
    sample = data[1]
    assert np.array_equal(sample["coord"], scans[0])
    assert np.array_equal(sample["color"], scans[1])
    assert sample["segment"].tolist() == [1, 1, 4, 4, -1, -1, -1, -1]
    assert data.classes[4] == "chair"
    ids = [IDS_200[place] if place >= 0 else 0 for place in sample["segment200"]]
    assert ids == [3, 3, 9, 9, 0, 0, 35, 35]
    assert sample["instance"].tolist() == [1, 1, 0, 0, -1, -1, 2, 2]
    assert np.allclose(sample["axis_align_matrix"], ALIGNMENT)
    assert sample["segment"].dtype == sample["instance"].dtype
    assert set(data[2]) == {"coord", "color", "name"}
    assert [ScanNet(tree, split)[0]["name"] for split in ("train", "val", "test")] == [
        names[1], names[0], names[2],
    ]  # fmt: skip


def test_without_tables_the_labels_of_vertices_say_the_classes(tree):
    data = ScanNet(tree)
    assert [scene.name.split("/")[0] for scene in data.scenes] == ["train", "train", "test"]
    assert data[0]["segment"].tolist() == [1, 1, 4, 4, -1, -1, -1, -1]
    assert "segment200" not in data[0]


def test_the_table_says_the_classes_without_labels_of_vertices(scans, tmp_path):
    write_scan(tmp_path, "scene0000_00", *scans, SEGMENTS, OBJECTS, with_labels=False)
    write_tables(tmp_path, ["scene0000_00"], [])
    assert ScanNet(tmp_path)[0]["segment"].tolist() == [1, 1, 4, 4, -1, -1, -1, -1]


def literal_labels(segments, objects, classes):
    """Up to three labels of each vertex in turn, and the one of the smallest object first."""
    rows = [[] for _ in segments]
    for number, (word, own) in enumerate(objects):
        if word not in classes:
            continue
        inside = [i for i, s in enumerate(segments) if s in own and len(rows[i]) < 3]
        for i in inside:
            rows[i].append((len(inside), classes[word], number + 1))
    segment, instance = np.full((len(rows), 3), -1), np.full((len(rows), 3), -1)
    for i, row in enumerate(rows):
        if row:
            least = min(range(len(row)), key=lambda place: row[place][0])
            row[0], row[least] = row[least], row[0]
        for place, (_, label, number) in enumerate(row):
            segment[i, place], instance[i, place] = label, number
    return segment, instance


def test_vertices_of_several_objects_have_the_smallest_first(scans, tmp_path):
    objects = [
        ("wall", [40, 7, 3]), ("chair", [7, 3]), ("SPLIT", [7]), ("table", [7]), ("wall", [7, 12]),
    ]  # fmt: skip
    write_scan_plus(tmp_path, "0a5c013435", *scans, SEGMENTS, objects)
    data = ScanNet(tmp_path)
    assert data.scenes[0].name == "train/0a5c013435"
    assert data.classes == ("wall", "office chair", "table")
    segment, instance = literal_labels(SEGMENTS, objects, {"wall": 0, "chair": 1, "table": 2})
    assert data[0]["segment"].tolist() == segment[:, 0].tolist()
    assert data[0]["instance"].tolist() == instance[:, 0].tolist()
    from torchrg.datasets import read_scannet_scan

    arrays = read_scannet_scan(data.scenes[0].path, tmp_path)
    assert np.array_equal(arrays["segment"], segment)
    assert np.array_equal(arrays["instance"], instance)
    assert arrays["segment"].dtype == np.int16


def test_what_is_wrong_names_the_file(tree, scans, tmp_path):
    path = tree / "scans" / "scene0010_00" / "scene0010_00_vh_clean_2.0.010000.segs.json"
    path.write_text(json.dumps({"segIndices": [1, 2]}))
    with pytest.raises(FormatError, match=r"segs.json: expected a segment of each of 8 vertices"):
        _ = ScanNet(tree, "train")[1]
    path.write_text("{")
    with pytest.raises(FormatError, match=r"segs.json: expected JSON with a list segIndices"):
        _ = ScanNet(tree, "train")[1]
    with pytest.raises(ConfigError, match="expected split to be one of train, val, test"):
        ScanNet(tree, "trainval")
    (tmp_path / "none").mkdir()
    with pytest.raises(FormatError, match="pass the folder that holds scans or data"):
        ScanNet(tmp_path / "none")
