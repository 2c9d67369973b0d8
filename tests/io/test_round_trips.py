"""What torchrg writes, it reads back, in every format."""

import json
import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchrg.io
from tests.io.conftest import needs
from torchrg import scratch
from torchrg.errors import FormatError, ShapeError
from torchrg.io import (
    FORMATS,
    RESULT_FIELDS,
    check_output,
    files,
    las,
    npy,
    read_cloud,
    text,
    write_cloud,
)
from torchrg.io.fields import describe_renamed_fields
from torchrg.structures import Cloud, PlaneAdjacency, Superpoints

WRITTEN = [kind for kind, row in FORMATS.items() if row.write]
EXACT = [".npz", ".npy", ".ply", ".pcd"]
TEXT = [".xyz", ".txt", ".asc"]
GRID = [".las", ".laz"]
UTM = (500_000.0, 4_500_000.0, 100.0)


def with_holes(cloud):
    """Return a cloud with two points that are not finite."""
    cloud.coordinates[3], cloud.coordinates[7] = np.nan, [np.inf, 0.0, -np.inf]
    return cloud


@pytest.fixture(params=WRITTEN)
def suffix(request):
    needs(request.param)
    return request.param


@pytest.mark.parametrize("kind", EXACT)
@pytest.mark.parametrize(("number", "origin"), [("f4", (0, 0, 0)), ("f8", UTM)])
def test_binary_formats_keep_every_bit(tmp_path, make_cloud, assert_same, kind, number, origin):
    cloud = with_holes(make_cloud(dtype=number, origin=origin))
    write_cloud(tmp_path / f"a{kind}", cloud)
    found = read_cloud(tmp_path / f"a{kind}")
    assert_same(found, cloud)
    assert np.flatnonzero(~found.finite).tolist() == [3, 7]
    assert found.coordinates.dtype == cloud.coordinates.dtype
    assert found.fields["labels"].dtype == np.int64
    assert found.fields["color"].dtype == np.uint8
    assert found.source == str(tmp_path / f"a{kind}")


@pytest.mark.parametrize("kind", TEXT)
@pytest.mark.parametrize(("number", "origin"), [("f4", (0, 0, 0)), ("f8", UTM)])
def test_text_keeps_every_value(tmp_path, make_cloud, kind, number, origin):
    cloud = with_holes(make_cloud(dtype=number, origin=origin))
    write_cloud(tmp_path / f"a{kind}", cloud)
    found = read_cloud(tmp_path / f"a{kind}")
    assert found.coordinates.dtype == np.float64
    np.testing.assert_array_equal(found.coordinates.astype(number), cloud.coordinates)
    for name, values in cloud.fields.items():
        np.testing.assert_array_equal(found.fields[name].astype(values.dtype), values)


@pytest.mark.parametrize("kind", GRID)
def test_las_keeps_coordinates_to_its_grid_and_fields_exactly(tmp_path, make_cloud, kind):
    needs(kind)
    cloud = make_cloud(dtype="f8", origin=UTM)
    write_cloud(tmp_path / f"a{kind}", cloud)
    found = read_cloud(tmp_path / f"a{kind}")
    # Half a step of the grid (32 bits over a few meters, in powers of ten) and half a float64.
    np.testing.assert_allclose(found.coordinates, cloud.coordinates, rtol=0, atol=0.5e-8 + 1e-9)
    for name, values in cloud.fields.items():
        np.testing.assert_array_equal(found.fields[name], values, err_msg=name)


@pytest.mark.parametrize("kind", WRITTEN)
def test_equal_clouds_give_equal_bytes(tmp_path, make_cloud, kind, monkeypatch):
    needs(kind)
    write_cloud(tmp_path / f"a{kind}", make_cloud())
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.localtime", lambda *_: (2033, 5, 18, 3, 33, 20, 2, 138, 0))
    write_cloud(tmp_path / f"b{kind}", make_cloud())
    assert (tmp_path / f"a{kind}").read_bytes() == (tmp_path / f"b{kind}").read_bytes()


