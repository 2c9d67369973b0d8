"""ScanNet and ScanNet++ read as Pointcept's preprocessing defines their labels."""

import json
import re

import numpy as np
import pytest

from tests.datasets.scannet_tree import ALIGNMENT, write_scan, write_scan_plus, write_tables
from torchrg import Cloud, load_config, write_cloud
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.datasets import ScanNet, read_scannet_scan
from torchrg.datasets.scannet import IDS_200, NYU_IDS, _index_in
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
    assert set(data[2]) == {"coord", "color", "front", "name"}
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
    arrays = read_scannet_scan(data.scenes[0].path, tmp_path).fields
    assert np.array_equal(arrays["segment"], segment)
    assert np.array_equal(arrays["instance"], instance)
    assert arrays["segment"].dtype == np.int16


def test_what_is_wrong_names_the_file(tree, scans, tmp_path):
    path = tree / "scans" / "scene0010_00" / "scene0010_00_vh_clean_2.0.010000.segs.json"
    path.write_text(json.dumps({"segIndices": [1, 2]}))
    with pytest.raises(FormatError, match=r"segs.json: expected 8 segments, got"):
        _ = ScanNet(tree, "train")[1]
    path.write_text("{")
    with pytest.raises(FormatError, match=r"segs.json: expected JSON with a list segIndices"):
        _ = ScanNet(tree, "train")[1]
    with pytest.raises(ConfigError, match="expected split to be one of train, val, test"):
        ScanNet(tree, "trainval")
    (tmp_path / "none").mkdir()
    with pytest.raises(FormatError, match="pass the folder that contains scans or data"):
        ScanNet(tmp_path / "none")


def test_lists_and_tables_may_begin_with_a_mark(tree, scans, tmp_path):
    write_tables(tree, ["scene0010_00"], ["scene0002_01"])
    plain = ScanNet(tree)
    before = [(plain.scenes[i].name, plain[i]["segment"]) for i in range(2)]
    for path in tree.rglob("*"):
        if path.suffix in (".txt", ".tsv", ".json"):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    data = ScanNet(tree)
    for i, (name, segment) in enumerate(before):
        assert data.scenes[i].name == name
        assert data[i]["segment"].tolist() == segment.tolist()
    assert np.allclose(data[0]["axis_align_matrix"], ALIGNMENT)
    write_scan_plus(tmp_path / "plus", "0a5c013435", *scans, SEGMENTS, [("chair", [7])])
    for path in (tmp_path / "plus" / "metadata" / "semantic_benchmark").iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    plus = ScanNet(tmp_path / "plus")
    assert plus.classes == ("wall", "office chair", "table")
    assert plus[0]["segment"].tolist() == [-1, -1, 1, 1, -1, -1, -1, -1]


def test_names_on_lists_that_are_no_scans_are_told_in_one_line(tree):
    write_tables(tree, ["scene0010_00", "scene9\x1b[1m", "scene8"], ["scene0002_01", "scene7"])
    message = r"scannetv2_train\.txt: 3 of 5 listed scans are missing; .*: 'scene9\\x1b\[1m' and"
    with pytest.warns(UserWarning, match=message) as caught:
        data = ScanNet(tree)
    assert len(caught) == 1
    assert [scene.name[:4] for scene in data.scenes] == ["val/", "trai", "test"]


TABLE = "meta_data/scannetv2-labels.combined.tsv"
HEAD = b"id\traw_category\tcategory\tcount\tnyu40id\n"


LISTS = ("meta_data/scannetv2_train.txt", "meta_data/scannetv2_val.txt")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (LISTS[0], b"sc\xe8ne\n", r"byte 2: expected UTF-8, got b'\\xe8'"),
        (LISTS[1], "scene0".encode("utf-16"), "byte 0: expected UTF-8"),
        (LISTS[1], b"scene0\0", r"byte 6: expected UTF-8, got b'\\x00'"),
        (TABLE, HEAD.replace(b"nyu40id", b"nyu40"), "expected .*, got: none called nyu40id"),
        (TABLE, HEAD + b"1\twall\n", "expected a table with .*, got: line 2 with fewer"),
        (TABLE, HEAD + b"1\twall\twall\t3\t1e18\n", "'wall': expected nyu40id .*, got '1e18'"),
        (TABLE, HEAD + b"1.5\twall\twall\t3\t1\n", "'wall': expected id .*, got '1.5'"),
        (TABLE, HEAD + b"-1\twall\twall\t3\t1\n", "'wall': expected id .*, got '-1'"),
        (TABLE, HEAD + b"nan\twall\twall\t3\t1\n", "'wall': expected id .*, got 'nan'"),
        (TABLE, HEAD + b"1\tw\xe4nde\twall\t3\t1\n", "byte 42: expected UTF-8"),
    ],
)
def test_lists_and_tables_are_refused_before_any_scan(tree, name, content, message):
    write_tables(tree, ["scene0010_00"], ["scene0002_01"])
    (tree / name).write_bytes(content)
    with pytest.raises(FormatError, match=rf"{name}: {message}"):
        ScanNet(tree)


