"""Chunks put one after the other are what reading the whole file gives."""

import random
from types import SimpleNamespace

import numpy as np
import pytest

from torchrg.errors import ConfigError, FormatError
from torchrg.io import FORMATS, read_cloud, stream_cloud, write_cloud
from torchrg.io.stream import CloudStream
from torchrg.structures import Cloud

NUM_POINTS = 60
CHUNK_SIZES = [1, 7, 1000]


def needs(suffix):
    pytest.importorskip({".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy"))


def assert_streams_as_read(path, chunk_sizes=CHUNK_SIZES):
    """Check the stream of a file against the whole, bit for bit, and return the cloud."""
    whole = read_cloud(path)
    for size in chunk_sizes:
        stream = stream_cloud(path, chunk_size=size)
        chunks = list(stream)
        assert max(map(len, chunks)) <= size
        assert min(map(len, chunks)) > 0
        assert stream.num_points in (len(whole), None)
        assert stream.grid_shape == whole.grid_shape
        assert all(chunk.source == whole.source for chunk in chunks)
        for chunk in chunks:
            assert chunk.coordinates.dtype == whole.coordinates.dtype
            assert {n: (v.dtype, v.shape[1:]) for n, v in chunk.fields.items()} == {
                n: (v.dtype, v.shape[1:]) for n, v in whole.fields.items()
            }
            assert list(chunk.fields) == list(whole.fields)
            assert chunk.header.keys() == whole.header.keys()
        joined = np.concatenate([chunk.coordinates for chunk in chunks])
        assert joined.tobytes() == whole.coordinates.tobytes()
        for name, values in whole.fields.items():
            joined = np.concatenate([chunk.fields[name] for chunk in chunks])
            assert joined.tobytes() == values.tobytes(), (name, size)
    return whole


@pytest.mark.parametrize("kind", list(FORMATS))
@pytest.mark.parametrize("number", ["f4", "f8"])
def test_chunks_join_to_the_cloud(tmp_path, make_cloud, kind, number):
    needs(kind)
    write_cloud(tmp_path / f"a{kind}", make_cloud(dtype=number))
    assert_streams_as_read(tmp_path / f"a{kind}")


@pytest.mark.parametrize("kind", [".npy", ".xyz"])
@pytest.mark.parametrize("at", [0, NUM_POINTS - 1])
@pytest.mark.parametrize(
    ("row", "fields"),
    [
        ([0.0, 0.6, 0.8, 1.0], ["normals", "column_7"]),
        ([0.0, 0.6, 0.8, 1.5], ["normals", "column_7"]),
        ([0.5, 0.0, 0.6, 0.8], ["normals", "column_4"]),
        ([256.0, 2.0, 3.0, 1.0], ["color", "intensity"]),
        ([0.0, 2.0, 3.0, 256.0], ["color", "column_7"]),
        ([0.0, 2.0, 3.0, 1.0], ["column_4", "column_5", "column_6", "column_7"]),
        ([0.0, 0.5, 0.5, 1.0], ["column_4", "column_5", "column_6", "column_7"]),
        ([np.nan, 0.0, 1.0, 0.5], ["normals", "column_7"]),
    ],
)
def test_one_row_decides_the_names_of_all(tmp_path, kind, at, row, fields):
    # Unit vectors that are whole numbers, too: normals or colours, as the other row says.
    table = np.zeros((NUM_POINTS, 7))
    table[:, :3] = np.random.default_rng(0).random((NUM_POINTS, 3))
    table[np.arange(NUM_POINTS), 3 + np.arange(NUM_POINTS) % 3] = 1.0
    table[at, 3:] = row
    path = tmp_path / f"a{kind}"
    np.save(path, table) if kind == ".npy" else np.savetxt(path, table)
    whole = assert_streams_as_read(path)
    assert list(whole.fields) == fields


@pytest.mark.parametrize(
    ("code", "value", "last", "depth", "kept"),
    [
        ("f4", 0.5, 1.0, np.uint8, 128),
        ("f4", 0.5, 2.0, np.uint8, 0),
        ("u2", 514, 65535, np.uint8, 2),
        ("u2", 514, 65534, np.uint16, 514),
        ("u2", 200, 65535, np.uint16, 200),
        ("i4", 200, 255, np.uint8, 200),
        ("f8", 0.5, np.nan, np.uint8, 128),
    ],
)
def test_one_colour_decides_the_depth_of_all(tmp_path, code, value, last, depth, kept):
    color = np.full((NUM_POINTS, 3), value).astype(code)
    color[-1] = last
    np.savez(tmp_path / "a.npz", points=np.zeros((NUM_POINTS, 3)), color=color)
    whole = assert_streams_as_read(tmp_path / "a.npz")
    assert whole.fields["color"].dtype == depth
    assert whole.fields["color"][0, 0] == kept