@pytest.mark.parametrize("kind", [kind for kind in WRITTEN if kind != ".npz"])
def test_own_fields_that_a_result_has_too_are_kept_aside(
    tmp_path, make_cloud, make_segmentation, kind
):
    needs(kind)
    cloud, seg = make_cloud(), make_segmentation(60)
    results = {"labels": seg.labels, "normals": seg.normals, "curvature": seg.curvature}
    write_cloud(tmp_path / f"a{kind}", cloud, seg)
    # A result that is segmented again keeps what its input had.
    again = read_cloud(tmp_path / f"a{kind}")
    write_cloud(tmp_path / f"b{kind}", again, seg)
    write_cloud(tmp_path / f"c{kind}", read_cloud(tmp_path / f"b{kind}"), seg)
    for name in ("a", "b", "c"):
        fields = read_cloud(tmp_path / f"{name}{kind}").fields
        renamed = {"label_input", "normals_input", "curvature_input"}
        assert fields.keys() == cloud.fields.keys() | renamed
        for field, values in results.items():
            np.testing.assert_array_equal(fields[field].astype("f4"), values)
            own = "label_input" if field == "labels" else f"{field}_input"
            np.testing.assert_array_equal(fields[own].astype("f4"), cloud.fields[field])
    assert (tmp_path / f"b{kind}").read_bytes() == (tmp_path / f"c{kind}").read_bytes()
    reported = describe_renamed_fields(cloud.fields, RESULT_FIELDS)
    names = "label as label_input, normals as normals_input, curvature as curvature_input"
    assert reported == [f"input fields are kept next to the result: {names}"]
    assert describe_renamed_fields(again.fields, RESULT_FIELDS) == [
        "its own label, normals, curvature left out for the result's; label_input, normals_input, "
        "curvature_input stay"
    ]
    assert describe_renamed_fields({"color"}, RESULT_FIELDS) == []


