"""Classes and objects of a release are the same after a layout, as its programs read them.

The reading is that of the programs in our own words; each function names whose it is.
"""

import json
import shutil

import numpy as np
import pytest

from tests.datasets.scannet_tree import WORDS, write_scan, write_scan_plus, write_tables
from torchrg import load_config
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.datasets import FolderOfClouds, ScanNet
from torchrg.datasets.layouts import LAYOUTS, LayoutScan, _boxes
from torchrg.datasets.scannet import read_objects, read_scannet_scan
from torchrg.errors import ConfigError, FormatError
from torchrg.scenes import make_room

pytestmark = pytest.mark.filterwarnings("ignore:.*segments belong to two objects:UserWarning")
SCAN = "scene0270_00"
NUM_POINTS = 400
# The first object is no wall, the third takes a segment of the second, the last one of the third.
OBJECTS = [
    ("office chair", [3, 8]),
    ("table", [11, 20]),
    ("lamp", [20, 21]),
    ("wall", [30]),
    ("table", [21, 40]),
]
SEGMENTS = np.array([3, 8, 11, 20, 21, 30, 40, 50])
"""Numbers of segments; the last is of no object."""


def read_as_mask3d(folder):
    """``ScannetPreprocessing.process_file``: the later group of a segment wins."""
    (groups,) = folder.glob("*.aggregation.json")
    (segments,) = folder.glob("*[0-9].segs.json")
    segments = np.array(json.loads(segments.read_text())["segIndices"])
    instance = np.full(len(segments), -1)
    for group in json.loads(groups.read_text())["segGroups"]:
        instance[np.isin(segments, np.array(group["segments"]))] = group["id"]
    return instance


def read_as_votenet(folder):
    """``export`` of VoteNet, MMDetection3D, OneFormer3D; ``save_scan_ids`` of SAI3D.

    Objects by ``objectId``, classes by the segments of all objects of a word.
    """
    (groups,) = folder.glob("*.aggregation.json")
    (segments,) = folder.glob("*[0-9].segs.json")
    vertices = {}
    for vertex, segment in enumerate(json.loads(segments.read_text())["segIndices"]):
        vertices.setdefault(segment, []).append(vertex)
    by_object, by_word = {}, {}
    for group in json.loads(groups.read_text())["segGroups"]:
        by_object[group["objectId"] + 1] = group["segments"]
        by_word.setdefault(group["label"], []).extend(group["segments"])
    labels, instance = np.zeros(NUM_POINTS, int), np.zeros(NUM_POINTS, int)
    for word, own in by_word.items():
        for segment in own:
            labels[vertices[segment]] = WORDS[word][0]
    for number, own in by_object.items():
        for segment in own:
            instance[vertices[segment]] = number
    return labels, instance


