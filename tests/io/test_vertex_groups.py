"""Vertex groups are what PolyFit, abspy and Easy3D read, and theirs are read."""

import re
import struct

import numpy as np
import pytest

from torchrg import read_cloud, segment_planes, write_cloud
from torchrg.cli import main
from torchrg.errors import FormatError
from torchrg.io import estimate_points, stream_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

# The structure of a published sample: all coordinates on one line, parameters that say nothing,
# a group that holds the others, as Mapple writes one, and the keyword without its s.
SAMPLE = """num_points: 6
0 0 0 1 0 0 0 1 0 1 1 0 5 5 5 6 6 6
num_colors: 0

num_normals: 6
0 0 1 0 0 1 0 0 1 0 0 1 0 0 0 0 0 0
num_groups: 2
group_type: 0
num_group_parameters: 4
group_parameters: 0 0 0 0
group_label: a wall
group_color: 0.7424909472465515 0.5116855502128601 0.4629566669464111
group_num_point: 2
4 0
num_children: 1
group_type: 5
num_group_parameters: 0
group_parameters:
group_label:
group_color: 1 0 0
group_num_points: 1
0
num_children: 0
group_type: 0
num_group_parameters: 4
group_parameters: 0 0 1 0
group_label: unknown
group_color: 1 1 0
group_num_point: 2
1 2
num_children: 0
"""


def sample_bytes():
    """The same as bytes."""
    found = struct.pack("<i", 6) + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 5, 5],
                                             [6, 6, 6]], "<f4").tobytes()  # fmt: skip
    found += struct.pack("<i", 0) + struct.pack("<i", 6)
    found += np.array([[0, 0, 1]] * 4 + [[0, 0, 0]] * 2, "<f4").tobytes() + struct.pack("<i", 2)
    for kind, parameters, label, rows, children in (
        (0, [0, 0, 0, 0], b"a wall", [4, 0], 1),
        (5, [], b"", [0], 0),
        (0, [0, 0, 1, 0], b"unknown", [1, 2], 0),
    ):
        found += struct.pack("<ii", kind, len(parameters)) + np.array(parameters, "<f4").tobytes()
        found += struct.pack("<i", len(label)) + label + struct.pack("<3f", 1, 0.5, 0)
        found += struct.pack("<i", len(rows)) + np.array(rows, "<i4").tobytes()
        found += struct.pack("<i", children)
    return found


@pytest.mark.parametrize("suffix", [".vg", ".bvg"])
def test_files_of_others_are_read(tmp_path, suffix):
    path = tmp_path / f"sample{suffix}"
    path.write_bytes(SAMPLE.encode() if suffix == ".vg" else sample_bytes())
    cloud = read_cloud(path)
    assert cloud.coordinates.tolist()[3:5] == [[1, 1, 0], [5, 5, 5]]
    # A point has the innermost group; groups are counted as they come.
    assert cloud.fields["labels"].tolist() == [1, 2, 2, -1, 0, -1]
    assert cloud.fields["normals"].tolist()[0] == [0, 0, 1]
    assert set(cloud.fields) == {"labels", "normals"}
    assert estimate_points(path) == 6
    chunks = [chunk.coordinates for chunk in stream_cloud(path, chunk_size=4)]
    assert [len(chunk) for chunk in chunks] == [4, 2]


def literal_groups(lines):
    """What abspy reads: points up to the colours, and the line after each number of points."""
    end = next(i for i, line in enumerate(lines) if "num_colors" in line)
    points = np.array(" ".join(lines[1:end]).split(), float).reshape(-1, 3)
    rows = [lines[i + 1] for i, line in enumerate(lines) if line.startswith("group_num_point")]
    planes = [line[18:-1] for line in lines if line.startswith("group_parameters")]
    return (
        points,
        [np.array(r.split(), int) for r in rows],
        [np.array(p.split(), float) for p in planes],
    )


def literal_groups_of_bytes(content):
    """What abspy makes of bytes: the same lines as of text, if there are no colours."""
    place = 0

    def take(code, count):
        nonlocal place
        found = np.frombuffer(content, code, count, place)
        place += found.nbytes
        return found

    points = take("<f4", 3 * take("<i4", 1)[0]).reshape(-1, 3)
    assert take("<i4", 1)[0] == 0
    take("<f4", 3 * take("<i4", 1)[0])
    groups, planes = [], []
    for _ in range(take("<i4", 1)[0]):
        assert take("<i4", 2).tolist() == [0, 4]
        planes.append(take("<f4", 4))
        take("S1", take("<i4", 1)[0])
        take("<f4", 3)
        groups.append(take("<i4", take("<i4", 1)[0]))
        assert take("<i4", 1)[0] == 0
    assert place == len(content)
    return points, groups, planes


