"""Each program finds superpoints and planes where it looks, each number at its point.

The loading lines are those of the programs in our own words, from descriptions of their files.
"""

import json
import pickletools
import shutil
from typing import get_args

import numpy as np
import pytest
import torch

from tests.datasets.s3dis_tree import digest
from tests.datasets.scannet_tree import ALIGNMENT, WORDS, write_scan, write_tables
from torchrg import load_config, make_superpoints, segment_planes
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan, reason_to_convert
from torchrg.batch.sources import CloudSource
from torchrg.cli.flags import Layout
from torchrg.config import SuperpointsConfig
from torchrg.datasets import ScanNet
from torchrg.datasets.layouts import LAYOUTS, _split, split_name
from torchrg.datasets.scannet import NYU_IDS
from torchrg.errors import ConfigError
from torchrg.io import read_cloud, write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

SCAN = "scene0011_00"
NUM_PARTS = 60
PARTITION = SuperpointsConfig(counts=(200, NUM_PARTS))
CLASSIC = load_config("classic")


class Room:
    """A made room as a scan of ScanNet, and what must be found about it."""

    def __init__(self, root):
        made = make_room(num_points=4000, noise=0.003, seed=3)
        self.coord = made.points.float().numpy()
        random = np.random.default_rng(1)
        self.color = random.integers(0, 256, self.coord.shape).astype(np.uint8)
        # Segments of ScanNet have gaps in their numbers; each is of one face.
        self.segments = made.labels.numpy() * 7 + 5
        words = [*WORDS, None]
        faces = np.unique(self.segments)
        self.objects = [
            (words[i % len(words)], [face]) for i, face in enumerate(faces) if words[i % len(words)]
        ]
        write_scan(root / "scans", SCAN, self.coord, self.color, self.segments, self.objects)
        write_scan(root / "scans_test", "scene0799_00", self.coord, self.color, None, None)
        write_tables(root, [SCAN], [])
        self.category = np.zeros(len(self.coord), int)
        self.instance = np.full(len(self.coord), -1)
        for number, (word, own) in enumerate(self.objects):
            inside = np.isin(self.segments, own)
            self.category[inside], self.instance[inside] = WORDS[word][0], number
        self.segment = np.array([NYU_IDS.index(c) if c in NYU_IDS else -1 for c in self.category])
        seg = segment_planes(self.coord, CLASSIC)
        parts = make_superpoints(self.coord, seg, PARTITION, colors=self.color)
        self.plane = seg.labels.numpy()
        self.normal = seg.normals.numpy()
        self.superpoint = parts.levels[0].numpy()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("scannet")


@pytest.fixture(scope="module")
def room(root):
    return Room(root)


def convert(root, out, layout, only=None, **settings):
    """What the command does, in this process; return what was done to each scan."""
    jobs = list_jobs(CloudSource(ScanNet(root), CLASSIC, layout=layout, **settings), out, only=only)
    return [convert_scan(job) for job in jobs if reason_to_convert(job)]


@pytest.fixture(scope="module")
def converted(root, room, tmp_path_factory):
    """The output in each layout but nag, which has a test of its own and wants h5py."""
    layouts = ["pointcept", *LAYOUTS.keys() - {"nag"}]
    folders = {layout: tmp_path_factory.mktemp(layout) for layout in layouts}
    settings = {"superpoint": True, "level": 1, "partition": PARTITION}
    for layout, folder in folders.items():
        reports = convert(root, folder, layout, **settings)
        assert [report.status for report in reports] == ["converted"] * 2, reports
    return folders


def test_pointcept(converted, room):
    """``VALID_ASSETS`` by ``np.load``, as ``ScanNetDataset.get_data`` casts them."""
    folder = converted["pointcept"] / "train" / SCAN
    found = {path.stem: np.load(path) for path in folder.glob("*.npy")}
    types = {"coord": "f4", "color": "u1", "normal": "f4", "segment20": "i8", "segment200": "i8"}
    types |= {"instance": "i8", "superpoint": "i4", "plane": "i4", "curvature": "f4"}
    assert {name: values.dtype.str[1:] for name, values in found.items()} == types
    assert np.array_equal(found["coord"], room.coord)
    assert np.array_equal(found["color"], room.color)
    assert np.array_equal(found["segment20"], room.segment)
    assert np.array_equal(found["instance"], room.instance)
    assert np.array_equal(found["superpoint"], room.superpoint)
    assert np.array_equal(found["plane"], room.plane)
    bare = converted["pointcept"] / "test" / "scene0799_00"
    assert not {"segment20", "instance"} & {path.stem for path in bare.iterdir()}


