"""LAS and LAZ: what came in goes out, in the format's own form."""

import pickle
import re
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import torchrg._optional
from torchrg.errors import FormatError, MissingDependencyError
from torchrg.io import check_output, las, read_cloud, write_cloud
from torchrg.structures import Cloud

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")

WKT = 'LOCAL_CS["hand made"]'


@pytest.fixture
def scanned(tmp_path):
    """A file as a scanner writes it: own scale, reference system, dimensions, wide colors."""

    def write(point_format=3, version="1.2", suffix=".las"):
        header = laspy.LasHeader(point_format=point_format, version=version)
        header.scales, header.offsets = [0.001, 0.001, 0.01], [5e5, 4.5e6, 0]
        header.system_identifier = "scanner"
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(WKT))
        header.add_extra_dim(laspy.ExtraBytesParams("Range", "f8"))
        header.add_extra_dim(laspy.ExtraBytesParams("zero", "u2"))
        header.add_extra_dim(laspy.ExtraBytesParams("pair", "2f4"))
        data = laspy.LasData(header)
        rng = np.random.default_rng(0)
        data.x, data.y, data.z = (5e5 + rng.random(50), 4.5e6 + rng.random(50), rng.random(50))
        data.intensity = rng.integers(0, 65536, 50)
        data.return_number = rng.integers(1, 5, 50)
        data.number_of_returns = np.full(50, 4)
        data.classification = rng.integers(0, 20, 50)
        data.gps_time = rng.random(50)
        if "red" in data.point_format.dimension_names:
            data.green, data.blue = rng.integers(0, 65536, (2, 50))
        data.Range, data.pair = rng.random(50), rng.random((50, 2))
        data.write(tmp_path / f"scan{suffix}")
        return tmp_path / f"scan{suffix}"

    return write


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("point_format", "version"), [(3, "1.2"), (7, "1.4")])
def test_everything_that_came_in_goes_out(
    tmp_path, scanned, make_segmentation, suffix, point_format, version
):
    source = scanned(point_format, version, suffix)
    cloud = read_cloud(source)
    assert cloud.fields["color"].dtype == np.uint16
    assert "user_data" not in cloud.fields
    assert "zero" in cloud.fields
    seg = make_segmentation(50)
    write_cloud(tmp_path / f"out{suffix}", cloud, seg)
    before, after = laspy.read(source), laspy.read(tmp_path / f"out{suffix}")
    for name in before.point_format.dimension_names:
        np.testing.assert_array_equal(after[name], before[name], err_msg=name)
    assert after.header.version == before.header.version
    assert after.header.point_format.id == point_format
    assert after.header.scales.tolist() == [0.001, 0.001, 0.01]
    assert after.header.offsets.tolist() == [5e5, 4.5e6, 0]
    assert after.header.system_identifier == "scanner"
    assert after.header.vlrs.get("WktCoordinateSystemVlr")[0].string == WKT
    assert after["label"].dtype == np.int32
    np.testing.assert_array_equal(after["label"], seg.labels)
    np.testing.assert_array_equal(after["NormalX"], seg.normals[:, 0])
    np.testing.assert_array_equal(after["Curvature"], seg.curvature)
    again = read_cloud(tmp_path / f"out{suffix}")
    np.testing.assert_array_equal(again.coordinates, cloud.coordinates)
    for name in cloud.fields:
        np.testing.assert_array_equal(again.fields[name], cloud.fields[name], err_msg=name)
    np.testing.assert_array_equal(again.fields["labels"], seg.labels)


def test_read_clouds_can_be_sent_to_another_process(scanned):
    cloud = pickle.loads(pickle.dumps(read_cloud(scanned())))
    assert cloud.header["las"].scales.tolist() == [0.001, 0.001, 0.01]


