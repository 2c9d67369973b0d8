"""Several files as one cloud."""

from dataclasses import replace

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.io.e57 import ScanPose
from torchrg.io.merge import merge_clouds
from torchrg.structures import Cloud


def random_points(count=9):
    return np.random.default_rng(0).random((count, 3))


def test_points_follow_each_other_with_the_fields_of_all(tmp_path, make_cloud):
    first, second = make_cloud(20), make_cloud(30, dtype="f8", origin=(100.0, 0, 0))
    write_cloud(tmp_path / "a.ply", first)
    write_cloud(tmp_path / "b.pcd", second)
    merged = merge_clouds([read_cloud(tmp_path / name) for name in ("a.ply", "b.pcd")])
    assert merged.notes == ()
    both = np.concatenate([first.coordinates, second.coordinates])
    assert merged.coordinates.dtype == np.float64
    np.testing.assert_array_equal(merged.coordinates, both)
    assert merged.fields.keys() == first.fields.keys()
    for name in first.fields:
        both = np.concatenate([first.fields[name], second.fields[name]])
        np.testing.assert_array_equal(merged.fields[name], both)


def test_clouds_about_different_origins_lose_no_digits():
    near, far = random_points(), random_points() + np.array([5e5, 5.4e6, 300.0])
    merged = merge_clouds([Cloud(near.astype(np.float32)), Cloud(far)])
    np.testing.assert_array_equal(merged.coordinates[:9], near.astype(np.float32))
    np.testing.assert_array_equal(merged.coordinates[9:], far)
    parts = merge_clouds([Cloud(far), Cloud(far + np.array([40.0, 0, 0]))])
    world = parts.points.double().numpy() + parts.origin
    np.testing.assert_allclose(world, parts.coordinates, rtol=0, atol=2e-6)


def test_fields_that_differ_are_left_out_and_named_in_one_line():
    points = random_points(4)
    merged = merge_clouds(
        [
            Cloud(points, {"a": np.ones(4), "b": np.ones((4, 2)), "c": np.ones(4, "i2")}),
            Cloud(points, {"b": np.ones(4), "c": np.full(4, "x"), "d": np.ones(4)}),
        ]
    )
    assert merged.fields == {}
    assert merged.notes == ("fields left out, because not all files share them: a, b, c, d",)


def test_kinds_of_numbers_are_joined_and_colours_only_of_as_many_bits():
    points = random_points(2)
    eight = np.array([[1, 2, 3], [0, 0, 255]], np.uint8)
    fields = {"color": eight, "n": np.array([1, 2], np.uint8), "m": np.ones(2, np.float32)}
    more = {"color": eight.astype(np.uint16), "n": np.ones(2), "m": np.array([0.1, 2])}
    merged = merge_clouds([Cloud(points, fields), Cloud(points, more)])
    assert merged.notes == ("fields left out, because not all files share them: color, n",)
    assert merged.fields["m"].tolist() == [1, 1, 0.1, 2]
    again = merge_clouds([Cloud(points, fields)] * 2)
    assert again.fields["color"].dtype == np.uint8
    assert again.fields["color"].tolist() == [*eight.tolist(), *eight.tolist()]


def test_sizes_of_other_units_are_noted():
    points = random_points()
    merged = merge_clouds([Cloud(points, source="a.ply"), Cloud(points * 1000, source="b.ply")])
    message = "b.ply is 1,000 times as large as a.ply; check that both use the same unit"
    assert merged.notes == (message,)
    nothing = Cloud(np.full((2, 3), np.nan))
    one = Cloud(np.zeros((1, 3)))
    assert merge_clouds([Cloud(points), Cloud(points * 50), one, nothing]).notes == ()


def test_a_file_that_is_named_twice_is_noted():
    cloud = Cloud(random_points(), source="a.ply")
    merged = merge_clouds([cloud, cloud, replace(cloud, source="b.ply")])
    assert merged.notes == ("a.ply is used 2 times",)


def test_one_cloud_is_itself_and_none_is_refused(make_cloud):
    cloud = make_cloud()
    assert merge_clouds([cloud]) is cloud
    with pytest.raises(FormatError, match="merge: expected at least one cloud, got none"):
        merge_clouds([])


def las_tile(path, offset, scale=0.001, point_format=7, system=None):
    laspy = pytest.importorskip("laspy")
    data = laspy.create(point_format=point_format, file_version="1.4")
    data.header.scales, data.header.offsets = [scale] * 3, [offset, 0, 0]
    data.x, data.y, data.z = offset + np.arange(9) / 8, np.arange(9) / 8, np.zeros(9)
    data.user_data[:] = 3
    if system is not None:
        data.header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", system))
    data.write(path)
    return read_cloud(path)


def test_las_tiles_keep_a_header_whose_grid_holds_them(tmp_path):
    laspy = pytest.importorskip("laspy")
    tiles = [las_tile(tmp_path / f"{i}.las", 1000.0 * i, 0.01 / (i + 1)) for i in range(2)]
    merged = merge_clouds(tiles)
    assert merged.notes == ()
    write_cloud(tmp_path / "all.las", merged)
    after = laspy.read(tmp_path / "all.las")
    assert after.header.scales.tolist() == [0.005] * 3
    assert len(after) == 18
    np.testing.assert_allclose(after.x, merged.coordinates[:, 0], rtol=0, atol=0.0025)
    # The header of the file that was read is its own.
    assert tiles[0].header["las"].scales.tolist() == [0.01] * 3
    lost = ("header entries left out, because not all files share them: las",)
    for other in (
        las_tile(tmp_path / "far.las", 2.5e7),
        las_tile(tmp_path / "other.las", 0.0, point_format=6),
    ):
        merged = merge_clouds([tiles[0], other])
        assert "las" not in merged.header
        assert merged.notes == lost