def test_colours_out_of_range_are_the_same_error(tmp_path):
    color = np.zeros((NUM_POINTS, 3), np.float32)
    color[3], color[40] = -2, 300
    np.savez(tmp_path / "a.npz", points=np.zeros((NUM_POINTS, 3)), color=color)
    for read in (read_cloud, lambda path: next(iter(stream_cloud(path, chunk_size=7)))):
        with pytest.raises(FormatError, match=r"expected color in 0\.\.255, got -2\.0 to 300\.0"):
            read(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["labels", "normals", "color"])
def test_fields_of_a_wrong_shape_are_the_same_error(tmp_path, name):
    np.savez(tmp_path / "a.npz", points=np.zeros((60, 3)), **{name: np.zeros((60, 2), complex)})
    for read in (read_cloud, lambda path: list(stream_cloud(path, chunk_size=7))):
        with pytest.raises(FormatError, match=r"got shape \(N, 2\) of complex128"):
            read(tmp_path / "a.npz")


def test_las_dimension_that_one_point_uses_is_a_field_of_all(tmp_path):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    data = laspy.create(point_format=7, file_version="1.4")
    data.x = data.y = data.z = np.arange(NUM_POINTS)
    data.user_data[-1] = 5
    data.blue[3] = 514
    for kind in (".las", ".laz"):
        data.write(tmp_path / f"a{kind}")
        whole = assert_streams_as_read(tmp_path / f"a{kind}")
        assert {"user_data", "color"} == whole.fields.keys()


def write_copc(path, monkeypatch):
    """Write what COPC adds to LAZ: chunks of any size, the octree's records, no order of points."""
    laspy, lazrs = pytest.importorskip("laspy"), pytest.importorskip("lazrs")
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
        for count in (5, 1, 40, NUM_POINTS - 46):
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
    whole = assert_streams_as_read(path)
    np.testing.assert_array_equal(whole.coordinates, pytest.importorskip("laspy").read(path).xyz)
    assert list(whole.fields) == ["color"]
    write_cloud(tmp_path / f"b{kind}", stream_cloud(path, chunk_size=7))
    np.testing.assert_array_equal(read_cloud(tmp_path / f"b{kind}").coordinates, whole.coordinates)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_in_columns_and_arrays_left_out(tmp_path, save):
    rng = np.random.default_rng(0)
    points = np.asfortranarray(rng.random((NUM_POINTS, 3)))
    wave = np.asfortranarray(rng.random((NUM_POINTS, 2, 4)))
    path = tmp_path / "a.npz"
    save(path, plane_area=np.ones(3), points=points, wave=wave, tag=np.full(NUM_POINTS, "ä"))
    whole = assert_streams_as_read(path)
    np.testing.assert_array_equal(whole.coordinates, points)
    np.testing.assert_array_equal(whole.fields["wave"], wave)


@pytest.mark.parametrize("name", ["plane_area", "points"])
def test_checksums_count_for_arrays_left_out_and_for_those_in_columns(tmp_path, name):
    # Longer than what is read together with their headers.
    points = np.asfortranarray(np.random.default_rng(0).random((2000, 3)))
    arrays = {"points": points, "plane_area": np.arange(1.0, 2000.0)}
    np.savez(tmp_path / "a.npz", **arrays)
    data, found = (tmp_path / "a.npz").read_bytes(), arrays[name].T.tobytes()[-8:]
    (tmp_path / "a.npz").write_bytes(data.replace(found, bytes(8)))
    for read in (read_cloud, lambda path: list(stream_cloud(path, chunk_size=700))):
        with pytest.raises(FormatError, match=rf"a\.npz: '{name}\.npy': Bad CRC-32"):
            read(tmp_path / "a.npz")