def test_own_superpoints_are_kept_aside_too(tmp_path, make_cloud):
    cloud = make_cloud(60)
    parts = Superpoints(torch.arange(60) // 2, torch.full((30,), -1), (torch.arange(60) // 4,))
    own = {"superpoint": np.arange(60, dtype=np.int32)}
    for kind in (".npz", ".ply"):
        write_cloud(tmp_path / f"a{kind}", replace(cloud, fields=own), superpoints=parts)
        fields = read_cloud(tmp_path / f"a{kind}").fields
        assert fields.keys() == {"superpoint", "superpoint_1", "superpoint_input"}
        np.testing.assert_array_equal(fields["superpoint"], parts.labels)
        np.testing.assert_array_equal(fields["superpoint_input"], own["superpoint"])


def test_result_file_has_exactly_the_documented_arrays(tmp_path, make_cloud, make_segmentation):
    seg = make_segmentation(60)
    cloud = make_cloud(dtype="f8", origin=UTM)
    write_cloud(tmp_path / "a.npz", cloud, seg, provenance={"torchrg": "1", "config": {"k": 50}})
    with np.load(tmp_path / "a.npz", allow_pickle=False) as result:
        arrays = dict(result)
    points = ["points", "color", "labels", "normals", "curvature", "sharp", "valid"]
    planes = ["normal", "offset", "centroid", "area", "count", "rms"]
    planes += ["extent", "axes", "center", "curved"]
    assert list(arrays) == [*points, *(f"plane_{name}" for name in planes), "provenance"]
    assert json.loads(str(arrays["provenance"])) == {"torchrg": "1", "config": {"k": 50}}
    assert arrays["points"].dtype == np.float64
    assert arrays["labels"].dtype == np.int64
    assert arrays["sharp"].dtype == arrays["valid"].dtype == bool
    np.testing.assert_array_equal(arrays["points"], cloud.coordinates)
    np.testing.assert_array_equal(arrays["plane_count"], [30, 20, 10])


def test_order_of_provenance_does_not_change_the_file(tmp_path, make_cloud):
    write_cloud(tmp_path / "a.npz", make_cloud(), provenance={"a": 1, "b": {"c": 2, "d": 3}})
    write_cloud(tmp_path / "b.npz", make_cloud(), provenance={"b": {"d": 3, "c": 2}, "a": 1})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_planes_are_written_in_the_coordinates_of_the_input(
    tmp_path, make_cloud, make_segmentation
):
    seg, cloud = make_segmentation(60), make_cloud(dtype="f8", origin=UTM)
    assert cloud.origin.any()
    write_cloud(tmp_path / "a.npz", cloud, seg)
    with np.load(tmp_path / "a.npz") as result:
        normal, offset = result["plane_normal"], result["plane_offset"]
        centroid, center = result["plane_centroid"], result["plane_center"]
    assert offset.dtype == centroid.dtype == center.dtype == np.float64
    np.testing.assert_allclose(centroid - cloud.origin, seg.planes.centroid, atol=1e-8)
    np.testing.assert_allclose(center - cloud.origin, seg.planes.center, atol=1e-8)
    # The centroids lie in their planes, there and here; float32 at a few meters is good for 1e-6.
    distance = (normal.astype(np.float64) * centroid).sum(axis=1) - offset
    np.testing.assert_allclose(distance, 0, atol=2e-6)


def test_kinds_adjacency_and_outlines_are_written(tmp_path, make_cloud, make_segmentation):
    seg, cloud = make_segmentation(60), make_cloud(dtype="f8", origin=UTM)
    rings = [torch.rand(size, 3) for size in (5, 4, 6)]
    adjacency = PlaneAdjacency(
        torch.tensor([[0, 2], [1, 2]]), torch.tensor([1.5, 2]), torch.tensor([90.0, 45])
    )
    table = replace(
        seg.planes,
        kind=torch.tensor([1, 3, 0]),
        adjacency=adjacency,
        outline=((rings[0], rings[1]), (), (rings[2],)),
    )
    write_cloud(tmp_path / "a.npz", cloud, replace(seg, planes=table))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as result:
        arrays = dict(result)
    assert arrays["plane_kind"].tolist() == ["floor", "wall", "other"]
    for name, values in zip(PlaneAdjacency._fields, adjacency, strict=True):
        np.testing.assert_array_equal(arrays[f"adjacency_{name}"], values)
    assert arrays["outline_ring_planes"].tolist() == [0, 0, 2]
    ends = np.cumsum(arrays["outline_ring_sizes"])[:-1]
    for found, ring in zip(np.split(arrays["outline_points"], ends), rings, strict=True):
        np.testing.assert_allclose(found - cloud.origin, ring, atol=1e-8)


def test_reading_a_result_gives_fields_of_points_only(tmp_path, make_cloud, make_segmentation):
    # As many planes as points must not make fields of them.
    seg = make_segmentation(3)
    cloud = make_cloud(3)
    write_cloud(tmp_path / "a.npz", cloud, seg)
    fields = read_cloud(tmp_path / "a.npz").fields
    assert set(fields) == {"color", "labels", "normals", "curvature", "sharp", "valid"}
    np.testing.assert_array_equal(fields["color"], cloud.fields["color"])


def test_segmentation_of_another_cloud_is_refused(tmp_path, make_cloud, make_segmentation):
    with pytest.raises(FormatError, match=r"a\.ply: expected a segmentation of 60 points, got 59"):
        write_cloud(tmp_path / "a.ply", make_cloud(), make_segmentation(59))
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(
    ("number", "kept"),
    [("i2", "f4"), ("u1", "f4"), ("f2", "f4"), ("i4", "f8"), ("i8", "f8"), (">f8", "f8")],
)
def test_other_numbers_become_floating_point_that_holds_them(tmp_path, number, kept):
    coordinates = np.arange(12).reshape(4, 3).astype(number)
    write_cloud(tmp_path / "a.npz", Cloud(coordinates))
    found = read_cloud(tmp_path / "a.npz").coordinates
    assert found.dtype == kept
    assert found.dtype.isnative
    np.testing.assert_array_equal(found, coordinates)


@pytest.mark.parametrize("number", ["c8", "bool", "U3", "M8[s]"])
def test_other_types_of_coordinates_are_refused(tmp_path, number):
    np.savez(tmp_path / "a.npz", points=np.zeros((4, 3), number))
    with pytest.raises(FormatError, match=r"a\.npz: expected real coordinates, got"):
        read_cloud(tmp_path / "a.npz")


def test_truth_values_and_wide_integers_are_kept_by_value(tmp_path, make_cloud):
    fields = {
        "sharp": np.array([True, False, True]),
        "wide": np.array([0, 2**40, -(2**40)]),
        "unsigned": np.array([0, 2**32 - 1, 1], np.uint64),
        "half": np.array([0.5, 1.5, -2.0], np.float16),
    }
    for kind in (".ply", ".pcd", ".npy", ".npz"):
        write_cloud(tmp_path / f"a{kind}", Cloud(np.zeros((3, 3)), fields))
        found = read_cloud(tmp_path / f"a{kind}").fields
        for name, values in fields.items():
            np.testing.assert_array_equal(found[name].astype(values.dtype), values)


# Archives hold any field that is no Python object.
@pytest.mark.parametrize("kind", [kind for kind in WRITTEN if kind != ".npz"])
@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("tag", np.array(["a", "b"]), "expected tag of real numbers"),
        ("wave", np.zeros(2, complex), "expected wave of real numbers"),
        ("long", np.zeros(2, np.longdouble), "expected long of real numbers"),
        ("short", np.zeros(1), r"expected field short of shape \(2, \.\.\.\), got \(1,\)"),
        ("cube", np.zeros((2, 2, 2)), r"expected cube of shape \(N,\) or \(N, C\)"),
        ("none", np.zeros((2, 0)), r"expected none of shape \(N,\) or \(N, C\)"),
        ("x", np.zeros(2), "duplicate field name 'x'"),
        ("color", np.zeros((2, 3)), "expected uint8 or uint16 color, got float64"),
        ("_", np.zeros(2), "a field cannot be named '_'; rename it"),
    ],
)
def test_fields_that_a_file_cannot_hold_are_refused(tmp_path, kind, name, values, message):
    needs(kind)
    with pytest.raises(FormatError, match=message):
        write_cloud(tmp_path / f"a{kind}", Cloud(np.zeros((2, 3)), {name: values}))
    assert list(tmp_path.iterdir()) == []


