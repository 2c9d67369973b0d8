"""E57: scans with poses, extensions, invalid points."""

import tracemalloc

import numpy as np
import pytest

from torchrg import scratch
from torchrg.errors import FormatError
from torchrg.io import estimate_points, read_cloud
from torchrg.io.e57 import ScanPose, to_cartesian
from torchrg.structures import Cloud

pye57 = pytest.importorskip("pye57")

AXES = ("cartesianX", "cartesianY", "cartesianZ")
RGB = ("colorRed", "colorGreen", "colorBlue")
QUARTER = np.array([0.5**0.5, 0.0, 0.0, 0.5**0.5])


@pytest.fixture
def scans(tmp_path):
    """A file that pye57 itself wrote: two scans with poses, the first with color."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2, 20, 3)).astype(np.float32).astype(np.float64)
    path = tmp_path / "scans.e57"
    with pye57.E57(str(path), "w") as file:
        for number in range(2):
            columns = dict(zip(AXES, points[number].T, strict=True))
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


def test_points_are_counted_in_all_scans(scans):
    assert estimate_points(scans[0]) == len(scans[1])


def test_fields_that_a_scan_lacks_are_zero_there(scans):
    cloud = read_cloud(scans[0])
    assert cloud.notes == ("1 of 2 scans lack red, green, blue, zero there",)
    assert cloud.fields["color"][20:].tolist() == [[0, 0, 0]] * 20
    assert cloud.fields["color"].dtype == np.uint8


def test_the_coordinate_system_is_kept_and_pictures_are_told(tmp_path, monkeypatch):
    system, node = 'PROJCS["hand made"]', pye57.libe57.StringNode
    with monkeypatch.context() as patched:
        # pye57 writes an empty one.
        patched.setattr(pye57.libe57, "StringNode", lambda image, text: node(image, text or system))
        with pye57.E57(str(tmp_path / "a.e57"), "w") as file:
            file.write_scan_raw(dict.fromkeys(AXES, np.ones(5)))
    assert read_cloud(tmp_path / "a.e57").header["coordinate_metadata"] == system
    with pye57.E57(str(tmp_path / "c.e57"), "w") as file:
        file.write_scan_raw(dict.fromkeys(AXES, np.ones(5)))
        image, pictures = file.image_file, file.root["images2D"]
        picture = pye57.libe57.StructureNode(image)
        picture.set("guid", pye57.libe57.StringNode(image, "{1}"))
        pictures.append(picture)
    found = read_cloud(tmp_path / "c.e57")
    assert found.notes == ("images left out: 1",)
    assert "coordinate_metadata" not in found.header


def children(image, values, order=None):
    """Return a node of numbers by name, in an order."""
    node = pye57.libe57.StructureNode(image)
    for name in order or values:
        node.set(name, pye57.libe57.FloatNode(image, float(values[name])))
    return node


def append_scan(file, columns, pose=None, *, order="wxyz", grid=None, bounds=(), limits=None):
    """Write a scan of any columns, whole numbers in 16 bits, the others in double precision.

    ``pose`` is a quaternion w x y z, and may go on with a translation. With ``grid``, a scale and
    an offset, columns that are not whole are integers in the file. ``limits`` are those of colors.
    """
    libe57, image = pye57.libe57, file.image_file
    prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        is_whole, count = column.dtype.kind == "i", len(column)
        node = libe57.IntegerNode(image, 0, 0, 2**16) if is_whole else libe57.FloatNode(image)
        if grid is not None and not is_whole:
            node = libe57.ScaledIntegerNode(image, 0, -(2**20), 2**20, *grid)
        prototype.set(name, node)
        buffers.append(libe57.SourceDestBuffer(image, name, column, count, True, True))
    scan = libe57.StructureNode(image)
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("guid", libe57.StringNode(image, "{1}"))
    if pose is not None:
        place, moved = libe57.StructureNode(image), [*pose[4:], 0, 0, 0]
        place.set("rotation", children(image, dict(zip("wxyz", pose, strict=False)), order))
        place.set("translation", children(image, dict(zip("xyz", moved, strict=False))))
        scan.set("pose", place)
    if len(bounds):
        ends = [f"{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz"]
        box = children(image, dict(zip(ends, np.ravel(bounds), strict=True)))
        scan.set("cartesianBounds", box)
    scan.set("points", points)
    if limits is not None:
        ends = [f"{channel}{end}" for end in ("Minimum", "Maximum") for channel in RGB]
        values = np.ravel([np.broadcast_to(end, 3) for end in limits])
        scan.set("colorLimits", children(image, dict(zip(ends, values, strict=True))))
    file.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(count)
    writer.close()


def write_columns(path, columns, extensions=(), **options):
    """Write a file of one scan; see ``append_scan``."""
    with pye57.E57(str(path), "w") as file:
        for prefix in extensions:
            file.image_file.extensionsAdd(prefix, f"urn:{prefix}")
        append_scan(file, columns, **options)
    return path


def test_normals_turn_with_the_points(tmp_path):
    names = ("nor:normalX", "nor:normalY", "nor:normalZ")
    columns = dict(zip((*AXES, *names), np.eye(3)[[0, 1, 2, 0, 1, 2], :2].copy(), strict=True))
    path = write_columns(tmp_path / "a.e57", columns, ["nor"], pose=QUARTER)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.coordinates, [[0, 1, 0], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(cloud.fields["normals"], [[0, 1, 0], [-1, 0, 0]], atol=1e-15)


def test_points_marked_as_invalid_are_not_finite(tmp_path):
    columns = dict(zip(AXES, np.random.default_rng(0).random((3, 5)), strict=True))
    columns["cartesianInvalidState"] = np.array([0, 0, 2, 1, 0], "q")
    columns["torchrg:label"] = np.arange(5, dtype="q")
    cloud = read_cloud(write_columns(tmp_path / "a.e57", columns, ["torchrg"]))
    assert np.flatnonzero(~cloud.finite).tolist() == [2, 3]
    assert cloud.fields["labels"].tolist() == [0, 1, 2, 3, 4]
    assert cloud.coordinates[0].tolist() == [columns[axis][0] for axis in AXES]


def test_poses_move_points_to_the_last_digits():
    points = np.random.default_rng(0).normal(size=(50, 3))
    scan = ScanPose("a", (0.1, -0.2, 0.3, 0.4), (5.0, -6.0, 7.0))
    there = scan.to_world(points)
    np.testing.assert_array_equal(scan.to_world(points[7:9]), there[7:9])
    # w x y z of any length: the rotation of a quaternion is q p q*.
    w, v = 0.1, np.array([-0.2, 0.3, 0.4])
    turned = points * (w * w - v @ v) + 2 * np.outer(points @ v, v) + 2 * w * np.cross(v, points)
    np.testing.assert_allclose(there, turned / (w * w + v @ v) + [5, -6, 7], rtol=0, atol=1e-14)


def test_a_quaternion_of_zeros_turns_nothing():
    scan = ScanPose("a", (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    assert scan.to_world(np.eye(3)).tolist() == [[1, 0, 2], [0, 1, 2], [0, 0, 3]]


def test_spherical_coordinates_are_the_standards():
    spherical = np.array([[2.0, 0, 0], [2.0, np.pi / 2, 0], [2.0, 1.0, np.pi / 2]])
    expected = [[2, 0, 0], [0, 2, 0], [0, 0, 2]]
    np.testing.assert_allclose(to_cartesian(spherical), expected, atol=1e-15)


def test_fields_of_two_extensions_are_both_read(tmp_path):
    values = {"a:rank": np.arange(5.0), "b:rank": np.ones(5)}
    columns = {**{axis: np.zeros(5) for axis in AXES}, **values}
    write_columns(tmp_path / "a.e57", columns, "ab")
    found = read_cloud(tmp_path / "a.e57").fields
    assert {name: column.tolist() for name, column in found.items()} == {
        name: column.tolist() for name, column in values.items()
    }


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
        "the poses of 1 of 2 scans lie outside the points and are not used as scanner positions",
    )
    assert read_cloud(write_stations(tmp_path / "b.e57", points, [shift])).front is None
    # What is written where no pose is known, around the origin.
    columns = dict(zip(AXES, (points - inside).T.copy(), strict=True))
    assert read_cloud(write_columns(tmp_path / "c.e57", columns, pose=(1, 0, 0, 0))).front is None


EIGHT = np.random.default_rng(1).integers(0, 256, (40, 3))


@pytest.mark.parametrize(
    ("scans", "expected", "note"),
    [
        ([(EIGHT / 255, (0, 1))], EIGHT, None),
        ([(EIGHT * 257, (0, 65535))], EIGHT, None),
        ([(EIGHT * 200, (0, 65535))], EIGHT * 200, None),
        ([(EIGHT // 255, (0, 255))], EIGHT // 255, None),
        ([(EIGHT, (0, 65535))], EIGHT // 129, "its colors are almost black: at most 255 of"),
        ([(EIGHT * 16, (0, 4080))], EIGHT, "its colors are scaled from their limits 0..4080"),
        ([(EIGHT * [1, 2, 3] + 7, (7, [262, 517, 772]))], EIGHT, "scaled from their limits 7..772"),
        ([(EIGHT, (0, 1))], EIGHT, "the color limits 0..1 do not fit its colors and are"),
        ([(EIGHT, (0, 0))], EIGHT, "the color limits 0..0 do not fit its colors and are"),
        ([(EIGHT / 255, (0, 1)), (EIGHT, (0, 255)), (EIGHT, None)], np.tile(EIGHT, (3, 1)), None),
        (
            [(EIGHT * 200, (0, 65535)), (EIGHT, (0, 255))],
            np.concatenate([EIGHT * 200, EIGHT * 257]),
            None,
        ),
    ],
)
def test_limits_of_colors_decide_their_range(tmp_path, scans, expected, note):
    axes = dict(zip(AXES, np.random.default_rng(0).random((3, len(EIGHT))), strict=True))
    with pye57.E57(str(tmp_path / "a.e57"), "w") as file:
        for colors, limits in scans:
            columns = colors.T.astype("d" if colors.dtype.kind == "f" else "q", order="C")
            append_scan(file, axes | dict(zip(RGB, columns, strict=True)), limits=limits)
    cloud = read_cloud(tmp_path / "a.e57")
    np.testing.assert_array_equal(cloud.fields["color"], expected)
    assert [note in each for each in cloud.notes] == ([True] if note else [])


@pytest.mark.parametrize("order", ["wxyz", "xyzw", "zwxy"])
def test_poses_are_read_by_name_in_any_order(tmp_path, order):
    columns = dict(zip(AXES, np.eye(3), strict=True))
    path = write_columns(tmp_path / "a.e57", columns, pose=QUARTER, order=order)
    expected = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(read_cloud(path).coordinates, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((1e300, 0, 0, 0), r"a unit quaternion in '', got norm 1e\+300; correct"),
        ((1e300, 1e300, 0, 0), "a unit quaternion in"),
        ((5e-324, 0, 0, 0), "a unit quaternion in"),
        ((0.1, 0, 0.1, 0), "a unit quaternion in '', got norm 0.141"),
        ((1, 0, 0, 0, 0, -1e13, 0), r"a translation of scan '' within 1e\+12, got -1e\+13;"),
    ],
)
def test_poses_that_are_no_places_are_refused(tmp_path, pose, message):
    path = write_columns(tmp_path / "a.e57", dict(zip(AXES, np.eye(3), strict=True)), pose=pose)
    with pytest.raises(FormatError, match=rf"a\.e57: expected {message}"):
        read_cloud(path)


@pytest.mark.parametrize(("length", "is_told"), [(1.001, False), (1.2, True), (0.0, True)])
def test_rotations_of_another_length_are_told(tmp_path, length, is_told):
    columns = dict(zip(AXES, np.eye(3), strict=True))
    cloud = read_cloud(write_columns(tmp_path / "a.e57", columns, pose=length * QUARTER))
    expected = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] if length else np.eye(3)
    np.testing.assert_allclose(cloud.coordinates, expected, atol=1e-15)
    reported = [
        note for note in cloud.notes if note.startswith("the rotations of 1 of 1 scans are")
    ]
    assert len(reported) == is_told


@pytest.mark.parametrize("grid", [(1e300, 0.0), (1e-310, 0.0), (1e-30, 1e6)])
def test_grids_on_which_points_have_no_places_are_refused(tmp_path, grid):
    columns = dict(zip(AXES, np.zeros((3, 5)), strict=True))
    path = write_columns(tmp_path / "a.e57", columns, grid=(1e-3, 0.0))
    np.testing.assert_array_equal(read_cloud(path).coordinates, np.zeros((5, 3)))
    columns = {name: column + grid[1] for name, column in columns.items()}
    with pytest.raises(FormatError, match="expected a scale and offset of cartesianX that keep"):
        read_cloud(write_columns(path, columns, grid=grid))


def test_bounds_that_contradict_the_points_are_told(tmp_path):
    columns = dict(zip(AXES, np.random.default_rng(0).random((3, 50)), strict=True))
    notes = {}
    for name, bounds in {"right": [[0] * 3, [1] * 3], "wrong": [[0] * 3, [1, 1e-3, 1]]}.items():
        path = write_columns(tmp_path / f"{name}.e57", columns, bounds=bounds)
        notes[name] = read_cloud(path).notes
    reported = "the points of 1 of 1 scans lie outside the bounds in the header; check the scales"
    assert notes == {"right": (), "wrong": (reported,)}


def test_scans_read_to_disk_take_little_memory(tmp_path, write_scan, monkeypatch):
    monkeypatch.setattr(scratch, "_MIN_BYTES", 1)
    rng, num_points = np.random.default_rng(0), 40_000
    color = {"color": rng.integers(0, 256, (num_points, 3)).astype(np.uint8)}
    pose = {"rotation": QUARTER, "translation": np.array([500_000.0, 4_500_000.0, 0])}
    cloud = Cloud(rng.random((num_points, 3)), color)
    path = write_scan(tmp_path / "a.e57", cloud, **pose)
    with scratch.on_disk(tmp_path):
        read_cloud(path)  # The parser is loaded.
        tracemalloc.start()
        found = read_cloud(path)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # Coordinates and colors take 27 bytes.
    assert most < 20 * num_points
    assert np.array_equal(found.fields["color"], cloud.fields["color"])