def test_scannet(converted, room):
    """``segIndices`` of the file that ``*[0-9].segs.json`` finds next to the mesh, by vertex."""
    folder = converted["scannet"] / "scans" / SCAN
    (path,) = folder.glob("*[0-9].segs.json")
    assert path.name == f"{SCAN}_vh_clean_2.0.010000.segs.json"
    content = json.loads(path.read_text())
    assert set(content) == {"params", "sceneId", "segIndices"}
    segments = np.array(content["segIndices"])
    pairs = np.unique(np.stack([segments, room.superpoint, room.instance]), axis=1)
    assert len(np.unique(segments)) == pairs.shape[1] > NUM_PARTS
    planes = json.loads((folder / f"{SCAN}_vh_clean_2.planes.segs.json").read_text())
    assert planes["segIndices"] == room.plane.tolist()
    bare = converted["scannet"] / "scans_test" / "scene0799_00"
    assert sorted(path.name for path in bare.iterdir()) == [
        "scene0799_00_vh_clean_2.0.010000.segs.json",
        "scene0799_00_vh_clean_2.planes.segs.json",
    ]


def test_mmdet3d(converted, room):
    """``np.frombuffer`` of what ``create_data`` copies, and the arrays that it reads."""
    folder = converted["mmdet3d"]
    data = folder / "scannet_instance_data"
    read = {
        path.name.removeprefix(f"{SCAN}_"): np.load(path) for path in data.glob(f"{SCAN}_*.npy")
    }
    # What create_data does with the superpoints must give the bytes that are there already.
    assert read["sp_label.npy"].tobytes() == (folder / "super_points" / f"{SCAN}.bin").read_bytes()
    found = np.frombuffer((folder / "super_points" / f"{SCAN}.bin").read_bytes(), dtype=np.int64)
    assert np.array_equal(found, room.superpoint)
    points = np.fromfile(folder / "points" / f"{SCAN}.bin", dtype=np.float32).reshape(-1, 6)
    assert np.array_equal(points, np.hstack([room.coord, room.color]).astype(np.float32))
    assert np.array_equal(points, read["vert.npy"])
    assert read["vert.npy"].dtype == np.float32
    category = np.fromfile(folder / "semantic_mask" / f"{SCAN}.bin", dtype=np.int64)
    assert np.array_equal(category, room.category)
    assert np.array_equal(read["sem_label.npy"], room.category)
    instance = np.fromfile(folder / "instance_mask" / f"{SCAN}.bin", dtype=np.int64)
    assert np.array_equal(instance, room.instance + 1)
    assert np.allclose(read["axis_align_matrix.npy"], ALIGNMENT, atol=1e-6)
    assert np.array_equal(read["plane.npy"], room.plane)
    # A box of each object of the 18 classes, in the numbers of NYU40.
    boxes = read["unaligned_bbox.npy"]
    things = [i for i, (word, _) in enumerate(room.objects) if WORDS[word][0] in NYU_IDS[2:]]
    assert len(boxes) == len(things) > 0
    for box, number in zip(boxes, things, strict=True):
        inside = room.coord[room.instance == number]
        assert np.allclose(box[:3] - box[3:6] / 2, inside.min(axis=0), atol=1e-6)
        assert box[6] == WORDS[room.objects[number][0]][0]
    turned = room.coord @ ALIGNMENT[:3, :3].T + ALIGNMENT[:3, 3]
    inside = turned[room.instance == things[0]]
    assert np.allclose(read["aligned_bbox.npy"][0, 3:6], np.ptp(inside, axis=0), atol=1e-5)
    assert {path.name for path in data.glob("scene0799_00*")} == {
        f"scene0799_00_{name}.npy" for name in ("vert", "sp_label", "plane")
    }


def load_pth(path):
    """What ``torch.load`` did by default before it asked."""
    return torch.load(path, weights_only=False)


def expected_objects(room):
    """Instances of SPFormer: no walls and floors, numbers without gaps."""
    objects, number = np.full(len(room.coord), -100), 0
    for i, (word, _) in enumerate(room.objects):
        if word not in ("wall", "floor"):
            objects[room.instance == i] = number
            number += 1
    return objects


def check_points(room, coord, color):
    assert coord.dtype == color.dtype == np.float32
    assert np.allclose(coord, room.coord - room.coord.mean(axis=0, dtype=float), atol=1e-5)
    assert np.abs(coord.mean(axis=0, dtype=float)).max() < 1e-5
    assert np.allclose(color, room.color / 127.5 - 1, atol=1e-6)
    coord += 1  # Programs change them in place.


def check_labels(room, segment, objects):
    assert np.array_equal(segment, np.where(room.segment < 0, -100, room.segment))
    assert np.array_equal(objects, expected_objects(room))
    for number in range(int(objects.max()) + 1):
        assert len(np.unique(segment[objects == number])) == 1