def test_archives_hold_text_but_no_objects(tmp_path):
    cloud = Cloud(np.zeros((2, 3)), {"tag": np.array(["a", "b"])})
    write_cloud(tmp_path / "a.npz", cloud)
    assert read_cloud(tmp_path / "a.npz").fields["tag"].tolist() == ["a", "b"]
    cloud = Cloud(np.zeros((2, 3)), {"tag": np.array([{}, []], dtype=object)})
    with pytest.raises(FormatError, match="field tag contains Python objects"):
        write_cloud(tmp_path / "b.npz", cloud)
    cloud = Cloud(np.zeros((2, 3)), {"short": np.zeros(1)})
    with pytest.raises(
        FormatError, match=r"expected field short of shape \(2, \.\.\.\), got \(1,\)"
    ):
        write_cloud(tmp_path / "b.npz", cloud)
    with pytest.raises(FormatError, match="a field cannot be named 'coord'"):
        write_cloud(tmp_path / "b.npz", Cloud(np.zeros((2, 3)), {"coord": np.zeros((2, 3))}))


def test_no_points_are_refused(tmp_path, suffix):
    with pytest.raises(FormatError, match="expected at least one point, got none"):
        write_cloud(tmp_path / f"a{suffix}", Cloud(np.zeros((0, 3))))


@pytest.mark.parametrize(("call", "kinds"), [(read_cloud, FORMATS), (check_output, WRITTEN)])
def test_unknown_suffix_lists_the_known_ones(tmp_path, call, kinds):
    (tmp_path / "a.abc").write_bytes(b"solid")
    known = re.escape(f"{' '.join(kinds)}, got '.abc'")
    with pytest.raises(FormatError, match=rf"a\.abc: expected a file ending in one of {known}"):
        call(tmp_path / "a.abc")


@pytest.mark.parametrize("kind", [*FORMATS, ".stl"])
def test_missing_files_directories_and_empty_files_are_refused(tmp_path, kind):
    path = tmp_path / f"a{kind}"
    with pytest.raises(FormatError, match=r"a\.\w+: file not found"):
        read_cloud(path)
    path.touch()
    with pytest.raises(FormatError, match=r"a\.\w+: byte 0: the file is empty"):
        read_cloud(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(FormatError, match=r"a\.\w+: expected a file, got a directory"):
        read_cloud(path)


def test_unreadable_files_are_one_line(tmp_path, monkeypatch):
    def refuse(path, size):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "a.ply").write_bytes(b"ply")
    monkeypatch.setitem(torchrg.io.FORMATS, ".ply", FORMATS[".ply"]._replace(read=refuse))
    with pytest.raises(FormatError, match=r"a\.ply: cannot be read: Permission denied\."):
        read_cloud(tmp_path / "a.ply")