GROUP = {"id": 0, "objectId": 0, "segments": [7], "label": "lamp"}
SEGS, GROUPS = "scene0010_00_vh_clean_2.0.010000.segs.json", "scene0010_00.aggregation.json"


def segments(value):
    return json.dumps({"segIndices": [40, 40, value, 7, 3, 3, 12, 12]})


def groups(**changes):
    group = {key: value for key, value in (GROUP | changes).items() if value is not ...}
    return json.dumps({"segGroups": [GROUP, group]})


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (SEGS, segments(1.7), "expected segIndices to be integers, got: 1.7 as number 2"),
        (SEGS, segments("7"), "expected segIndices to be integers, got: '7' as number 2"),
        (SEGS, segments(True), "expected segIndices to be integers, got: True as number 2"),
        (SEGS, segments([7]), r"expected segIndices to be integers, got: \[7\] as number 2"),
        (SEGS, segments(10**20), "expected segIndices to be integers, got: Python int"),
        (SEGS, segments(7).replace("7", "1e400"), "expected segIndices .*, got: inf as number 2"),
        (SEGS, "7", "expected JSON with a list segIndices, got: 7"),
        (SEGS, '{"segIndices": 7}', "expected JSON with a list segIndices, got: {"),
        (SEGS, "[" * 200_000, "expected JSON with a list segIndices, got: (maximum rec|Stack)"),
        (SEGS, "9" * 5000, "expected JSON with a list segIndices, got: Exceeds the limit"),
        (SEGS, b'{"segIndices": ["\xe9"]}', "byte 17: expected UTF-8"),
        (GROUPS, '{"segGroups": 5}', "expected JSON with a list segGroups, got"),
        (GROUPS, '{"segGroups": [5]}', "object 0: expected a label, .*, got 5"),
        (GROUPS, groups(id=...), r"object 1: expected .* an integer from 0 to [\d,]+ as id"),
        (GROUPS, groups(id="3"), "object 1: expected"),
        (GROUPS, groups(id=1.5), "object 1: expected"),
        (GROUPS, groups(id=-1), "object 1: expected"),
        (GROUPS, groups(id=10**20), "object 1: expected"),
        (GROUPS, groups(label=5), "object 1: expected a label"),
        (GROUPS, groups(segments=7), "object 1: expected .* and a list of segments"),
        (GROUPS, groups(segments=[7, None]), "expected segments of object 1 to be integers"),
        ("scene0010_00.txt", f"axisAlignment = {'0 ' * 15}nan", "expected 16 finite numbers"),
        ("scene0010_00.txt", f"axisAlignment = {'0 ' * 15}1e400", "expected 16 finite numbers"),
        ("scene0010_00.txt", f"axisAlignment = {'0 ' * 15}", "expected 16 finite numbers"),
        (
            "scene0010_00.txt",
            f"axisAlignment = {'0 ' * 15}1",
            ".* to be rigid, got a rotation of z",
        ),
    ],
)
def test_annotations_that_are_none_are_refused_by_file_and_place(tree, name, content, message):
    path = tree / "scans" / "scene0010_00" / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    data = ScanNet(tree)
    with pytest.raises(FormatError) as caught:
        _ = data[1]
    assert re.match(rf"{re.escape(str(path))}: {message}", str(caught.value))
    assert "\n" not in str(caught.value)
    assert data[0]["instance"].tolist() == [1, 1, 0, 0, -1, -1, 2, 2]