def write(folder, files):
    """Put the files of a layout below a folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)


def given_of(mesh, root):
    """Properties of a scan other than its points."""
    cloud = read_scannet_scan(mesh, root)
    return {**cloud.fields, **cloud.header}


class Release:
    """A small scan whose segments and superpoints know nothing of each other."""

    def __init__(self, root):
        random = np.random.default_rng(7)
        self.coord = random.random((NUM_POINTS, 3)).astype(np.float32)
        color = random.integers(0, 256, self.coord.shape).astype(np.uint8)
        segments = random.choice(SEGMENTS, NUM_POINTS)
        write_scan(root / "scans", SCAN, self.coord, color, segments, OBJECTS)
        write_tables(root, [SCAN], [])
        self.folder = root / "scans" / SCAN
        groups = self.folder / f"{SCAN}.aggregation.json"
        content = json.loads(groups.read_text())
        for number, group in enumerate(content["segGroups"]):
            group["objectId"] = number + 2
        groups.write_text(json.dumps(content))
        self.mesh = self.folder / f"{SCAN}_vh_clean_2.ply"
        self.superpoint = random.integers(0, 30, NUM_POINTS)

    def scan(self, root, **changes):
        """The scan as a layout takes it."""
        parts = {
            "name": SCAN,
            "declared_split": "train",
            "folder": f"scans/{SCAN}",
            "dataset": "ScanNet",
            "coord": self.coord,
            "normal": np.zeros_like(self.coord),
            "superpoint": self.superpoint,
            "plane": self.superpoint % 3 - 1,
            "inputs": given_of(self.mesh, root),
            "objects": read_objects(self.mesh, NUM_POINTS),
        }
        return LayoutScan(**(parts | changes))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("scannet")


@pytest.fixture(scope="module")
def release(root):
    return Release(root)


def test_the_pair_of_segments_and_groups_has_the_objects_of_the_release(release, root, tmp_path):
    scan = release.scan(root)
    write(tmp_path, LAYOUTS["scannet"]["ScanNet"](scan))
    folder = tmp_path / "scans" / SCAN
    instance = read_as_mask3d(release.folder)
    assert set(instance.tolist()) == {-1, 0, 1, 2, 3, 4}
    assert np.array_equal(read_as_mask3d(folder), instance)
    for new, old in zip(read_as_votenet(folder), read_as_votenet(release.folder), strict=True):
        assert np.array_equal(new, old)
    release_groups, groups = (
        json.loads((place / f"{SCAN}.aggregation.json").read_text())["segGroups"]
        for place in (release.folder, folder)
    )
    keys = ("id", "objectId", "label")
    assert [[g[k] for k in keys] for g in groups] == [[g[k] for k in keys] for g in release_groups]


def test_segments_beside_the_groups_of_the_release_have_no_objects(release, root, tmp_path):
    write(tmp_path, LAYOUTS["scannet"]["ScanNet"](release.scan(root)))
    folder = tmp_path / "scans" / SCAN
    shutil.copy(release.folder / f"{SCAN}.aggregation.json", folder)
    assert (read_as_mask3d(folder) == -1).all()
    with pytest.raises(KeyError):
        read_as_votenet(folder)


def test_segments_of_the_pair_are_superpoints_cut_at_objects_and_nowhere_else(release, root):
    files = LAYOUTS["scannet"]["ScanNet"](release.scan(root))
    path = f"scans/{SCAN}/{SCAN}_vh_clean_2.0.010000.segs.json"
    segments = np.array(json.loads(files[path])["segIndices"])
    released = json.loads((release.folder / path.rpartition("/")[2]).read_text())["segIndices"]
    inside = [np.isin(released, own) for _, own in OBJECTS]
    whole = np.unique(np.stack([segments, release.superpoint, *inside]), axis=1)
    parts = np.unique(np.stack([release.superpoint, *inside]), axis=1)
    assert whole.shape[1] == parts.shape[1] == len(np.unique(segments)) > 30


def test_an_unannotated_scan_has_segments_and_no_groups(release, root):
    scan = release.scan(root, objects=None)
    files = LAYOUTS["scannet"]["ScanNet"](scan)
    assert {name.partition(".")[2] for name in files} == {
        "0.010000.segs.json",
        "planes.segs.json",
    }
    path = f"scans/{SCAN}/{SCAN}_vh_clean_2.0.010000.segs.json"
    assert json.loads(files[path])["segIndices"] == release.superpoint.tolist()


def test_the_first_object_of_a_scan_has_a_box(release, root):
    """``ScanNetData.get_infos``: the last column of a box is its category."""
    files = LAYOUTS["mmdet3d"]["ScanNet"](release.scan(root))
    boxes = files[f"scannet_instance_data/{SCAN}_unaligned_bbox.npy"]
    instance = read_as_mask3d(release.folder)
    expected = []
    for number, (word, _) in enumerate(OBJECTS):
        if word in ("office chair", "table"):
            low, high = (f(release.coord[instance == number], axis=0) for f in (np.min, np.max))
            expected.append([*(low + high) / 2, *(high - low), WORDS[word][0]])
    assert len(boxes) == 3
    assert np.allclose(boxes, expected, atol=1e-6)


def test_the_category_of_a_box_is_that_of_most_of_its_points():
    chair, table = WORDS["office chair"][0], WORDS["table"][0]
    for few, most in ((chair, table), (table, chair)):
        boxes = _boxes(np.eye(3), np.array([few, most, most]), np.array([1, 1, 1]))
        assert boxes.tolist() == [[0.5, 0.5, 0.5, 1, 1, 1, most]]


def test_pointcepts_classes_of_scannet_become_categories_of_nyu40(release, root):
    given = given_of(release.mesh, root)
    del given["category"]
    given["segment20"] = np.arange(NUM_POINTS) % 21 - 1
    files = LAYOUTS["mmdet3d"]["ScanNet"](release.scan(root, inputs=given))
    found = np.frombuffer(files[f"semantic_mask/{SCAN}.bin"], np.int64)
    numbers = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36, 39]
    assert np.array_equal(found, np.resize(numbers, NUM_POINTS))


def as_one_object(release, root, number, category=5):
    """The scan with one object of one class."""
    labels = {"instance": np.full(NUM_POINTS, number), "category": np.full(NUM_POINTS, category)}
    return release.scan(root, inputs={**given_of(release.mesh, root), **labels})


def test_ground_truth_of_mask3d_tells_classes_and_objects(release, root):
    """``get_instances``: the class is the number in thousands."""
    files = LAYOUTS["mask3d"]["ScanNet"](as_one_object(release, root, 998))
    truth = np.array(files[f"instance_gt/train/{SCAN}.txt"].split(), dtype=int)
    assert set((truth // 1000).tolist()) == {5}
    assert set((truth % 1000).tolist()) == {999}


@pytest.mark.parametrize(
    ("number", "category", "words"),
    [
        (999, 5, "numbers of objects from -1 to 998 for layout mask3d, got 999"),
        (-2, 5, "numbers of objects from -1 to 998 for layout mask3d, got -2"),
        (0, 2**24 + 1, "numbers of classes from 0 to 16,777,215 for layout mask3d, .*16,777,217"),
    ],
)
def test_numbers_that_mask3d_would_read_as_others_are_refused(
    release, root, number, category, words
):
    with pytest.raises(FormatError, match=f"^{SCAN}: expected {words}"):
        LAYOUTS["mask3d"]["ScanNet"](as_one_object(release, root, number, category))


def test_superpoints_of_scannet_plusplus_are_where_sai3d_reads_them(tmp_path):
    """``init_seg``: ``scans/<scan>/scans/mesh_aligned_0.05.0.010000.segs.json``, by vertex.

    Its objects are in other files, so that superpoints do not end at them.
    """
    made = make_room(num_points=700, seed=2)
    coord, faces = made.points.float().numpy(), made.labels.numpy()
    color = np.zeros(coord.shape, np.uint8)
    objects = [("wall", [0, 1]), ("table", [1, 2])]
    write_scan_plus(tmp_path / "in", "0a5c013435", coord, color, faces, objects)
    settings, out = load_config("classic"), tmp_path / "out"
    for layout in ("scannet", "npy"):
        source = CloudSource(ScanNet(tmp_path / "in"), settings, layout=layout)
        (job,) = list_jobs(source, out / layout)
        assert convert_scan(job).status == "converted"
    path = out / "scannet/scans/0a5c013435/scans/mesh_aligned_0.05.0.010000.segs.json"
    segments = json.loads(path.read_text())["segIndices"]
    assert segments == np.load(out / "npy" / "superpoints" / "0a5c013435.npy").tolist()
    assert not [*out.rglob("*aggregation*")]
    for layout in ("mmdet3d", "spformer", "isbnet", "mask3d"):
        source = CloudSource(ScanNet(tmp_path / "in"), settings, layout=layout)
        with pytest.raises(ConfigError, match=r"pointcept, scannet, nag, npy for ScanNet\+\+, got"):
            list_jobs(source, tmp_path / "other")


def test_pointcepts_folders_of_unknown_classes_have_no_layout_with_classes(tmp_path):
    folder = tmp_path / "in" / "Area_1" / "office_1"
    folder.mkdir(parents=True)
    np.save(folder / "coord.npy", np.zeros((5, 3), np.float32))
    np.save(folder / "segment.npy", np.zeros((5, 1), np.int16))
    for layout in LAYOUTS:
        source = CloudSource(FolderOfClouds(tmp_path / "in"), load_config("classic"), layout=layout)
        if layout in ("scannet", "nag", "npy"):
            assert len(list_jobs(source, tmp_path / "out")) == 1
            continue
        with pytest.raises(ConfigError, match="scannet, nag, npy for Area_1/office_1, got"):
            list_jobs(source, tmp_path / "out")
    np.save(folder / "segment20.npy", np.zeros(5, np.int64))
    source = CloudSource(FolderOfClouds(tmp_path / "in"), load_config("classic"), layout="mask3d")
    assert len(list_jobs(source, tmp_path / "out")) == 1
