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


def timed(path, kind, point_format=6, *, used=True, **header):
    """A LAS file with GPS times that count in one of two ways."""
    laspy = pytest.importorskip("laspy")
    data = laspy.create(point_format=point_format, file_version="1.4")
    encoding, wanted = data.header.global_encoding, getattr(laspy.header.GpsTimeType, kind)
    if encoding.gps_time_type != wanted:  # Before laspy 2.7, to set what it is would change it.
        encoding.gps_time_type = wanted
    for name, value in header.items():
        setattr(data.header, name, value)
    data.x = data.y = data.z = np.arange(9) / 8
    if used:
        data.gps_time = np.arange(9.0) + 5
    data.write(path)
    return stream_cloud(path, chunk_size=4)


def test_gps_times_that_count_differently_are_refused(tmp_path):
    laspy = pytest.importorskip("laspy")
    week, standard = (timed(tmp_path / f"{k}.las", k) for k in ("WEEK_TIME", "STANDARD"))
    unused = timed(tmp_path / "unused.las", "WEEK_TIME", used=False)
    other = timed(tmp_path / "other.las", "WEEK_TIME", 7)
    message = (
        r"STANDARD\.las: expected the kind of GPS times of .*/WEEK_TIME\.las, got another; con"
    )
    for streams in ([week, standard], [week, unused, standard], [other, standard]):
        with pytest.raises(FormatError, match=message.replace("WEEK_TIME", "(WEEK_TIME|other)")):
            merge_streams(streams)
    stream, notes = merge_streams([unused, standard])
    assert notes == []
    write_cloud(tmp_path / "all.las", stream)
    after = laspy.read(tmp_path / "all.las")
    assert after.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert after.gps_time.tolist() == [0] * 9 + list(range(5, 14))
    # The header of the file that was read is its own.
    assert not unused.header["las"].global_encoding.gps_time_type
    _, notes = merge_streams([week, other])
    assert notes[-2].endswith("is not kept: point formats differ")
    assert notes[-1] == "what GPS times count from is not kept with it"


def test_headers_of_las_files_that_differ_are_told(tmp_path):
    laspy = pytest.importorskip("laspy")
    record = laspy.VLR("ACME", 4711, "", b"mine")
    first = timed(tmp_path / "a.las", "STANDARD", file_source_id=7, system_identifier="one")
    other = timed(
        tmp_path / "b.las",
        "STANDARD",
        file_source_id=8,
        system_identifier="two",
        vlrs=laspy.vlrs.vlrlist.VLRList([record]),
    )
    assert merge_streams([first, other]).notes == [
        f"system identifier, file source id are those of {tmp_path}/a.las for all points",
        f"records are those of {tmp_path}/a.las; left out of others: ACME 4711",
    ]


@pytest.mark.parametrize("more", [{"scales": [0.5], "offsets": [0.0]}, {"description": "other"}])
def test_extra_dimensions_that_are_described_differently_are_plain_numbers(tmp_path, more):
    laspy = pytest.importorskip("laspy")
    for name, options in (("a", {"scales": [0.1], "offsets": [1.0]}), ("b", more)):
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.add_extra_dim(laspy.ExtraBytesParams("Range", "u2", **options))
        data = laspy.LasData(header)
        data.x = data.y = data.z = np.arange(9)
        data.Range = np.arange(9) + 1
        data.write(tmp_path / f"{name}.las")
    paths = [tmp_path / "a.las", tmp_path / "b.las"]
    stream, notes = merge_streams([stream_cloud(path) for path in paths])
    assert notes == ["scale and description of Range are left out: files differ"]
    write_cloud(tmp_path / "all.las", stream)
    after = laspy.read(tmp_path / "all.las")
    assert not after.point_format.dimension_by_name("Range").is_scaled
    np.testing.assert_allclose(after.Range, np.tile(np.arange(9) + 1, 2), rtol=1e-15)