def test_npy_arrays_of_any_order_and_names(tmp_path):
    table = np.random.default_rng(0).random((NUM_POINTS, 9))
    np.save(tmp_path / "a.npy", np.asfortranarray(table))
    assert_streams_as_read(tmp_path / "a.npy")
    dtype = [("x", "f4"), ("y", ">f8"), ("z", "i2"), ("高さ", "u1")]
    records = np.zeros((NUM_POINTS // 2, 2), dtype)
    records["x"] = np.arange(NUM_POINTS).reshape(-1, 2)
    with pytest.warns(UserWarning, match="3.0"):
        np.save(tmp_path / "b.npy", records)
    whole = assert_streams_as_read(tmp_path / "b.npy", [2, 8, 1000])
    assert list(whole.fields) == ["高さ"]


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_organised_pcd(tmp_path, encoding):
    records = np.zeros(6, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "<u4")])
    records["x"], records["rgba"] = np.arange(6), np.arange(6) * 0x01020304
    header = "FIELDS x y z rgba\nSIZE 4 4 4 4\nTYPE F F F U\nWIDTH 3\nHEIGHT 2\n"
    header += f"VIEWPOINT 1 2 3 1 0 0 0\nDATA {encoding}\n"
    text = "".join(f"{x} {y} {z} {c}\n" for x, y, z, c in records.tolist()).encode()
    data = text if encoding == "ascii" else records.tobytes()
    (tmp_path / "a.pcd").write_bytes(header.encode() + data)
    assert assert_streams_as_read(tmp_path / "a.pcd").grid_shape == (2, 3)


def test_compressed_pcd(tmp_path):
    lzf = pytest.importorskip("lzf")
    full = np.random.default_rng(0).integers(0, 2, (3, 50)).astype("<f4").tobytes()
    packed = lzf.compress(full)
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 50\nHEIGHT 1\nDATA binary_compressed\n"
    sizes = np.array([len(packed), len(full)], "<u4").tobytes()
    (tmp_path / "a.pcd").write_bytes(header.encode() + sizes + packed)
    assert_streams_as_read(tmp_path / "a.pcd")


PLY_HEADER = """ply
format {} 1.0
element camera 2
property list uchar int q
element vertex 5
property float x
property double y
property short z
property list uchar ushort w
end_header
"""


def test_ply_with_lists_before_and_in_the_vertices(tmp_path):
    cameras = np.array([(2, (1, 2))] * 2, [("n", "u1"), ("q", "<i4", 2)])
    vertices = np.zeros(5, [("x", "<f4"), ("y", "<f8"), ("z", "<i2"), ("n", "u1"), ("w", "<u2", 3)])
    vertices["x"], vertices["n"], vertices["w"] = np.arange(5), 3, np.arange(15).reshape(5, 3)
    header = PLY_HEADER.format("binary_little_endian").encode()
    path = tmp_path / "a.ply"
    path.write_bytes(header + cameras.tobytes() + vertices.tobytes() + b"rest")
    assert_streams_as_read(path, [1, 2, 1000])
    vertices["n"][4] = 2
    path.write_bytes(header + cameras.tobytes() + vertices.tobytes())
    chunks = iter(stream_cloud(path, chunk_size=2))
    assert [len(next(chunks)), len(next(chunks))] == [2, 2]
    with pytest.raises(FormatError, match="expected lists of one length in element vertex"):
        next(chunks)


def test_text_between_blank_lines_and_comments(tmp_path):
    lines = ["// x y z label", "3", "0 0 0 1", "", "# a", "# b", "1 0 0 2", "", "1 2 3 4 # end", ""]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    whole = assert_streams_as_read(tmp_path / "a.txt", [1, 2, 1000])
    assert whole.fields["labels"].tolist() == [1, 2, 4]
    (tmp_path / "a.txt").write_text("\n".join([*lines, "1 2 x"]))
    chunks = iter(stream_cloud(tmp_path / "a.txt", chunk_size=1))
    assert len([next(chunks) for _ in range(3)]) == 3
    with pytest.raises(FormatError, match=r"a\.txt: line 11: expected 4 numbers, got '1 2 x'"):
        next(chunks)


def test_scans_of_an_e57_file_with_poses_and_fields_of_their_own(tmp_path):
    pytest.importorskip("pye57")
    from torchrg.io.e57 import ScanPose

    rng = np.random.default_rng(0)
    turned = ScanPose("b", (0.9, 0.1, -0.3, 0.2), (500_000.0, 2.0, 3.0))
    cloud = Cloud(
        rng.random((NUM_POINTS, 3)),
        {
            "scan": np.repeat(np.arange(2, dtype=np.int32), [20, NUM_POINTS - 20]),
            "normals": rng.random((NUM_POINTS, 3)).astype("f4"),
        },
        header={"scans": (ScanPose("a"), turned)},
    )
    cloud.coordinates[30] = np.nan
    write_cloud(tmp_path / "a.e57", cloud)
    whole = assert_streams_as_read(tmp_path / "a.e57", [1, 7, 20, 1000])
    assert [scan.name for scan in whole.header["scans"]] == ["a", "b"]
    # A chunk never holds points of two scans.
    assert [len(chunk) for chunk in stream_cloud(tmp_path / "a.e57", chunk_size=15)] == [
        15,
        5,
        15,
        15,
        10,
    ]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", list(FORMATS))