def test_colour_finds_a_point_format_that_has_it(tmp_path, scanned):
    cloud = read_cloud(scanned(point_format=1))
    color = np.arange(150, dtype=np.uint8).reshape(50, 3)
    write_cloud(tmp_path / "b.las", replace(cloud, fields={**cloud.fields, "color": color}))
    after = laspy.read(tmp_path / "b.las")
    assert after.header.point_format.id == 3
    np.testing.assert_array_equal(after.red, color[:, 0].astype(np.uint16) * 257)
    assert read_cloud(tmp_path / "b.las").fields["color"].dtype == np.uint8


def test_values_that_a_standard_dimension_cannot_hold_get_their_own(tmp_path):
    fields = {
        "intensity": np.array([0.25, 0.5, np.nan], np.float32),
        "classification": np.array([0, 300, 2]),
        "user_data": np.array([0.0, 255.0, 7.0]),
        "gps_time": np.array([0.1, 0.2, 0.3]),
    }
    write_cloud(tmp_path / "a.las", Cloud(np.eye(3), fields))
    names = set(laspy.read(tmp_path / "a.las").point_format.extra_dimension_names)
    assert names == {"intensity_value", "classification_value"}
    found = read_cloud(tmp_path / "a.las").fields
    assert found.keys() == fields.keys()
    for name, values in fields.items():
        np.testing.assert_array_equal(found[name], values)