def test_headers_that_are_not_kept_are_told(tmp_path, make_cloud):
    pytest.importorskip("pye57")
    first = las_tile(tmp_path / "a.las", 0.0)
    away = (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)
    write_cloud(tmp_path / "a.ply", make_cloud(9))
    write_cloud(tmp_path / "a.pcd", make_cloud(9))
    write_cloud(tmp_path / "b.pcd", make_cloud(9, header={"viewpoint": away}))
    write_cloud(tmp_path / "a.e57", make_cloud(9, header={"coordinate_metadata": "WKT"}))
    ply, pcd, seen, e57 = (
        stream_cloud(tmp_path / name) for name in ("a.ply", "a.pcd", "b.pcd", "a.e57")
    )

    def told(*streams):
        kept = [note for note in merge_streams(streams).notes if not note.startswith("field")]
        return [note.replace(f"{tmp_path}/", "") for note in kept]

    assert told(ply, pcd) == told(pcd, pcd)[1:] == []
    assert merge_streams([seen, seen]).stream.header["viewpoint"] == away
    differs = "the viewpoint of {} is not kept: it differs between files"
    assert told(ply, seen) == [differs.format("b.pcd")]
    assert told(seen, pcd) == [differs.format("b.pcd")]
    one = "is not kept: not all files have one"
    assert told(ply, first) == [f"the header of a.las {one}"]
    assert told(ply, e57) == [
        "only 1 of 2 files name a coordinate system",
        f"the list of scans, with poses, of a.e57 {one}",
        f"the coordinate system of a.e57 {one}",
    ]


def test_coordinate_systems_of_e57_files_are_compared(tmp_path, make_cloud):
    pytest.importorskip("pye57")
    for name, system in (("a", "one"), ("b", "one"), ("c", "two")):
        cloud = make_cloud(9, header={"coordinate_metadata": system})
        write_cloud(tmp_path / f"{name}.e57", cloud)
    first, same, other = (stream_cloud(tmp_path / f"{name}.e57") for name in "abc")
    stream, notes = merge_streams([first, same])
    assert notes == []
    write_cloud(tmp_path / "all.e57", stream)
    assert read_cloud(tmp_path / "all.e57").header["coordinate_metadata"] == "one"
    with pytest.raises(FormatError, match=r"c\.e57: expected the coordinate reference system of"):
        merge_streams([first, other])


def test_what_reading_the_files_said_is_told(tmp_path):
    for name in "ab":
        np.savetxt(tmp_path / f"{name}.txt", np.arange(20.0).reshape(5, 4))
    streams = [stream_cloud(tmp_path / f"{name}.txt") for name in "ab"]
    stream, notes = merge_streams(streams)
    taken = "its columns have no names and are taken as x y z intensity"
    assert [note.partition(";")[0] for note in notes] == [
        f"{tmp_path}/{name}.txt: {taken}" for name in "ab"
    ]
    assert stream.read().notes == ()


def test_scans_of_several_e57_files_are_numbered_on(tmp_path, make_cloud):
    pytest.importorskip("pye57")
    from torchrg.io.e57 import ScanPose

    number = np.repeat(np.arange(2, dtype=np.int32), 10)
    two = {"scans": (ScanPose("a"), ScanPose("b"))}
    one = {"scans": (ScanPose("c"),)}
    write_cloud(tmp_path / "a.e57", Cloud(make_cloud(20).coordinates, {"scan": number}, header=two))
    write_cloud(tmp_path / "b.e57", Cloud(make_cloud(5).coordinates, header=one))
    paths = [tmp_path / "a.e57", tmp_path / "b.e57", tmp_path / "b.e57"]
    stream, notes = merge_streams([stream_cloud(path, chunk_size=7) for path in paths])
    assert notes == [f"{tmp_path / 'b.e57'} is taken 2 times"]
    write_cloud(tmp_path / "all.e57", stream)
    found = read_cloud(tmp_path / "all.e57")
    assert found.fields["scan"].tolist() == [0] * 10 + [1] * 10 + [2] * 5 + [3] * 5
    assert [scan.name for scan in found.header["scans"]] == ["a", "b", "c", "c"]