@pytest.mark.parametrize("suffix", [".vg", ".bvg"])
def test_planes_of_a_room_are_groups(tmp_path, suffix):
    room = make_room(num_points=3000, noise=0.003, seed=1)
    shift = np.array([1e5, 2e6, 30]) if suffix == ".vg" else np.array([2.0, -3, 1])
    color = np.random.default_rng(0).integers(0, 256, (3000, 3)).astype(np.uint8)
    cloud = Cloud(room.points.double().numpy() + shift, {"color": color, "ring": color[:, 0]})
    seg = segment_planes(cloud.points)
    path = tmp_path / f"room{suffix}"
    write_cloud(path, cloud, seg)
    if suffix == ".vg":
        with path.open() as stream:
            points, groups, planes = literal_groups(stream.readlines())
        assert np.array_equal(points, cloud.coordinates)
    else:
        points, groups, planes = literal_groups_of_bytes(path.read_bytes())
        assert np.array_equal(points, cloud.coordinates.astype(np.float32))
    assert len(groups) == len(seg.planes.count) > 5
    for label, (rows, plane) in enumerate(zip(groups, planes, strict=True)):
        assert np.array_equal(rows, np.flatnonzero(seg.labels == label))
        if not seg.planes.curved[label]:
            assert np.median(np.abs(points[rows] @ plane[:3] + plane[3])) < 0.02
    back = read_cloud(path)
    assert np.array_equal(back.fields["labels"], seg.labels)
    assert np.allclose(back.fields["normals"], seg.normals, atol=1e-6)
    assert "ring" not in back.fields
    if suffix == ".vg":
        assert np.array_equal(back.fields["color"], color)
        assert back.coordinates.dtype == np.float64


def test_labels_alone_become_groups_of_fitted_planes(tmp_path):
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    points = np.stack([x, y, 0.5 * x + 2], -1).reshape(-1, 3)
    cloud = Cloud(np.concatenate([points, [[9, 9, 9]]]), {"labels": np.array([7] * 25 + [9])})
    write_cloud(tmp_path / "a.vg", cloud)
    _, groups, planes = literal_groups((tmp_path / "a.vg").read_text().splitlines(keepends=True))
    assert [len(rows) for rows in groups] == [25, 1]
    normal = np.array([0.5, 0, -1]) / np.sqrt(1.25)
    assert abs(abs(planes[0][:3] @ normal) - 1) < 1e-12
    assert np.abs(points @ planes[0][:3] + planes[0][3]).max() < 1e-12
    assert planes[1].tolist() == [0, 0, 0, 0]


def test_the_command_writes_them(tmp_path):
    room, out = str(tmp_path / "room.npz"), str(tmp_path / "planes.vg")
    assert main(["sample", room, "--num-points", "3000"]) == 0
    assert main(["segment", room, "--out", out, "--preset", "classic"]) == 0
    assert len(np.unique(read_cloud(out).fields["labels"])) > 5


@pytest.mark.parametrize("suffix", [".vg", ".bvg"])
def test_damage_is_told(tmp_path, suffix):
    path = tmp_path / f"bad{suffix}"
    whole = SAMPLE.encode() if suffix == ".vg" else sample_bytes()
    for end in range(1, len(whole) - 14, 7):
        path.write_bytes(whole[:end])
        with pytest.raises(FormatError, match=re.escape(str(path))):
            read_cloud(path)
    huge = b"num_points: 2000000000\n" if suffix == ".vg" else struct.pack("<i", 2**31 - 1)
    path.write_bytes(huge + b"1 2 3")
    with pytest.raises(FormatError, match="the file is cut off"):
        read_cloud(path)


def test_bytes_hold_no_far_coordinates(tmp_path):
    cloud = Cloud(np.eye(3) + np.array([5e5, 4e6, 0]))
    with pytest.raises(FormatError, match=r"near the origin.*write \.vg"):
        write_cloud(tmp_path / "far.bvg", cloud)
    assert not (tmp_path / "far.bvg").exists()
