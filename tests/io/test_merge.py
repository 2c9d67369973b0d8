"""Several files as one cloud."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import CloudStream, merge_streams, read_cloud, stream_cloud, write_cloud
from torchrg.structures import Cloud


def merged(*clouds, chunk_size=7):
    return merge_streams([CloudStream.of(cloud, chunk_size=chunk_size) for cloud in clouds])


def test_points_follow_each_other_with_the_fields_of_all(tmp_path, make_cloud):
    first, second = make_cloud(20), make_cloud(30, dtype="f8", origin=(100.0, 0, 0))
    write_cloud(tmp_path / "a.ply", first)
    write_cloud(tmp_path / "b.pcd", second)
    paths = [tmp_path / "a.ply", tmp_path / "b.pcd"]
    stream, notes = merge_streams([stream_cloud(path, chunk_size=7) for path in paths])
    assert notes == []
    assert stream.num_points == stream.count == stream.extent.num_points == 50
    whole = stream.read()
    both = np.concatenate([first.coordinates, second.coordinates])
    assert whole.coordinates.dtype == np.float64
    np.testing.assert_array_equal(whole.coordinates, both)
    for name in first.fields:
        both = np.concatenate([first.fields[name], second.fields[name]])
        np.testing.assert_array_equal(whole.fields[name], both)
    assert stream.origin.tolist() == whole.origin.tolist()
    write_cloud(tmp_path / "all.npz", stream)
    write_cloud(tmp_path / "whole.npz", whole)
    assert (tmp_path / "all.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_first_chunks_of_many_files_are_not_in_memory_together():
    def chunks():
        yield Cloud(np.ones((40_000, 3)), {"a": np.ones(40_000)})

    tracemalloc.start()
    merge_streams([CloudStream(chunks, 40_000) for _ in range(20)])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 40_000 * 32


def test_fields_that_differ_are_left_out_and_named():
    points = np.random.default_rng(0).random((4, 3))
    stream, notes = merged(
        Cloud(points, {"a": np.ones(4), "b": np.ones((4, 2)), "c": np.ones(4, "i2")}),
        Cloud(points, {"b": np.ones(4), "c": np.full(4, "x"), "d": np.ones(4), "e": np.ones(4)}),
    )
    assert list(stream.read().fields) == []
    assert [note.partition(":")[0] for note in notes] == [
        f"field {name} is left out" for name in "abcde"
    ]


def test_types_are_those_that_hold_all_values():
    points = np.random.default_rng(0).random((2, 3))
    eight = np.array([[1, 2, 3], [0, 0, 255]], np.uint8)
    sixteen = np.array([[1, 2, 3], [0, 0, 65535]], np.uint16)
    for order in (1, -1):
        clouds = [
            Cloud(points, {"color": eight, "n": np.array([1, 2], np.uint8)}),
            Cloud(points, {"color": sixteen, "n": np.array([-1, 0.5], np.float32)}),
        ][::order]
        found = merged(*clouds)[0].read().fields
        assert found["color"].dtype == np.uint16
        assert found["n"].dtype == np.float32
        both = [np.array(eight, np.uint16) * 257, sixteen][::order]
        np.testing.assert_array_equal(found["color"], np.concatenate(both))


def test_sizes_of_other_units_are_noted():
    points = np.random.default_rng(0).random((9, 3))
    large = Cloud(points * 1000, source="b.ply")
    _, (note,) = merged(Cloud(points, source="a.ply"), large)
    assert note == "b.ply is 1,000 times as large as a.ply; expected coordinates of one unit"
    assert merged(Cloud(points), Cloud(points * 50), Cloud(np.zeros((1, 3)))).notes == []


def test_a_file_that_is_named_twice_is_noted():
    cloud = Cloud(np.random.default_rng(0).random((9, 3)), source="a.ply")
    assert merged(cloud, cloud, replace(cloud, source="b.ply")).notes == ["a.ply is taken 2 times"]


def test_one_cloud_is_itself_and_none_is_refused(make_cloud):
    stream = CloudStream.of(make_cloud())
    assert merge_streams([stream]).stream is stream
    with pytest.raises(FormatError, match="merge: expected at least one cloud, got none"):
        merge_streams([])


def las_tile(path, offset, scale=0.001, point_format=7, system=None):
    laspy = pytest.importorskip("laspy")
    data = laspy.create(point_format=point_format, file_version="1.4")
    data.header.scales, data.header.offsets = [scale] * 3, [offset, 0, 0]
    data.x, data.y, data.z = offset + np.arange(9) / 8, np.arange(9) / 8, np.zeros(9)
    data.user_data[:] = 3
    if system is not None:
        data.header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", system))
    data.write(path)
    return stream_cloud(path, chunk_size=4)


def test_las_tiles_keep_a_header_whose_grid_holds_them(tmp_path):
    laspy = pytest.importorskip("laspy")
    tiles = [las_tile(tmp_path / f"{i}.las", 1000.0 * i, 0.01 / (i + 1)) for i in range(2)]
    stream, notes = merge_streams(tiles)
    assert notes == []
    write_cloud(tmp_path / "all.las", stream)
    after = laspy.read(tmp_path / "all.las")
    assert after.header.scales.tolist() == [0.005] * 3
    assert len(after) == 18
    np.testing.assert_allclose(after.x, stream.read().coordinates[:, 0], rtol=0, atol=0.0025)
    far = las_tile(tmp_path / "far.las", 2.5e7)
    stream, notes = merge_streams([tiles[0], far])
    assert "las" not in stream.header
    why = "its grid does not reach all points"
    assert notes == [f"the header of {tmp_path}/0.las is not kept: {why}"]
    other = las_tile(tmp_path / "other.las", 0.0, point_format=6)
    assert "point formats differ" in merge_streams([tiles[0], other]).notes[-1]


def test_dimensions_that_are_zero_in_one_las_file_are_kept(tmp_path):
    laspy = pytest.importorskip("laspy")
    first = las_tile(tmp_path / "a.las", 0.0)
    data = laspy.read(tmp_path / "a.las")
    data.user_data[:], data.green[3] = 0, 257
    data.write(tmp_path / "b.las")
    stream, notes = merge_streams([first, stream_cloud(tmp_path / "b.las", chunk_size=4)])
    found = stream.read().fields
    assert notes == []
    assert found["user_data"].tolist() == [3] * 9 + [0] * 9
    assert found["color"].sum(axis=0).tolist() == [0, 1, 0]


def test_coordinate_systems_that_differ_are_refused(tmp_path):
    first = las_tile(tmp_path / "a.las", 0.0, system=b"one")
    same = las_tile(tmp_path / "b.las", 0.0, system=b"one")
    other = las_tile(tmp_path / "c.las", 0.0, system=b"two")
    none = las_tile(tmp_path / "d.las", 0.0)
    assert merge_streams([first, same]).notes == []
    assert merge_streams([none, same]).notes == ["only 1 of 2 files name a coordinate system"]
    with pytest.raises(FormatError, match=r"c\.las: expected the coordinate reference system of"):
        merge_streams([first, none, other])


def test_scans_of_several_e57_files_are_numbered_on(tmp_path, make_cloud):
    pytest.importorskip("pye57")
    from torchrg.io.e57 import Scan

    number = np.repeat(np.arange(2, dtype=np.int32), 10)
    two = {"scans": (Scan("a"), Scan("b"))}
    one = {"scans": (Scan("c"),)}
    write_cloud(tmp_path / "a.e57", Cloud(make_cloud(20).coordinates, {"scan": number}, header=two))
    write_cloud(tmp_path / "b.e57", Cloud(make_cloud(5).coordinates, header=one))
    paths = [tmp_path / "a.e57", tmp_path / "b.e57", tmp_path / "b.e57"]
    stream, notes = merge_streams([stream_cloud(path, chunk_size=7) for path in paths])
    assert notes == [f"{tmp_path / 'b.e57'} is taken 2 times"]
    write_cloud(tmp_path / "all.e57", stream)
    found = read_cloud(tmp_path / "all.e57")
    assert found.fields["scan"].tolist() == [0] * 10 + [1] * 10 + [2] * 5 + [3] * 5
    assert [scan.name for scan in found.header["scans"]] == ["a", "b", "c", "c"]