@pytest.fixture
def described(tmp_path):
    """A file whose extra dimensions say all that LAS can say of them."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [0.001] * 3
    params = [
        ("Pulse width", "f4", "of the echo", {}),
        ("Range", "u2", "in meters", {"offsets": [5.0], "scales": [0.01]}),
        ("vector", "3i2", "", {}),
        ("Beam", "2i4", "angles", {"offsets": [0.0, 1.0], "scales": [0.5, 0.25]}),
        ("label", "u1", "ground truth", {}),
        ("NormalX", "f4", "of the scanner", {}),
        ("NormalY", "f4", "", {}),
        ("NormalZ", "f4", "", {}),
        ("Deviation", "i4", "fit", {"no_data": [-9999]}),
        ("intensity_value", "f8", "calibrated", {}),
    ]
    for name, kind, description, more in params:
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind, description, **more))
    data, rng = laspy.LasData(header), np.random.default_rng(0)
    data.x, data.y, data.z = rng.random((3, 50))
    data["Pulse width"] = rng.random(50)
    data["Pulse width"][3] = np.nan
    data.Range, data.label = 5 + rng.integers(0, 900, 50) / 100, rng.integers(200, 256, 50)
    data.vector, data.Beam = rng.integers(-9, 9, (50, 3)), rng.integers(-9, 9, (50, 2)) / 4
    data.NormalX, data.Deviation = np.ones(50), rng.integers(-9999, 5, 50)
    data["intensity_value"] = rng.random(50)
    data.write(tmp_path / "described.las")
    return tmp_path / "described.las"


def descriptions(path):
    """Return what a file says of each extra dimension, and its numbers as they are stored."""
    data = laspy.read(path)
    return {
        dim.name: (dim.type_str(), dim.description, *map(str, dim[6:]), data.points.array[dim.name])
        for dim in data.point_format.extra_dimensions
    }


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_extra_dimensions_stay_as_they_are_described(tmp_path, described, kind):
    cloud = read_cloud(described)
    assert cloud.fields["Range"].dtype == np.float64
    assert cloud.fields["vector"].shape == (50, 3)
    write_cloud(tmp_path / f"whole.{kind}", cloud)
    before, after = descriptions(described), descriptions(tmp_path / f"whole.{kind}")
    assert before.keys() == after.keys()
    for name, (*words, numbers) in before.items():
        assert list(after[name][:-1]) == words, name
        np.testing.assert_array_equal(after[name][-1], numbers, err_msg=name)


def test_extra_dimensions_that_give_way_to_a_result_take_their_description_along(
    tmp_path, described, make_segmentation
):
    seg = make_segmentation(50)
    write_cloud(tmp_path / "a.las", read_cloud(described), seg)
    write_cloud(tmp_path / "b.las", read_cloud(tmp_path / "a.las"), seg)
    write_cloud(tmp_path / "c.las", read_cloud(tmp_path / "b.las"), seg)
    before = descriptions(described)
    for name in ("a.las", "b.las", "c.las"):
        after = descriptions(tmp_path / name)
        assert after["label_input"][:2] == ("u1", "ground truth")
        assert after["label"][:2] == ("i4", "")
        assert after["normals_input_0"][:2] == ("f4", "of the scanner")
        assert after["NormalX"][1] == ""
        np.testing.assert_array_equal(after["label_input"][-1], before["label"][-1])
        np.testing.assert_array_equal(after["label"][-1], seg.labels)
        np.testing.assert_array_equal(after["NormalX"][-1], seg.normals[:, 0])
        more = after.keys() - before.keys() - {"Curvature", "curvature_input", "label_input"}
        assert more == {f"normals_input_{i}" for i in range(3)}
    assert (tmp_path / "b.las").read_bytes() == (tmp_path / "c.las").read_bytes()


def test_values_that_their_dimension_does_not_hold_have_one_of_their_own(tmp_path, described):
    cloud = read_cloud(described)
    fields = dict(cloud.fields)
    fields["Range"] = fields["Range"] + 0.001
    fields["Deviation"] = fields["Deviation"] + 0.5
    fields["vector"] = fields["vector"].astype(np.int64) + 40_000
    write_cloud(tmp_path / "a.las", replace(cloud, fields=fields))
    found = read_cloud(tmp_path / "a.las").fields
    for name, values in fields.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    write_cloud(tmp_path / "b.las", replace(cloud, fields={"Range": cloud.fields["Range"]}))
    assert list(descriptions(tmp_path / "b.las")) == ["Range"]


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e3, 1e9])
def test_grid_follows_the_size_of_the_cloud(tmp_path, scale):
    coordinates = np.random.default_rng(0).random((100, 3)) * scale
    write_cloud(tmp_path / "a.las", Cloud(coordinates))
    found = read_cloud(tmp_path / "a.las").coordinates
    assert np.abs(found - coordinates).max() <= scale * 2**-31 * 10


def test_a_cloud_of_one_place_is_written(tmp_path):
    write_cloud(tmp_path / "a.laz", Cloud(np.full((5, 3), 7.25)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.laz").coordinates, np.full((5, 3), 7.25))


def test_points_that_are_not_finite_are_refused_before_the_work(tmp_path):
    cloud = Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0]]))
    message = (
        r"a\.las: expected finite coordinates for LAS, got 1 non-finite points \(first: 1\); wr"
    )
    with pytest.raises(FormatError, match=message):
        check_output(tmp_path / "a.las", cloud)
    with pytest.raises(FormatError, match=message):
        write_cloud(tmp_path / "a.las", cloud)
    # A code for no data would take the grid of all others.
    with pytest.raises(FormatError, match="got 1 non-finite points"):
        write_cloud(tmp_path / "a.las", Cloud(np.array([[0.0, 0, 0], [1e30, 0, 0]])))


def test_points_off_the_grid_are_refused(tmp_path, scanned):
    cloud = read_cloud(scanned())
    far = replace(cloud, coordinates=cloud.coordinates + 1e9)
    with pytest.raises(FormatError, match=r"b\.las: cannot be written: Values given do not fit"):
        write_cloud(tmp_path / "b.las", far)


@pytest.mark.parametrize("name", ["n" * 33, "X"])
def test_names_that_have_no_place_are_refused(tmp_path, name):
    with pytest.raises(FormatError, match="expected names of at most 32 bytes, not X, Y, Z"):
        write_cloud(tmp_path / "a.las", Cloud(np.eye(3), {name: np.zeros(3)}))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("place", "layout", "value", "message"),
    [
        (247, "<Q", 10**12, r"byte \d+: expected .* for 1,000,000,000,000 points, got"),
        (247, "<Q", 0, "expected at least one point, got none"),
        (100, "<I", 2**32 - 1, "byte 100: expected 231,928,233,930 bytes for header records"),
        (243, "<I", 2**32 - 1, r"byte \d+: expected [\d,]+ bytes for 4,294,967,295 extended"),
        (96, "<I", 2**31, r"byte 96: expected 2,147,483,648 bytes for the data before its points"),
        (104, "<B", 63, "expected a LAS or LAZ file, got: "),
    ],
)
def test_promises_of_the_header_are_checked(scanned, suffix, place, layout, value, message):
    path = scanned(7, "1.4", suffix)
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, place, value)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"scan\{suffix}: {message}"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("table", 2**32 - 1, r"byte \d+: expected at least [\d,]+ bytes for 4,294,967,295 chunks"),
        ("offset", 2**31, r"byte 2147483648: expected 8 bytes for the table of chunks, got -"),
        ("offset", -2, r"byte \d+: expected the offset of the table of chunks"),
        ("layer", 2**32 - 1, r"byte \d+: expected [\d,]+ bytes for the layers of a chunk, got"),
    ],
)
def test_promises_of_compressed_chunks_are_checked(scanned, place, value, message):
    path = scanned(7, "1.4", ".laz")
    with laspy.open(path) as reader:
        start, size = reader.header.offset_to_point_data, reader.header.point_format.size
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<q", data, start)
    if place == "offset":
        struct.pack_into("<q", data, start, value)
    else:
        struct.pack_into("<I", data, {"table": table + 4, "layer": start + 12 + size}[place], value)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"scan\.laz: {message}"):
        read_cloud(path)


def put_in_record(path, place, layout, value):
    """Change LASzip's record in a file."""
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, data.index(b"laszip encoded") - 2 + 54 + place, value)
    path.write_bytes(data)


