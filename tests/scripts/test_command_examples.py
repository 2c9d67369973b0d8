"""The examples of commands, which their help and the page of commands show, run as they stand."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from command_page import PROGS

from tests.datasets import s3dis_tree, scannet_tree
from torchrg import segment_planes
from torchrg.cli.arguments import example_lines
from torchrg.io import write_cloud
from torchrg.render import write_png
from torchrg.structures import Cloud

EXAMPLES = [line for kind in PROGS.values() for line in example_lines(kind)]
CLOUDS = ("scan.ply", "scan.pcd", "scan.laz", "room.npz", "scans/hall.ply", "truth/hall.npz")


def write_rooms(room):
    """Files of clouds, and results of one of them, by the names that examples have for them."""
    scene = room(num_points=4000)
    points = scene.points.float().numpy()
    truth = {"labels": scene.labels.numpy(), "normals": scene.normals.float().numpy()}
    for name in CLOUDS:
        Path(name).parent.mkdir(exist_ok=True)
        has_truth = name.startswith(("room", "truth", "scan.ply"))
        write_cloud(Path(name), Cloud(points, truth if has_truth else {}))
    write_cloud(Path("truth.ply"), Cloud(points, truth))
    np.savetxt("scan.txt", np.column_stack([points, points[:, :1]]))
    seg = segment_planes(points, "classic")
    Path("results").mkdir()
    for name in ("planes.npz", "other.npz", "results/hall.npz"):
        write_cloud(Path(name), Cloud(points), seg)
    return points


def write_stations(points):
    """Files of scanners that name their place."""
    pye57 = pytest.importorskip("pye57", reason="needs the extra e57")
    for name in ("scan", "part1", "part2"):
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T, strict=True))
        with pye57.E57(f"{name}.e57", mode="w") as file:
            file.write_scan_raw(columns, translation=np.array([1.0, 1.0, 1.5]))


def write_frames():
    """Depth images of a wall, alone, in a folder, and in a capture; and an organized cloud."""
    rows, columns = np.mgrid[0:480, 0:640]
    depth = 2000.0 + 0.5 * columns
    image = depth.astype(np.uint16)
    for path in ("frame.png", "frames/0.png", "capture/0.png"):
        Path(path).parent.mkdir(exist_ok=True)
        write_png(Path(path), image)
    camera = {"fl_x": 525, "fl_y": 525, "cx": 320, "cy": 240, "w": 640, "h": 480}
    frame = {"depth_file_path": "0.png", "transform_matrix": np.eye(4).tolist()}
    content = camera | {"frames": [frame | {"file_path": "0.jpg"}]}
    Path("capture/transforms.json").write_text(json.dumps(content))
    axes = (columns - 319.5) / 525, (rows - 239.5) / 525, np.ones(depth.shape)
    pixels = np.stack([axis * depth / 1000 for axis in axes], axis=-1).astype(np.float32)
    write_cloud(Path("kinect.pcd"), Cloud(pixels.reshape(-1, 3), grid_shape=depth.shape))


def write_trees(points):
    """S3DIS and ScanNet as they are released, a scan of each."""
    rows = np.column_stack([points, np.full_like(points, 128)])
    office = Path("Stanford3dDataset_v1.2/Area_5/office_1")
    s3dis_tree.write_objects(office, {"wall_1.txt": s3dis_tree.text_of(rows)})
    (office / "office_1.txt").write_bytes(s3dis_tree.text_of(rows))
    segments, color = np.arange(len(points)) % 9, np.full((len(points), 3), 128, np.uint8)
    objects = [("wall", range(5)), ("table", range(5, 9))]
    name = "scene0011_00"
    scannet_tree.write_scan(Path("scannet/scans"), name, points, color, segments, objects)
    scannet_tree.write_tables(Path("scannet"), [name], [])


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("line", EXAMPLES)
def test_example_runs(line, room, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = write_rooms(room)
    if ".e57" in line:
        write_stations(points)
    if line.startswith(("torchrg depth", "torchrg convert rgbd")):
        write_frames()
    elif line.startswith("torchrg convert"):
        write_trees(points)
    if "*.ply" in line:
        Path("truth.ply").unlink()
    words = [name for word in shlex.split(line) for name in sorted(glob_of(word))]
    done = run(*words[1:])
    assert done.code == 0, done.err
    if "--out" in words:
        assert Path(words[words.index("--out") + 1]).exists()


def glob_of(word):
    """Return the files that a shell puts in the place of a word, or the word."""
    return [*map(str, Path().glob(word))] if "*" in word else [word]