@pytest.mark.parametrize(
    ("objects", "first"),
    [
        ([("floor", [12345, 777])], "object 0: .* got 12345, which is missing there; use the ann"),
        ([("floor", [40, 555]), ("chair", [999])], "object 0: expected segments of .*, got 555,"),
        ([("floor", [40]), ("chair", [7, 8])], "object 1: expected segments of .*, got 8, which"),
    ],
)
def test_segments_of_another_mesh_are_refused_by_the_first(scans, tmp_path, objects, first):
    write_scan(tmp_path / "scans", "scene0001_00", *scans, SEGMENTS, objects, with_labels=False)
    write_scan_plus(tmp_path / "plus", "0a5c013435", *scans, SEGMENTS, objects)
    for root, name in ((tmp_path, "aggregation.json"), (tmp_path / "plus", "segments_anno.json")):
        with pytest.raises(FormatError, match=rf"{name}: {first}"):
            _ = ScanNet(root)[0]


def test_what_two_objects_claim_is_told_and_the_later_has_it(scans, tmp_path):
    objects = [("floor", [40, 7]), ("table", [7, 3, 40]), ("beanbag", [12])]
    write_scan(tmp_path / "in/scans", "scene0001_00", *scans, SEGMENTS, objects, with_labels=False)
    write_tables(tmp_path / "in", ["scene0001_00"], [])
    with pytest.warns(UserWarning, match="segments belong to two|objects have labels"):
        sample = ScanNet(tmp_path / "in")[0]
    assert sample["instance"].tolist() == [1, 1, 1, 1, 1, 1, 2, 2]
    source = CloudSource(ScanNet(tmp_path / "in"), load_config("classic"), layout="scannet")
    (job,) = list_jobs(source, tmp_path / "out")
    notes = [note.partition("aggregation.json: ")[2] for note in convert_scan(job).warnings]
    assert [note for note in notes if note] == [
        "segments belong to two objects, and the later is used: 7 and 1 more.",
        "objects have labels that are not in scannetv2-labels.combined.tsv: 'beanbag'.",
    ]


def test_two_objects_of_one_number_are_told(tree):
    path = tree / "scans" / "scene0010_00" / GROUPS
    path.write_text(groups(segments=[40]))
    with pytest.warns(UserWarning, match=r"ID with an earlier one and are merged into it: 0\.$"):
        assert ScanNet(tree)[1]["instance"].tolist() == [0, 0, 0, 0, -1, -1, -1, -1]


@pytest.mark.parametrize("label", [2**31 - 1, 65_536, -3])
def test_a_label_above_any_table_is_refused_and_takes_no_memory(tree, scans, label):
    path = tree / "scans" / "scene0010_00" / "scene0010_00_vh_clean_2.labels.ply"
    labels = np.array([2, 2, 5, 5, 0, label, 35, 35], np.int32)
    write_cloud(path, Cloud(scans[0], {"labels": labels}))
    with pytest.raises(
        FormatError, match=rf"vertex 5: expected a label from 0 to 65,535, got {label}"
    ):
        read_scannet_scan(path.with_name("scene0010_00_vh_clean_2.ply"), tree)


def test_classes_are_places_in_their_list():
    numbers = np.array([0, 1, 12, 13, 14, 39, 40, 65_535])
    expected = [NYU_IDS.index(number) if number in NYU_IDS else -1 for number in numbers]
    assert _index_in(numbers, NYU_IDS).tolist() == expected
    assert _index_in(np.array(IDS_200), IDS_200).tolist() == [*range(len(IDS_200))]


def test_object_numbers_of_scannetpp_fit_their_arrays(scans, tmp_path):
    write_scan_plus(tmp_path, "0a5c013435", *scans, SEGMENTS, [("chair", [7])])
    path = tmp_path / "data" / "0a5c013435" / "scans" / "segments_anno.json"
    path.write_text(path.read_text().replace('"objectId": 1', '"objectId": 40000'))
    with pytest.raises(FormatError, match=r"anno\.json: object 0: .* from 0 to 32,767 as objectId"):
        _ = ScanNet(tmp_path)[0]


def test_a_scan_of_two_splits_is_told(tree):
    write_tables(tree, ["scene0010_00"], ["scene0010_00"])
    with pytest.warns(UserWarning, match=r"_val\.txt: scans of another split are in val, .*010"):
        data = ScanNet(tree)
    assert "val/scene0010_00" in [scene.name for scene in data.scenes]


def test_objects_that_share_their_second_id_are_told(tree):
    write_tables(tree, ["scene0010_00"], [])
    path = next(tree.rglob(GROUPS))
    content = json.loads(path.read_text())
    for group in content["segGroups"]:
        group["objectId"] = 0
    path.write_text(json.dumps(content))
    with pytest.warns(UserWarning, match="objects share an ID with an earlier one"):
        read_scannet_scan(path.with_name(f"{path.parent.name}_vh_clean_2.ply"), tree)