def test_spformer(converted, room):
    """Five arrays, the superpoints third; three of a test, whose superpoints are numbered again."""
    folder = converted["spformer"]
    (path,) = (folder / "train").glob("*_inst_nostuff.pth")
    assert path.name == f"{SCAN}_inst_nostuff.pth"
    coord, color, superpoint, segment, objects = load_pth(path)
    check_points(room, coord, color)
    check_labels(room, segment, objects)
    assert np.array_equal(superpoint, room.superpoint)
    assert superpoint.dtype == np.int64
    numbered = torch.from_numpy(np.unique(superpoint, return_inverse=True)[1])
    assert int(numbered.max()) + 1 == NUM_PARTS
    assert len(load_pth(folder / "test" / "scene0799_00_inst_nostuff.pth")) == 3
    assert np.array_equal(load_pth(folder / "planes" / f"{SCAN}.pth"), room.plane)


def test_isbnet(converted, room):
    """Four arrays, and the superpoints by the name of the scan."""
    folder = converted["isbnet"]
    path = next((folder / "train").glob("*_inst_nostuff.pth"))
    scan = path.name.replace("_inst_nostuff.pth", "")
    coord, color, segment, objects = load_pth(path)
    superpoint = load_pth(folder / "superpoints" / f"{scan}.pth")
    check_points(room, coord, color)
    check_labels(room, segment, objects)
    assert torch.equal(torch.from_numpy(superpoint), torch.from_numpy(room.superpoint))
    assert len(load_pth(folder / "test" / "scene0799_00_inst_nostuff.pth")) == 2


def test_mask3d(converted, room):
    """Columns of one array: 0:3, 3:6, 6:9, the segment 9, the labels 10 and 11."""
    folder = converted["mask3d"]
    points = np.load(folder / "train" / "0011_00.npy")
    assert points.dtype == np.float32
    coordinates, color, normals = points[:, :3], points[:, 3:6], points[:, 6:9]
    segments, labels = points[:, 9], points[:, 10:12]
    assert np.array_equal(coordinates, room.coord)
    assert np.array_equal(color, room.color)
    assert np.array_equal(abs(normals), abs(room.normal))
    # Its two faces say to which side the first four look, and the room where the others do.
    assert np.array_equal(normals[4:], room.normal[4:])
    assert np.array_equal(segments, room.superpoint)
    assert np.array_equal(np.unique(segments), np.arange(NUM_PARTS))
    assert np.array_equal(labels[:, 0], room.category)
    assert np.array_equal(labels[:, 1], room.instance)
    truth = np.loadtxt(folder / "instance_gt" / "train" / f"{SCAN}.txt", dtype=np.int64)
    assert np.array_equal(truth, room.category * 1000 + room.instance + 1)
    assert np.load(folder / "test" / "0799_00.npy").shape[1] == 10


def test_bare_arrays(converted, room):
    superpoint = np.load(converted["npy"] / "superpoints" / f"{SCAN}.npy")
    assert superpoint.dtype == np.int64
    assert np.array_equal(superpoint, room.superpoint)
    assert np.array_equal(np.load(converted["npy"] / "planes" / f"{SCAN}.npy"), room.plane)


def test_pickles_name_no_module_that_old_numpy_lacks(converted):
    paths = [path for layout in ("spformer", "isbnet") for path in converted[layout].rglob("*.pth")]
    assert len(paths) == 10
    for path in paths:
        opcodes = []
        with path.open("rb") as stream:
            while stream.tell() < path.stat().st_size:
                opcodes += pickletools.genops(stream)
        assert opcodes[0][1] == 2
        modules = {str(value).split()[0] for code, value, _ in opcodes if code.name == "GLOBAL"}
        assert modules <= {"numpy", "numpy.core.multiarray", "_codecs"}


def test_results_may_go_beside_the_scans_where_programs_look_for_them(root, room, tmp_path):
    place = tmp_path / "data"
    for layout in ("pointcept", "spformer"):
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(root, place)
        before = digest(place / "scans")
        for status in (["converted"], []):
            reports = convert(place, place, layout, only=f"*{SCAN}")
            assert [report.status for report in reports] == status
    assert digest(place / "scans") == before
    assert (place / "train" / f"{SCAN}_inst_nostuff.pth").is_file()
    for layout, out in (("scannet", place), ("spformer", place / "scans")):
        with pytest.raises(ConfigError, match="expected a directory outside"):
            convert(place, out, layout)