@pytest.mark.parametrize("chunk_size", [50_000, 0, 2**32 - 1])
def test_points_compressed_without_chunks_are_read(scanned, chunk_size):
    # LASzip's first compressor has no table of chunks, and no one asks for their size.
    path = scanned(3, "1.2", ".laz")
    expected = read_cloud(path)
    data = path.read_bytes()
    start, _ = struct.unpack_from("<II", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    path.write_bytes(data[:start] + data[start + 8 : table])
    put_in_record(path, 0, "<H", 1)
    put_in_record(path, 12, "<I", chunk_size)
    found = read_cloud(path)
    np.testing.assert_array_equal(found.coordinates, expected.coordinates)
    for name, values in expected.fields.items():
        np.testing.assert_array_equal(found.fields[name], values)


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (38, 4, "compression version 3 or below, got 4; convert it to .las with LASzip or PDAL"),
        (36, 29, r"compressed points of \d+ bytes, got \d+; convert it"),
        (32, 0, r"compressed points of \d+ bytes, got 0; convert it"),
    ],
)
def test_compression_that_lazrs_does_not_know_is_refused(scanned, place, value, message):
    path = scanned(7, "1.4", ".laz")
    put_in_record(path, place, "<H", value)
    with pytest.raises(FormatError, match=rf"scan\.laz: expected (LAZ )?{message}"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((131, scale) for scale in (0.0, np.nan, np.inf, 1e300, 5e-324, 1e-310, 1e-25)),
        *((171, offset) for offset in (np.nan, -np.inf, 1e300, 1e13)),
    ],
)
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_grids_on_which_points_have_no_places_are_refused(scanned, suffix, place, value):
    path = scanned(suffix=suffix)
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, place, value)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"expected a scale and offset of x, y, z that keep val"):
        read_cloud(path)


