"""Vertex groups are what PolyFit, abspy and Easy3D read."""

import numpy as np

from torchrg import segment_planes, write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud


def literal_groups(lines):
    """What abspy reads: points up to the colors, and the line after each number of points."""
    end = next(i for i, line in enumerate(lines) if "num_colors" in line)
    points = np.array(" ".join(lines[1:end]).split(), float).reshape(-1, 3)
    rows = [lines[i + 1] for i, line in enumerate(lines) if line.startswith("group_num_point")]
    planes = [line[18:-1] for line in lines if line.startswith("group_parameters")]
    return (
        points,
        [np.array(r.split(), int) for r in rows],
        [np.array(p.split(), float) for p in planes],
    )


def test_planes_of_a_room_are_groups(tmp_path):
    room = make_room(num_points=3000, noise=0.003, seed=1)
    color = np.random.default_rng(0).integers(0, 256, (3000, 3)).astype(np.uint8)
    points = room.points.double().numpy() + np.array([1e5, 2e6, 30])
    cloud = Cloud(points, {"color": color, "ring": color[:, 0]})
    seg = segment_planes(cloud.points)
    write_cloud(tmp_path / "room.vg", cloud, seg)
    lines = (tmp_path / "room.vg").read_text().splitlines(keepends=True)
    points, groups, planes = literal_groups(lines)
    assert np.array_equal(points, cloud.coordinates)
    assert len(groups) == len(seg.planes) > 5
    for label, (rows, plane) in enumerate(zip(groups, planes, strict=True)):
        assert np.array_equal(rows, np.flatnonzero(seg.labels == label))
        if not seg.planes.curved[label]:
            assert np.median(np.abs(points[rows] @ plane[:3] + plane[3])) < 0.02
    starts = [lines.index(f"num_{name}: 3000\n") + 1 for name in ("colors", "normals")]
    colors, normals = (np.loadtxt(lines[start : start + 3000]) for start in starts)
    assert np.allclose(colors * 255, color, atol=1e-6)
    for same in (color / 255, color.astype(np.int64)):
        write_cloud(tmp_path / "same.vg", Cloud(cloud.coordinates, {"color": same}), seg)
        assert (tmp_path / "same.vg").read_bytes() == (tmp_path / "room.vg").read_bytes()
    assert np.allclose(normals, seg.normals, atol=1e-6)


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