def test_formats_of_one_direction_say_so(tmp_path, make_cloud):
    message = r"a\.e57: \.e57 can be read but not written\. Use \.laz or \.ply\."
    for call in (check_output, lambda path: write_cloud(path, make_cloud())):
        with pytest.raises(FormatError, match=message):
            call(tmp_path / "a.e57")
    write_cloud(tmp_path / "a.vg", make_cloud())
    with pytest.raises(FormatError, match=r"a\.vg: expected a file ending in one of .*'\.vg'"):
        read_cloud(tmp_path / "a.vg")
    with pytest.raises(FormatError, match=r"a\.bvg: expected a file ending in one of"):
        check_output(tmp_path / "a.bvg")


def test_outputs_are_checked_before_the_work(tmp_path):
    for name in ("a.ply", "a.vg", "A.PLY"):
        check_output(tmp_path / name)
    with pytest.raises(FormatError, match="not found; create it first"):
        check_output(tmp_path / "missing" / "a.ply")
    (tmp_path / "b.ply").mkdir()
    with pytest.raises(FormatError, match=r"b\.ply: expected a file to write, got a directory"):
        check_output(tmp_path / "b.ply")


@pytest.mark.parametrize("given", [torch.eye(3), np.eye(3, dtype=np.float32)])
def test_points_alone_are_a_cloud(given, tmp_path):
    write_cloud(tmp_path / "points.ply", given)
    assert np.array_equal(read_cloud(tmp_path / "points.ply").coordinates, np.eye(3))
    with pytest.raises(ShapeError, match=r"write_cloud: expected cloud of shape \(N, 3\)"):
        write_cloud(tmp_path / "points.ply", given[:, :2])


@pytest.mark.parametrize("name", ["a\0b", "n" * 70_000])
@pytest.mark.parametrize("kind", WRITTEN)
def test_names_that_no_file_can_hold_are_refused(tmp_path, kind, name):
    cloud = Cloud(np.zeros((2, 3)), {name: np.zeros(2)})
    with pytest.raises(FormatError, match=r"expected field names without NUL .*; rename the fie"):
        write_cloud(tmp_path / f"a{kind}", cloud)


def owns(values):
    """Return whether an array is a view of no file, no buffer and no larger array."""
    owner = values
    while isinstance(owner.base, np.ndarray):
        owner = owner.base
    return owner.base is None and owner.nbytes == values.nbytes and values.flags["W"]


@pytest.mark.parametrize("num_points", [1, 12])
def test_no_array_of_a_cloud_is_a_view_of_its_file(tmp_path, make_cloud, suffix, num_points):
    write_cloud(tmp_path / f"a{suffix}", make_cloud(num_points=num_points))
    cloud = read_cloud(tmp_path / f"a{suffix}")
    assert all(map(owns, [cloud.coordinates, *cloud.fields.values()]))


def test_a_file_of_columns_is_no_part_of_the_cloud(tmp_path):
    table = np.asfortranarray(np.arange(40.0).reshape(10, 4))
    np.save(tmp_path / "a.npy", table)
    cloud = read_cloud(tmp_path / "a.npy", columns=("x", "y", "z", "quality"))
    np.save(tmp_path / "a.npy", table[:1])  # In place: a map of the file would end the process.
    assert cloud.fields["quality"].tolist() == table[:, 3].tolist()
    np.savez(tmp_path / "b.npz", points=np.asfortranarray(table[:, :3]))
    assert read_cloud(tmp_path / "b.npz").coordinates.tolist() == table[:, :3].tolist()


@pytest.mark.parametrize("kind", [*EXACT, ".xyz", *GRID])
def test_reading_to_disk_takes_little_memory(tmp_path, monkeypatch, kind):
    needs(kind)
    num_points = 40_000
    for module, name, number in (
        (las, "_POINTS_PER_CHUNK", 2000),
        (text, "CHARACTERS_PER_READ", 2**15),
        (files, "BYTES_PER_READ", 2**15),
        (npy, "BYTES_PER_READ", 2**15),
        (scratch, "_MIN_BYTES", 1),
    ):
        monkeypatch.setattr(module, name, number)
    rng = np.random.default_rng(0)
    fields = {f"field{i}": rng.random(num_points) for i in range(6)}
    write_cloud(tmp_path / f"a{kind}", Cloud(rng.random((num_points, 3)), fields))
    with scratch.on_disk(tmp_path):
        read_cloud(tmp_path / f"a{kind}")  # The parser is loaded.
        tracemalloc.start()
        cloud = read_cloud(tmp_path / f"a{kind}")
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # Nine columns take 72 bytes.
    assert most < 30 * num_points
    assert cloud.fields.keys() == fields.keys()
