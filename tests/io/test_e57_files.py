"""E57: scans with poses, extensions, invalid points."""

from dataclasses import replace

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, stream_cloud, write_cloud
from torchrg.io.e57 import ScanPose, to_cartesian
from torchrg.structures import Cloud

pye57 = pytest.importorskip("pye57")

AXES = ("cartesianX", "cartesianY", "cartesianZ")
QUARTER = np.array([0.5**0.5, 0.0, 0.0, 0.5**0.5])


@pytest.fixture
def scans(tmp_path):
    """A file that pye57 itself wrote: two scans with poses, the first with colour."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2, 20, 3)).astype(np.float32).astype(np.float64)
    path = tmp_path / "scans.e57"
    with pye57.E57(str(path), "w") as file:
        for number in range(2):
            columns = dict(
                zip(["cartesianX", "cartesianY", "cartesianZ"], points[number].T, strict=True)
            )
            columns["intensity"] = np.linspace(0, 1, 20, dtype=np.float32)
            if number == 0:
                columns |= dict.fromkeys(["colorRed", "colorGreen"], np.arange(20, dtype=np.uint8))
                columns["colorBlue"] = np.zeros(20, np.uint8)
            file.write_scan_raw(
                columns,
                name=f"scan {number}",
                rotation=QUARTER,
                translation=np.array([500_000.0, 4_500_000.0, float(number)]),
            )
    turned = np.stack([-points[..., 1], points[..., 0], points[..., 2]], axis=-1)
    world = turned + [500_000.0, 4_500_000.0, 0] + np.array([[[0.0]], [[1.0]]]) * [0, 0, 1]
    return path, world.reshape(40, 3)


def test_scans_are_moved_by_their_poses(scans):
    path, world = scans
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.coordinates, world, rtol=0, atol=2e-9)
    assert cloud.fields["scan"].tolist() == [0] * 20 + [1] * 20
    assert cloud.fields["color"][:, 0].tolist() == [*range(20), *[0] * 20]
    assert [scan.name for scan in cloud.header["scans"]] == ["scan 0", "scan 1"]


def test_scans_are_written_with_their_poses(tmp_path, scans, make_segmentation):
    path, world = scans
    seg = make_segmentation(40)
    write_cloud(tmp_path / "out.e57", read_cloud(path), seg)
    with pye57.E57(str(tmp_path / "out.e57")) as file:
        assert file.scan_count == 2
        headers = [file.get_header(number) for number in range(2)]
        np.testing.assert_allclose(headers[1].translation, [500_000.0, 4_500_000.0, 1.0])
        np.testing.assert_allclose(headers[1].rotation, QUARTER)
        assert "nor:normalX" in headers[0].point_fields
        assert "torchrg:label" in headers[0].point_fields
        raw = file.read_scan_raw(0, ignore_unsupported_fields=True)
        scan = file.read_scan(1, intensity=True, ignore_missing_fields=True)
    np.testing.assert_allclose(scan["cartesianX"], world[20:, 0], rtol=0, atol=2e-9)
    assert raw["colorRed"].tolist() == list(range(20))
    again = read_cloud(tmp_path / "out.e57")
    np.testing.assert_allclose(again.coordinates, world, rtol=0, atol=2e-9)
    np.testing.assert_array_equal(again.fields["labels"], seg.labels)
    np.testing.assert_allclose(again.fields["normals"], seg.normals, atol=1e-6)
    assert again.fields["scan"].tolist() == [0] * 20 + [1] * 20


def test_scans_without_colour_are_written_without(tmp_path, scans, make_segmentation):
    path, _ = scans
    cloud = read_cloud(path)
    assert cloud.notes == ("1 of 2 scans lack red, green, blue, zero there",)
    assert cloud.fields["color"][20:].tolist() == [[0, 0, 0]] * 20
    write_cloud(tmp_path / "whole.e57", cloud, make_segmentation(40))
    stream = stream_cloud(path, chunk_size=7)
    write_cloud(tmp_path / "chunks.e57", stream, make_segmentation(40))
    for name in ("whole.e57", "chunks.e57"):
        with pye57.E57(str(tmp_path / name)) as file:
            headers = [file.get_header(number) for number in range(2)]
            assert "colorRed" in headers[0].point_fields
            assert "colorRed" not in headers[1].point_fields
            assert "colorLimits" not in headers[1].scan_fields
            assert "torchrg:label" in headers[1].point_fields
        again = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(again.fields["color"], cloud.fields["color"])
    # What somebody gave colours has them.
    painted = {**cloud.fields, "color": cloud.fields["color"] + np.uint8(1)}
    write_cloud(tmp_path / "b.e57", replace(cloud, fields=painted))
    found = read_cloud(tmp_path / "b.e57")
    assert found.notes == ()
    np.testing.assert_array_equal(found.fields["color"], painted["color"])


def test_the_coordinate_system_is_kept_and_pictures_are_told(tmp_path):
    system = 'PROJCS["hand made"]'
    cloud = Cloud(np.eye(3), header={"coordinate_metadata": system})
    write_cloud(tmp_path / "a.e57", cloud)
    assert read_cloud(tmp_path / "a.e57").header["coordinate_metadata"] == system
    write_cloud(tmp_path / "b.e57", stream_cloud(tmp_path / "a.e57"))
    with pye57.E57(str(tmp_path / "b.e57")) as file:
        assert file.root["coordinateMetadata"].value() == system
    with pye57.E57(str(tmp_path / "c.e57"), "w") as file:
        file.write_scan_raw(dict.fromkeys(AXES, np.ones(5)))
        image, pictures = file.image_file, file.root["images2D"]
        picture = pye57.libe57.StructureNode(image)
        picture.set("guid", pye57.libe57.StringNode(image, "{1}"))
        pictures.append(picture)
    found = read_cloud(tmp_path / "c.e57")
    assert found.notes == ("pictures left out: 1",)
    assert "coordinate_metadata" not in found.header


def test_normals_turn_with_the_points(tmp_path):
    normals = np.array([[1.0, 0, 0], [0, 1, 0]])
    cloud = Cloud(
        np.eye(3)[:2], {"normals": normals}, header={"scans": (ScanPose("a", tuple(QUARTER)),)}
    )
    write_cloud(tmp_path / "a.e57", cloud)
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        raw = file.read_scan_raw(0, ignore_unsupported_fields=True)
    np.testing.assert_allclose(raw["cartesianX"], [0, 1], atol=1e-15)
    np.testing.assert_allclose(
        read_cloud(tmp_path / "a.e57").fields["normals"], normals, atol=1e-15
    )


def test_poses_go_back_and_forth_to_the_last_digits():
    points = np.random.default_rng(0).normal(size=(50, 3))
    scan = ScanPose("a", (0.1, -0.2, 0.3, 0.4), (5.0, -6.0, 7.0))
    there = scan.to_world(points)
    np.testing.assert_allclose(scan.to_scan(there), points, rtol=0, atol=1e-14)
    # w x y z of any length: the rotation of a quaternion is q p q*.
    w, v = 0.1, np.array([-0.2, 0.3, 0.4])
    turned = points * (w * w - v @ v) + 2 * np.outer(points @ v, v) + 2 * w * np.cross(v, points)
    np.testing.assert_allclose(there, turned / (w * w + v @ v) + [5, -6, 7], rtol=0, atol=1e-14)


def test_a_quaternion_of_zeros_turns_nothing():
    scan = ScanPose("a", (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    assert scan.to_world(np.eye(3)).tolist() == [[1, 0, 2], [0, 1, 2], [0, 0, 3]]


def test_shuffled_scans_are_written_as_one(tmp_path, scans):
    cloud = read_cloud(scans[0])
    order = np.random.default_rng(0).permutation(40)
    shuffled = Cloud(
        cloud.coordinates[order], {"scan": cloud.fields["scan"][order]}, header=cloud.header
    )
    write_cloud(tmp_path / "a.e57", shuffled)
    again = read_cloud(tmp_path / "a.e57")
    np.testing.assert_array_equal(again.coordinates, shuffled.coordinates)
    np.testing.assert_array_equal(again.fields["scan"], shuffled.fields["scan"])
    assert len(again.header["scans"]) == 1


def test_scans_without_points_left_are_left_out(tmp_path, scans):
    cloud = read_cloud(scans[0])
    second = Cloud(cloud.coordinates[20:], {"scan": cloud.fields["scan"][20:]}, header=cloud.header)
    write_cloud(tmp_path / "a.e57", second)
    again = read_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(again.coordinates, second.coordinates, rtol=0, atol=2e-9)
    assert [scan.name for scan in again.header["scans"]] == ["scan 1"]


def test_points_that_are_not_finite_are_marked_as_invalid(tmp_path, make_cloud):
    cloud = make_cloud()
    cloud.coordinates[3] = [1.0, np.inf, np.nan]
    write_cloud(tmp_path / "a.e57", cloud)
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        state = file.read_scan_raw(0, ignore_unsupported_fields=True)["cartesianInvalidState"]
    assert np.flatnonzero(state).tolist() == [3]
    found = read_cloud(tmp_path / "a.e57")
    assert np.flatnonzero(~found.finite).tolist() == [3]
    np.testing.assert_array_equal(found.coordinates[4:], cloud.coordinates[4:])


def test_spherical_coordinates_are_the_standards():
    spherical = np.array([[2.0, 0, 0], [2.0, np.pi / 2, 0], [2.0, 1.0, np.pi / 2]])
    expected = [[2, 0, 0], [0, 2, 0], [0, 0, 2]]
    np.testing.assert_allclose(to_cartesian(spherical), expected, atol=1e-15)


def test_names_are_made_fit_for_xml(tmp_path, make_cloud):
    cloud = Cloud(np.eye(3), {"a b/c": np.arange(3.0)})
    write_cloud(tmp_path / "a.e57", cloud)
    assert read_cloud(tmp_path / "a.e57").fields["a_b_c"].tolist() == [0, 1, 2]
    write_cloud(tmp_path / "a.e57", Cloud(np.eye(3), {"1st": np.arange(3.0)}))
    assert read_cloud(tmp_path / "a.e57").fields["_1st"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("names", [("a b", "a/b"), ("高さ", "長さ")])
def test_names_that_become_one_are_refused(tmp_path, names):
    message = "expected fields of different names in letters and digits, got '[a_]_[b_]?' twice"
    with pytest.raises(FormatError, match=message):
        write_cloud(tmp_path / "a.e57", Cloud(np.eye(3), dict.fromkeys(names, np.ones(3))))


def test_fields_of_two_extensions_are_both_read(tmp_path):
    values = {"a:rank": np.arange(5.0), "b:rank": np.ones(5)}
    with pye57.E57(str(tmp_path / "a.e57"), "w") as file:
        libe57, image = pye57.libe57, file.image_file
        for prefix in "ab":
            image.extensionsAdd(prefix, f"urn:{prefix}")
        columns = {**dict.fromkeys(AXES, np.zeros(5)), **values}
        prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        for name, column in columns.items():
            prototype.set(name, libe57.FloatNode(image))
            buffers.append(libe57.SourceDestBuffer(image, name, column, 5, True, True))
        scan = libe57.StructureNode(image)
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("guid", libe57.StringNode(image, "{1}"))
        scan.set("points", points)
        file.data3d.append(scan)
        writer = points.writer(buffers)
        writer.write(5)
        writer.close()
    found = read_cloud(tmp_path / "a.e57").fields
    assert {name: column.tolist() for name, column in found.items()} == {
        name: column.tolist() for name, column in values.items()
    }


def test_integers_beyond_the_format_are_refused(tmp_path):
    cloud = Cloud(np.eye(3), {"id": np.full(3, 2**63, np.uint64)})
    with pytest.raises(FormatError, match=r"a\.e57: expected field id below 2\^63; leave it out"):
        write_cloud(tmp_path / "a.e57", cloud)


def test_truncated_files_are_refused_wherever_they_end(scans):
    path, _ = scans
    whole = path.read_bytes()
    for end in [3, 40, 1024, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:end])
        with pytest.raises(
            FormatError, match=r"scans\.e57: expected an E57 file, got: .*; fetch it"
        ):
            read_cloud(path)


def test_promised_points_are_compared_with_the_file(scans, monkeypatch):
    path, _ = scans
    monkeypatch.setattr(pye57.ScanHeader, "point_count", 10**12)
    message = r"scans\.e57: byte 0: expected at least 250,000,000,000 bytes for 2,000,000,000,000 p"
    with pytest.raises(FormatError, match=message):
        read_cloud(path)


def test_file_without_scans_is_refused(tmp_path):
    with pye57.E57(str(tmp_path / "a.e57"), "w"):
        pass
    with pytest.raises(FormatError, match=r"a\.e57: expected at least one scan, got none"):
        read_cloud(tmp_path / "a.e57")


def write_stations(path, points, places):
    """A scan from each place, of all points, in its own frame turned by a quarter."""
    with pye57.E57(str(path), "w") as file:
        for place in places:
            x, y, z = (points - place).T
            file.write_scan_raw(
                dict(zip(AXES, (y, -x, z), strict=True)), rotation=QUARTER, translation=place
            )
    return path


def test_the_front_of_a_point_is_its_scanner(tmp_path):
    points = np.array([5e5, 4.5e6, 1e2]) + np.random.default_rng(0).uniform(-3, 3, (50, 3))
    places = points.mean(axis=0) + np.array([[1.0, 0, 0], [-1, 0.5, 0]])
    cloud = read_cloud(write_stations(tmp_path / "a.e57", points, places))
    expected = np.concatenate([place - points for place in places])
    np.testing.assert_allclose(cloud.front, expected, atol=1e-5)
    assert cloud.front.dtype == np.float32
    assert cloud.notes == ()


def test_poses_that_are_no_places_of_scanners_are_not_taken_for_such(tmp_path):
    points = np.array([5e5, 4.5e6, 1e2]) + np.random.default_rng(0).uniform(-3, 3, (50, 3))
    inside, shift = points.mean(axis=0), np.array([500_000.0, 4_500_000.0, 0.0])
    cloud = read_cloud(write_stations(tmp_path / "a.e57", points, [inside, shift]))
    assert cloud.front[:50].any(axis=1).all()
    assert not cloud.front[50:].any()
    assert cloud.notes == (
        "the poses of 1 of 2 scans lie outside of the points, and are not taken for places of the "
        "scanner",
    )
    assert read_cloud(write_stations(tmp_path / "b.e57", points, [shift])).front is None
    # What is written where no pose is known, around the origin.
    write_cloud(tmp_path / "c.e57", Cloud(points - inside))
    assert read_cloud(tmp_path / "c.e57").front is None