def test_damaged_files_stream_as_they_read(tmp_path, make_cloud, suffix):
    needs(suffix)
    write_cloud(tmp_path / f"whole{suffix}", make_cloud(30))
    data = (tmp_path / f"whole{suffix}").read_bytes()
    rng, path, refused = random.Random(suffix), tmp_path / f"damaged{suffix}", 0
    for number in range(40):
        damaged = bytearray(data)
        place = rng.randrange(min(len(data), rng.choice([200, 1500, 10**9])))
        if number % 3 == 0:
            del damaged[place:]
        else:
            damaged[place] = rng.randrange(256)
        path.write_bytes(damaged)
        whole = outcome(read_cloud, path)
        streamed = outcome(lambda path: list(stream_cloud(path, chunk_size=7)), path)
        if isinstance(whole, Cloud):
            joined = np.concatenate([chunk.coordinates for chunk in streamed])
            np.testing.assert_array_equal(joined, whole.coordinates)
        else:
            assert streamed == whole
            refused += 1
    assert refused > 0


def outcome(read, path):
    """Return what was read, or the message of the error."""
    try:
        return read(path)
    except FormatError as error:
        return str(error)


@pytest.mark.parametrize("suffix", [*FORMATS, ".stl"])
def test_missing_and_empty_files_are_refused_at_once(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with pytest.raises(FormatError, match=r"a\.\w+: no such file"):
        stream_cloud(path)
    path.touch()
    with pytest.raises(FormatError, match=r"a\.\w+: byte 0: the file is empty"):
        stream_cloud(path)
    with pytest.raises(ConfigError, match="expected chunk_size of at least 1, got 0"):
        stream_cloud(path, chunk_size=0)


def test_files_without_points_are_refused(tmp_path):
    header = "ply\nformat {} 1.0\nelement vertex 0\nproperty float x\nproperty float y\n"
    for encoding in ("ascii", "binary_big_endian"):
        text = f"{header.format(encoding)}property float z\nend_header\n"
        (tmp_path / "a.ply").write_text(text)
        for read in (read_cloud, lambda path: list(stream_cloud(path))):
            with pytest.raises(FormatError, match=r"a\.ply: expected at least one point, got none"):
                read(tmp_path / "a.ply")


def test_file_that_vanishes_while_it_is_read_is_one_line(tmp_path, make_cloud):
    write_cloud(tmp_path / "a.ply", make_cloud())
    stream = stream_cloud(tmp_path / "a.ply")
    (tmp_path / "a.ply").unlink()
    with pytest.raises(FormatError, match=r"a\.ply: cannot be read: No such file or directory\."):
        list(stream)


def test_silence_about_overflow_ends_with_the_chunk(tmp_path, make_cloud):
    write_cloud(tmp_path / "a.ply", make_cloud())
    before = np.geterr()
    chunks = iter(stream_cloud(tmp_path / "a.ply", chunk_size=7))
    next(chunks)
    assert np.geterr() == before


@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_extent_and_origin_are_those_of_the_whole(make_cloud, shift):
    cloud = make_cloud(dtype="f8", origin=(shift, 0, 0))
    cloud.coordinates[5] = [np.inf, 0, 0]
    stream = CloudStream.of(cloud, chunk_size=7)
    assert stream.origin.tolist() == cloud.origin.tolist()
    assert stream.extent.num_points == NUM_POINTS
    assert stream.extent.num_finite == NUM_POINTS - 1
    points = np.concatenate([chunk.about(stream.origin) for chunk in stream])
    np.testing.assert_array_equal(points, cloud.points)


def test_cloud_without_finite_points_has_its_origin_at_zero():
    stream = CloudStream.of(Cloud(np.full((3, 3), np.nan)), chunk_size=2)
    assert stream.origin.tolist() == [0, 0, 0]
    assert stream.extent.num_finite == 0
