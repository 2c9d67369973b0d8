"""A cloud written chunk by chunk leaves the bytes that writing it at once leaves."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrg.errors import FormatError
from torchrg.io import FORMATS, CloudStream, read_cloud, stream_cloud, write_cloud
from torchrg.structures import Cloud, Superpoints

NUM_POINTS = 60
CHUNK_SIZES = [1, 7, 1000]
NO_E57 = [kind for kind in FORMATS if kind != ".e57"]
"""E57 files carry random identifiers."""


def needs(suffix):
    pytest.importorskip({".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy"))


def assert_same_bytes(tmp_path, kind, cloud, *results, **further):
    """Check that a cloud leaves the same file at once and in chunks."""
    write_cloud(tmp_path / f"whole{kind}", cloud, *results, **further)
    expected = (tmp_path / f"whole{kind}").read_bytes()
    for size in CHUNK_SIZES:
        stream = CloudStream.of(cloud, chunk_size=size)
        write_cloud(tmp_path / f"chunks{kind}", stream, *results, **further)
        assert (tmp_path / f"chunks{kind}").read_bytes() == expected, size
    assert len(list(tmp_path.glob(f"*{kind}"))) == 2


@pytest.mark.parametrize("kind", NO_E57)
def test_chunks_leave_the_same_bytes(tmp_path, make_cloud, kind):
    needs(kind)
    assert_same_bytes(tmp_path, kind, make_cloud(dtype="f8", origin=(5e5, 4e6, 1)))
    assert_same_bytes(tmp_path, kind, Cloud(make_cloud().coordinates))


@pytest.mark.parametrize("num_points", [1, 60, 1000])
def test_arrays_are_as_numpy_writes_them(tmp_path, num_points):
    points = np.random.default_rng(0).random((num_points, 3))
    stream = CloudStream.of(Cloud(points, {"tag": np.full(num_points, "ä")}), chunk_size=7)
    write_cloud(tmp_path / "a.npz", stream)
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        for name, values in (("points", points), ("tag", np.full(num_points, "ä"))):
            np.save(tmp_path / "b.npy", values)
            assert archive.read(f"{name}.npy") == (tmp_path / "b.npy").read_bytes()


@pytest.mark.parametrize("kind", NO_E57)
def test_last_point_decides_the_types(tmp_path, make_cloud, kind):
    needs(kind)
    small = np.arange(NUM_POINTS)
    fields = {
        "labels": small.copy(),
        "signed": small.copy(),
        "unsigned": small.astype(np.uint64),
        "wide": np.stack([small, small], axis=1),
        "classification": small.copy(),
        "gps_time": small / 3,
    }
    fields["labels"][-1] = fields["wide"][-1, 1] = 2**40
    fields["unsigned"][-1], fields["signed"][-1] = 2**32 - 1, -(2**31)
    fields["classification"][-1] = 300
    assert_same_bytes(tmp_path, kind, Cloud(make_cloud().coordinates, fields))
    found = read_cloud(tmp_path / f"chunks{kind}")
    # In PLY the columns of "wide" have types of their own, so they are not joined again.
    for name in fields.keys() - {"wide"}:
        np.testing.assert_array_equal(found.fields[name], fields[name], err_msg=name)


@pytest.mark.parametrize("kind", NO_E57)
def test_results_are_the_same_bytes_too(tmp_path, make_cloud, make_segmentation, kind):
    needs(kind)
    seg = make_segmentation(NUM_POINTS)
    parts = Superpoints(seg.labels + 1, torch.tensor([-1, 0]), (seg.labels,))
    further = {"superpoints": parts, "provenance": {"torchrg": "1"}}
    cloud = make_cloud(dtype="f8", origin=(5e5, 4e6, 1))
    assert_same_bytes(tmp_path, kind, cloud, seg)
    assert_same_bytes(tmp_path, kind, cloud, seg, **further)
    assert_same_bytes(tmp_path, kind, cloud, **further)


def test_npz_of_a_stream_has_the_plane_table_and_provenance(
    tmp_path, make_cloud, make_segmentation
):
    cloud, seg = make_cloud(dtype="f8", origin=(5e5, 4e6, 1)), make_segmentation(NUM_POINTS)
    stream = CloudStream.of(cloud, chunk_size=7)
    write_cloud(tmp_path / "a.npz", stream, seg, provenance={"k": 50})
    with np.load(tmp_path / "a.npz") as found:
        np.testing.assert_array_equal(found["points"], cloud.coordinates)
        np.testing.assert_array_equal(found["sharp"], seg.sharp)
        moved = seg.planes.centroid.double().numpy() + cloud.origin
        np.testing.assert_array_equal(found["plane_centroid"], moved)
        assert json.loads(str(found["provenance"])) == {"k": 50}


def test_results_may_be_mapped_from_files(tmp_path, make_cloud, make_segmentation):
    cloud, seg = make_cloud(), make_segmentation(NUM_POINTS)
    mapped = {}
    for name in ("labels", "normals", "curvature", "sharp", "valid"):
        np.save(tmp_path / f"{name}.npy", getattr(seg, name))
        values = np.lib.format.open_memmap(tmp_path / f"{name}.npy", mode="r+")
        mapped[name] = torch.from_numpy(values)
    for kind in (".npz", ".ply"):
        write_cloud(tmp_path / f"a{kind}", cloud, seg)
        write_cloud(
            tmp_path / f"b{kind}", CloudStream.of(cloud, chunk_size=7), seg._replace(**mapped)
        )
        assert (tmp_path / f"a{kind}").read_bytes() == (tmp_path / f"b{kind}").read_bytes()


def test_las_header_and_empty_dimensions_pass_through(tmp_path):
    laspy = pytest.importorskip("laspy")
    data = laspy.create(point_format=3, file_version="1.2")
    data.header.scales, data.header.offsets = [0.001] * 3, [100.0, 0.0, 0.0]
    data.x = data.y = data.z = np.arange(NUM_POINTS) / 8
    data.blue[-1] = 257
    data.write(tmp_path / "a.las")
    stream = stream_cloud(tmp_path / "a.las", chunk_size=7)
    write_cloud(tmp_path / "b.las", stream)
    write_cloud(tmp_path / "c.las", read_cloud(tmp_path / "a.las"))
    assert (tmp_path / "b.las").read_bytes() == (tmp_path / "c.las").read_bytes()
    after = laspy.read(tmp_path / "b.las")
    assert after.header.offsets.tolist() == [100.0, 0.0, 0.0]
    np.testing.assert_array_equal(after.X, data.X)


def test_las_names_the_first_point_that_is_not_finite(tmp_path, make_cloud):
    pytest.importorskip("laspy")
    cloud = make_cloud()
    cloud.coordinates[[23, 40]] = np.nan
    for given in (cloud, CloudStream.of(cloud, chunk_size=7)):
        with pytest.raises(FormatError, match=r"got 2 points that are not \(first: 23\)"):
            write_cloud(tmp_path / "a.las", given)


def test_e57_in_chunks_holds_the_same_scans(tmp_path, make_cloud, assert_same):
    pye57 = pytest.importorskip("pye57")
    from torchrg.io.e57 import ScanPose

    number = np.repeat(np.arange(3, dtype=np.int32), [20, 0, 40])
    scans = (ScanPose("a"), ScanPose("none"), ScanPose("b", (0.9, 0.1, -0.3, 0.2), (5e5, 2.0, 3.0)))
    cloud = make_cloud(dtype="f8", header={"scans": scans})
    cloud = replace(cloud, fields={**cloud.fields, "scan": number})
    cloud.coordinates[-1] = np.nan
    write_cloud(tmp_path / "whole.e57", cloud)
    expected = read_cloud(tmp_path / "whole.e57")
    for size in CHUNK_SIZES:
        write_cloud(tmp_path / "a.e57", CloudStream.of(cloud, chunk_size=size))
        assert_same(read_cloud(tmp_path / "a.e57"), expected)
        assert described(pye57, tmp_path / "a.e57") == described(pye57, tmp_path / "whole.e57")
    assert len(described(pye57, tmp_path / "whole.e57")) == 2


def described(pye57, path):
    """Return the fields and the limits that a file says of each scan."""
    with pye57.E57(str(path)) as file:
        headers = [file.get_header(i) for i in range(file.scan_count)]
        return [(h.point_fields, h.point_count, limits_of(h)) for h in headers]


def limits_of(header):
    """Return all limits that the header of a scan gives."""
    nodes = [header[name] for name in ("cartesianBounds", "intensityLimits", "colorLimits")]
    names = [[node.get(i).elementName() for i in range(node.childCount())] for node in nodes]
    return {
        name: node[name].value() for node, own in zip(nodes, names, strict=True) for name in own
    }


@pytest.mark.parametrize("field", ["unsorted", "unsigned"])
def test_e57_scans_out_of_order_are_one_scan(tmp_path, make_cloud, field):
    pytest.importorskip("pye57")
    from torchrg.io.e57 import ScanPose

    number = np.repeat([0, 1], [20, 40])
    number[-1] = 0
    number = number.astype(np.uint8 if field == "unsigned" else np.int32)
    cloud = make_cloud(header={"scans": (ScanPose("a"), ScanPose("b"))})
    cloud = replace(cloud, fields={"scan": number})
    write_cloud(tmp_path / "a.e57", CloudStream.of(cloud, chunk_size=7))
    found = read_cloud(tmp_path / "a.e57")
    assert len(found.header["scans"]) == 1
    assert found.fields["scan"].tolist() == number.tolist()


@pytest.mark.parametrize("kind", list(FORMATS))
def test_text_of_unknown_length_becomes_any_format(tmp_path, make_cloud, kind):
    needs(kind)
    write_cloud(tmp_path / "a.txt", make_cloud())
    whole = read_cloud(tmp_path / "a.txt")
    write_cloud(tmp_path / f"b{kind}", stream_cloud(tmp_path / "a.txt", chunk_size=7))
    write_cloud(tmp_path / f"c{kind}", whole)
    found, expected = read_cloud(tmp_path / f"b{kind}"), read_cloud(tmp_path / f"c{kind}")
    np.testing.assert_array_equal(found.coordinates, expected.coordinates)
    for name, values in expected.fields.items():
        np.testing.assert_array_equal(found.fields[name], values)


@pytest.mark.parametrize("kind", list(FORMATS))
def test_damage_met_while_writing_leaves_the_older_file(tmp_path, make_cloud, kind):
    needs(kind)

    def break_off():
        yield make_cloud(30)
        yield make_cloud(20)
        raise FormatError("a.ply: byte 9: damaged.")

    path = tmp_path / f"a{kind}"
    path.write_text("old")
    for count, message in ((50, "damaged"), (40, "damaged")):
        with pytest.raises(FormatError, match=message):
            write_cloud(path, CloudStream(break_off, count))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", list(FORMATS))
@pytest.mark.parametrize("promised", [59, 61])
def test_number_of_points_is_held_to(tmp_path, make_cloud, kind, promised):
    needs(kind)
    stream = replace(CloudStream.of(make_cloud(), chunk_size=7), num_points=promised)
    with pytest.raises(FormatError, match=rf"expected {promised} points in chunks, got 60\."):
        write_cloud(tmp_path / f"a{kind}", stream)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", list(FORMATS))
def test_field_of_more_values_than_points_is_refused(tmp_path, make_cloud, kind):
    needs(kind)
    message = r"a\.\w+: expected field more of shape \(60, \.\.\.\), got \(61,\)"
    with pytest.raises(FormatError, match=message):
        write_cloud(tmp_path / f"a{kind}", replace(make_cloud(), fields={"more": np.ones(61)}))


def test_segmentation_of_another_stream_is_refused(tmp_path, make_cloud, make_segmentation):
    stream = CloudStream.of(make_cloud(), chunk_size=7)
    with pytest.raises(FormatError, match=r"a\.ply: expected a segmentation of 60 points, got 59"):
        write_cloud(tmp_path / "a.ply", stream, make_segmentation(59))