@pytest.mark.parametrize("value", [0.0, np.nan, 1e300])
def test_scales_of_extra_dimensions_are_checked(described, value):
    data = bytearray(described.read_bytes())
    struct.pack_into("<d", data, data.index(b"Range".ljust(32, b"\0")) + 108, value)
    described.write_bytes(data)
    with pytest.raises(FormatError, match="expected a scale and offset of Range that keep values"):
        read_cloud(described)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ([(131, "<d", 0.01)], "its points lie up to 8.9. outside the box in its header; check"),
        ([(131, "<d", -0.001)], "its points lie up to .* outside the box in its header; check"),
        ([(155, "<d", 7.0), (163, "<d", 5e5)], "its points lie up to .* outside the box in its"),
        ([(219, "<d", np.nan)], None),
        ([(place, "<d", 0.0) for place in range(179, 227, 8)], None),
        ([(place, "<I", 0) for place in range(111, 131, 4)], None),  # many programs count none
        ([(111, "<I", 99)], r"its header counts 50 points, but \d+ returns"),
    ],
)
def test_headers_that_contradict_the_points_are_told(scanned, suffix, changes, note):
    path = scanned(suffix=suffix)
    assert read_cloud(path).notes == ()
    data = bytearray(path.read_bytes())
    for place, layout, value in changes:
        struct.pack_into(layout, data, place, value)
    path.write_bytes(data)
    notes = read_cloud(path).notes
    assert len(notes) == (note is not None)
    assert note is None or re.match(note, notes[0])


def test_points_that_the_header_does_not_count_are_told(scanned):
    path = scanned()
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 107, 48)
    path.write_bytes(data)
    cloud = read_cloud(path)
    assert len(cloud) == 48
    size = cloud.header["las"].point_format.size
    assert cloud.notes == (
        "its header counts 48 points, but 50 returns",
        f"{2 * size} bytes after its last point are ignored, beyond its header's count",
    )
    path = scanned(7, "1.4", ".laz")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, 48)
    path.write_bytes(data)
    with pytest.raises(FormatError, match="expected 48 points by its header, got 50 in its"):
        read_cloud(path)


def test_bytes_that_no_record_describes_are_told(scanned):
    path = scanned()
    data = bytearray(path.read_bytes())
    struct.pack_into("<H", data, data.index(b"LASF_Spec") + 16, 7)
    path.write_bytes(data)
    cloud = read_cloud(path)
    assert "Range" not in cloud.fields
    assert cloud.notes == (
        "bytes that its header does not describe are read as ExtraBytes: 18 of each point",
    )


def test_table_of_chunks_may_be_named_at_the_end(scanned):
    path = scanned(7, "1.4", ".laz")
    expected = read_cloud(path).coordinates
    with laspy.open(path) as reader:
        start = reader.header.offset_to_point_data
    data = bytearray(path.read_bytes())
    data += data[start : start + 8]
    struct.pack_into("<q", data, start, -1)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_cloud(path).coordinates, expected)


def test_dimension_that_one_point_uses_is_a_field_of_all(tmp_path):
    data = laspy.create(point_format=7, file_version="1.4")
    data.x = data.y = data.z = np.arange(60)
    data.user_data[-1] = 5
    data.blue[3] = 514
    for kind in (".las", ".laz"):
        data.write(tmp_path / f"a{kind}")
        fields = read_cloud(tmp_path / f"a{kind}").fields
        assert {"user_data", "color"} == fields.keys()
        assert fields["user_data"].tolist() == [0] * 59 + [5]


@pytest.mark.parametrize("kind", [".las", ".laz"])
def test_parts_of_any_size_are_the_same_cloud(tmp_path, scanned, assert_same, monkeypatch, kind):
    cloud = read_cloud(scanned(7, "1.4", kind))
    write_cloud(tmp_path / f"a{kind}", cloud)
    monkeypatch.setattr(las, "_POINTS_PER_CHUNK", 7)
    assert_same(read_cloud(scanned(7, "1.4", kind)), cloud)
    write_cloud(tmp_path / f"b{kind}", cloud)
    assert (tmp_path / f"a{kind}").read_bytes() == (tmp_path / f"b{kind}").read_bytes()