def test_the_command_knows_kind_and_layouts(root, room, tmp_path, run):
    assert set(get_args(Layout)) == {"pointcept", *LAYOUTS}
    command = ("convert", "scannet", root, tmp_path, "--preset", "classic")
    command += ("--only", f"*{SCAN}", "--layout", "npy", "--superpoints", NUM_PARTS)
    assert "1 converted" in run(*command).out
    found = np.load(tmp_path / "superpoints" / f"{SCAN}.npy")
    assert np.array_equal(np.unique(found), np.arange(NUM_PARTS))
    for flags, words in (
        (["--level", "1"], "expected --level from 0 to 0"),
        (["--layout", "pointcept", "--pages", "P", "--layout", "npy"], "with --layout pointcept"),
        (["--layout", "kitti"], "--layout"),
    ):
        done = run(*command, *flags)
        assert done.code == 2
        assert words in done.err


def test_colors_of_16_bits_are_those_of_8_in_layouts(room, tmp_path, run):
    color = room.color * np.uint16(257) - np.uint16(9) * (room.color > 0)
    (tmp_path / "scans").mkdir()
    write_cloud(tmp_path / "scans" / "hall.npz", Cloud(room.coord, {"color": color}))
    flags = ("--preset", "classic", "--superpoints", "50", "--layout")
    for layout in ("mmdet3d", "spformer", "mask3d", "pointcept"):
        out = tmp_path / layout
        assert run("convert", "folder", tmp_path / "scans", out, *flags, layout).code == 0
    points = np.load(tmp_path / "mmdet3d" / "scannet_instance_data" / "hall_vert.npy")
    assert np.array_equal(points[:, 3:], room.color)
    content = load_pth(tmp_path / "spformer" / "test" / "hall_inst_nostuff.pth")
    check_points(room, *content[:2])
    table = np.load(tmp_path / "mask3d" / "test" / "hall.npy")
    assert np.array_equal(table[:, 3:6], room.color)
    assert np.array_equal(np.load(tmp_path / "pointcept" / "hall" / "color.npy"), room.color)


def test_one_scan_of_any_format(room, tmp_path, run):
    scan = tmp_path / "scans" / "hall.ply"
    scan.parent.mkdir()
    write_cloud(scan, Cloud(room.coord, {"color": room.color}))
    flags = ["--preset", "classic", "--superpoints", f"200,{NUM_PARTS}", "--level", "1"]
    for layout in ("mmdet3d", "spformer", "pointcept"):
        out = tmp_path / layout
        command = ("convert", "folder", scan.parent, out, *flags)
        assert run(*command, "--layout", layout).code == 0
        assert (out / "hall" / "planes.json").is_file()
    found = np.fromfile(tmp_path / "mmdet3d" / "super_points" / "hall.bin", dtype=np.int64)
    assert np.array_equal(found, room.superpoint)
    assert len(load_pth(tmp_path / "spformer" / "test" / "hall_inst_nostuff.pth")) == 3
    folder = tmp_path / "pointcept" / "hall"
    assert np.array_equal(np.load(folder / "superpoint.npy"), room.superpoint)
    assert np.array_equal(np.load(folder / "plane.npy"), room.plane)
    assert read_cloud(scan).fields.keys() == {"color"}
    wrong = run(*command, "--layout", "npy", "--level", "4")
    assert "expected --level from 0 to 1" in wrong.error


def test_far_scans_are_about_their_origin_with_a_word(room, tmp_path, run):
    (tmp_path / "scans").mkdir()
    points = room.coord.astype(np.float64) + np.array([5e5, 4e6, 0])
    np.savez(tmp_path / "scans" / "far.npz", points=points)
    command = ("convert", "folder", tmp_path / "scans", tmp_path / "out", "--layout", "mmdet3d")
    done = run(*command, "--preset", "classic")
    assert "coordinates are written relative to 5000" in done.out
    points = np.fromfile(tmp_path / "out" / "points" / "far.bin", dtype=np.float32).reshape(-1, 6)
    shift = points[:, :3] - room.coord
    assert np.ptp(shift, axis=0).max() < 1e-5


def test_points_that_are_not_finite_are_refused(room, tmp_path, run):
    coord = room.coord.copy()
    coord[7] = np.nan
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "holes.npy", coord)
    command = ("convert", "folder", tmp_path / "scans", tmp_path / "out", "--layout", "npy")
    wrong = run(*command, "--preset", "classic")
    assert wrong.code == 3
    assert "expected finite points for layout npy, got 1 non-finite of 4,000" in wrong.err
    assert not [*(tmp_path / "out").rglob("*.npy")]


def test_split_name_by_example():
    assert (split_name("val/scene0011_00"), split_name("Area_1/office_1")) == (
        ("val", "scene0011_00"),
        ("", "Area_1_office_1"),
    )


def test_split_by_example():
    assert _split(np.array([0, 0, 0, 1, 1]), [np.array([0, 1]), np.array([1, 3])]).tolist() == [
        2,
        4,
        0,
        3,
        1,
    ]