def test_coordinate_systems_that_differ_are_refused(tmp_path):
    first = las_tile(tmp_path / "a.las", 0.0, system=b"one")
    same = las_tile(tmp_path / "b.las", 0.0, system=b"one")
    other = las_tile(tmp_path / "c.las", 0.0, system=b"two")
    none = las_tile(tmp_path / "d.las", 0.0)
    assert merge_clouds([first, same]).notes == ()
    assert merge_clouds([none, same]).notes == (
        "only 1 of 2 files have a coordinate reference system",
    )
    with pytest.raises(FormatError, match=r"c\.las: expected the coordinate reference system of"):
        merge_clouds([first, none, other])
    clouds = [
        Cloud(random_points(), source=f"{name}.e57", header={"coordinate_metadata": name})
        for name in "ab"
    ]
    assert merge_clouds(clouds[:1] * 2).header == {"coordinate_metadata": "a"}
    with pytest.raises(FormatError, match=r"b\.e57: expected the coordinate .* of a\.e57, got an"):
        merge_clouds(clouds)


def timed(path, kind, *, used=True):
    """A LAS file with GPS times that count in one of two ways."""
    laspy = pytest.importorskip("laspy")
    data = laspy.create(point_format=6, file_version="1.4")
    encoding, wanted = data.header.global_encoding, getattr(laspy.header.GpsTimeType, kind)
    if encoding.gps_time_type != wanted:  # Before laspy 2.7, to set what it is would change it.
        encoding.gps_time_type = wanted
    data.x = data.y = data.z = np.arange(9) / 8
    if used:
        data.gps_time = np.arange(9.0) + 5
    data.write(path)
    return read_cloud(path)


def test_gps_times_that_count_differently_are_refused(tmp_path):
    laspy = pytest.importorskip("laspy")
    week, standard = (timed(tmp_path / f"{k}.las", k) for k in ("WEEK_TIME", "STANDARD"))
    unused = timed(tmp_path / "unused.las", "WEEK_TIME", used=False)
    message = r"STANDARD\.las: expected the kind of GPS times of .*/WEEK_TIME\.las, got another"
    for clouds in ([week, standard], [week, unused, standard]):
        with pytest.raises(FormatError, match=message):
            merge_clouds(clouds)
    assert merge_clouds([unused, standard]).notes == (
        "fields left out, because not all files share them: gps_time",
    )
    merged = merge_clouds([standard, replace(standard, source="b.las")])
    write_cloud(tmp_path / "all.las", merged)
    after = laspy.read(tmp_path / "all.las")
    assert after.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    assert after.gps_time.tolist() == [*range(5, 14)] * 2


@pytest.mark.parametrize("more", [{"scales": [0.5]}, {"description": "other"}])
def test_extra_dimensions_that_are_described_differently_are_plain_numbers(tmp_path, more):
    laspy = pytest.importorskip("laspy")
    usual = {"scales": [0.1], "offsets": [1.0]}
    for name, options in (("a", usual), ("b", usual | more)):
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.add_extra_dim(laspy.ExtraBytesParams("Range", "u2", **options))
        data = laspy.LasData(header)
        data.x = data.y = data.z = np.arange(9)
        data.Range = np.arange(9) + 1
        data.write(tmp_path / f"{name}.las")
    merged = merge_clouds([read_cloud(tmp_path / f"{name}.las") for name in "ab"])
    assert merged.notes == ("header entries left out, because not all files share them: las",)
    write_cloud(tmp_path / "all.las", merged)
    after = laspy.read(tmp_path / "all.las")
    assert not after.point_format.dimension_by_name("Range").is_scaled
    np.testing.assert_allclose(after.Range, np.tile(np.arange(9) + 1, 2), rtol=1e-15)


def test_entries_of_the_header_that_differ_are_told():
    away = (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0)
    plain, usual, seen = (
        Cloud(random_points(), header=header)
        for header in ({}, {"viewpoint": (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}, {"viewpoint": away})
    )
    assert merge_clouds([plain, usual]).notes == merge_clouds([usual, usual]).notes == ()
    assert merge_clouds([seen, seen]).header == {"viewpoint": away}
    lost = ("header entries left out, because not all files share them: viewpoint",)
    assert merge_clouds([plain, seen]).notes == merge_clouds([seen, usual]).notes == lost
    scanned = Cloud(random_points(), header={"scans": (ScanPose("a"),)})
    assert merge_clouds([plain, scanned]).notes == (lost[0].replace("viewpoint", "scans"),)


def test_what_reading_the_files_said_is_told(tmp_path):
    for name in "ab":
        np.savetxt(tmp_path / f"{name}.txt", np.arange(20.0).reshape(5, 4))
    merged = merge_clouds([read_cloud(tmp_path / f"{name}.txt") for name in "ab"])
    taken = "its columns have no names and are taken as x y z intensity"
    assert [note.partition(";")[0] for note in merged.notes] == [
        f"{tmp_path}/{name}.txt: {taken}" for name in "ab"
    ]


def test_scans_of_several_e57_files_are_all_there_and_their_numbers_left_out():
    number = np.repeat(np.arange(2, dtype=np.int32), 10)
    two, one = {"scans": (ScanPose("a"), ScanPose("b"))}, {"scans": (ScanPose("c"),)}
    first = Cloud(random_points(20), {"scan": number}, header=two)
    second = Cloud(random_points(5), header=one, front=np.ones((5, 3), np.float32))
    merged = merge_clouds([first, first, second])
    assert merged.notes == ("fields left out, because not all files share them: scan",)
    assert [scan.name for scan in merged.header["scans"]] == ["a", "b", "a", "b", "c"]
    assert merged.front.any(axis=1).tolist() == [False] * 40 + [True] * 5