def write_copc(path, monkeypatch):
    """Write what COPC adds to LAZ: chunks of any size, the octree's records, no order of points."""
    lazrs = pytest.importorskip("lazrs")
    from laspy._compression import lazrsbackend

    def with_any_chunks(*arguments):
        return lazrs.LazVlr.new_for_compression(*arguments, use_variable_size_chunks=True)

    variable = SimpleNamespace(new_for_compression=with_any_chunks)
    packer = SimpleNamespace(**{**vars(lazrs), "LazVlr": variable})
    monkeypatch.setattr(lazrsbackend, "lazrs", packer)
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = [0.001] * 3
    header.vlrs.append(laspy.VLR("copc", 1, "", bytes(160)))
    records = laspy.vlrs.vlrlist.VLRList([laspy.VLR("copc", 1000, "", bytes(32))])
    rng = np.random.default_rng(0)
    with laspy.open(
        path, "w", header=header, do_compress=True, laz_backend=laspy.LazBackend.Lazrs
    ) as writer:
        for count in (5, 1, 40, 14):
            points = laspy.ScaleAwarePointRecord.zeros(count, header=header)
            points.x, points.y, points.z = rng.random((3, count))
            points.red[:] = 257
            writer.write_points(points)
            writer.point_writer.compressor.finish_current_chunk()
        writer.write_evlrs(records)
    monkeypatch.undo()


@pytest.mark.parametrize("kind", [".las", ".laz"])
def test_copc_is_read_and_written_as_what_laspy_can(tmp_path, monkeypatch, kind):
    path = tmp_path / "a.copc.laz"
    write_copc(path, monkeypatch)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.coordinates, laspy.read(path).xyz)
    assert list(cloud.fields) == ["color"]
    write_cloud(tmp_path / f"b{kind}", cloud)
    np.testing.assert_array_equal(read_cloud(tmp_path / f"b{kind}").coordinates, cloud.coordinates)


def test_layers_are_checked_where_lazrs_reads_them(tmp_path, monkeypatch):
    path = tmp_path / "a.copc.laz"
    write_copc(path, monkeypatch)
    with laspy.open(path) as reader:
        first = reader.header.offset_to_point_data + 8
        sizes = first + reader.header.point_format.size + 4
    data = bytearray(path.read_bytes())
    (layer,) = struct.unpack_from("<I", data, sizes)
    # The next chunk is then read one byte too early, where its layers seem to be of gigabytes.
    struct.pack_into("<I", data, sizes, layer - 1)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"byte \d+: expected [\d,]+ bytes for the layers of a c"):
        read_cloud(path)


def test_panic_of_the_decoder_is_a_format_error(scanned, monkeypatch):
    class PanicException(BaseException):
        pass

    def panic(*_, **__):
        raise PanicException("index out of bounds")

    path = scanned()
    monkeypatch.setattr(laspy, "open", panic)
    with pytest.raises(FormatError, match="cannot decompress: index out of b"):
        read_cloud(path)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(laspy, "open", interrupt)
    with pytest.raises(KeyboardInterrupt):
        read_cloud(path)


def test_missing_package_is_named(tmp_path, monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(torchrg._optional.importlib, "import_module", absent)
    (tmp_path / "a.las").write_bytes(b"LASF")
    with pytest.raises(MissingDependencyError, match=r"laspy is needed to read LAS and LAZ files"):
        read_cloud(tmp_path / "a.las")
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[las\]'"):
        check_output(tmp_path / "a.laz")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_a_new_file_does_not_name_the_day_on_which_it_was_written(tmp_path, suffix):
    path = tmp_path / f"new{suffix}"
    write_cloud(path, Cloud(np.random.default_rng(0).random((9, 3))))
    assert path.read_bytes()[90:94] == bytes(4)


def test_extended_records_come_out_again(tmp_path, scanned):
    source, copy = scanned(7, "1.4"), tmp_path / "copy.las"
    data = laspy.read(source)
    data.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("own", 7, "a note", b"content")])
    data.write(source)
    write_cloud(copy, read_cloud(source))
    (record,) = laspy.read(copy).evlrs
    assert (record.user_id, record.record_id, record.record_data_bytes()) == ("own", 7, b"content")
