"""Other programs read what torchrg writes, and torchrg what they write."""

import numpy as np
import pytest

from torchrg.io import read_cloud, write_cloud

UTM = (500_000.0, 4_500_000.0, 100.0)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize(("number", "origin"), [("f4", (0, 0, 0)), ("f8", UTM)])
def test_open3d_reads_and_writes_all_fields(
    tmp_path, make_cloud, make_segmentation, suffix, number, origin
):
    open3d = pytest.importorskip("open3d")
    cloud, seg = make_cloud(dtype=number, origin=origin), make_segmentation(60)
    path = tmp_path / f"a{suffix}"
    write_cloud(path, cloud, seg)
    theirs = open3d.t.io.read_point_cloud(str(path))
    expected = {
        "positions": cloud.coordinates,
        "colors": cloud.fields["color"],
        "normals": seg.normals.numpy(),
        "label": seg.labels.numpy()[:, None],
        "curvature": seg.curvature.numpy()[:, None],
        "intensity": cloud.fields["intensity"][:, None],
        "ring": cloud.fields["ring"][:, None],
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(theirs.point[name].numpy(), values, err_msg=name)

    options = [{"write_ascii": False}, {"compressed": True}] if suffix == ".pcd" else [{}]
    for option in options:
        open3d.t.io.write_point_cloud(str(tmp_path / f"b{suffix}"), theirs, **option)
        ours = read_cloud(tmp_path / f"b{suffix}")
        np.testing.assert_array_equal(ours.coordinates, cloud.coordinates)
        np.testing.assert_array_equal(ours.fields["labels"], seg.labels)
        np.testing.assert_array_equal(ours.fields["color"], cloud.fields["color"])
        np.testing.assert_array_equal(ours.fields["normals"], seg.normals)


@pytest.mark.parametrize(
    ("name", "num_points", "num_finite", "grid_shape", "fields"),
    [
        ("region_growing_tutorial.pcd", 108_104, 108_104, None, {"color"}),
        ("room_scan1.pcd", 112_586, 112_586, None, set()),
        ("kinect_capture0001.pcd", 307_200, 249_647, (480, 640), set()),
        ("synpeb_test_100.pcd", 10_000, 10_000, (100, 100), {"intensity"}),
    ],
)
def test_real_scans_are_read_and_kept(
    tmp_path, scan, assert_same, name, num_points, num_finite, grid_shape, fields
):
    cloud = read_cloud(scan(name))
    assert len(cloud) == num_points
    assert cloud.finite.sum() == num_finite
    assert cloud.grid_shape == grid_shape
    assert cloud.fields.keys() == fields
    for suffix in (".pcd", ".ply", ".npz"):
        write_cloud(tmp_path / f"a{suffix}", cloud)
        assert_same(read_cloud(tmp_path / f"a{suffix}"), cloud)
    again = read_cloud(tmp_path / "a.pcd")
    assert again.grid_shape == grid_shape
    assert again.header["viewpoint"] == cloud.header["viewpoint"]


def test_real_scans_agree_with_pypcd4(scan):
    pypcd4 = pytest.importorskip("pypcd4")
    for name in ("region_growing_tutorial.pcd", "kinect_capture0001.pcd", "synpeb_test_100.pcd"):
        theirs = pypcd4.PointCloud.from_path(scan(name))
        points = np.stack([theirs.pc_data[axis] for axis in "xyz"], axis=1)
        ours = read_cloud(scan(name))
        np.testing.assert_array_equal(ours.coordinates, points)
        if "color" in ours.fields:
            packed = np.ascontiguousarray(theirs.pc_data["rgb"])
            np.testing.assert_array_equal(ours.fields["color"], theirs.decode_rgb(packed))
