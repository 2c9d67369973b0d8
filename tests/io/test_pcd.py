"""PCD files of other programs, whole and broken."""

import re
import struct

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.structures import Cloud

lzf = pytest.importorskip("lzf")

HEADER = """# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS x y z rgb _ hist label
SIZE 4 4 4 4 1 2 4
TYPE F F F F U I U
COUNT 1 1 1 1 3 2 1
WIDTH 3
HEIGHT 2
VIEWPOINT 1 2 3 0 1 0 0
POINTS 6
DATA {encoding}
"""
PACKED = struct.unpack("<f", bytes([7, 128, 255, 0]))[0]
POINTS = [(i, -2.5 * i, 0.1 * i, PACKED, 100 + i, -i, i) for i in range(6)]


def body(encoding, *, with_padding=False):
    if encoding == "ascii":
        lines = (f"{p[0]} {p[1]}  {p[2]}\t{p[3]:.9g} 0 0 0 {p[4]} {p[5]} {p[6]}" for p in POINTS)
        return "\n".join(lines).encode()
    if encoding == "binary":
        return b"".join(struct.pack("<ffff3xhhI", *p) for p in POINTS)
    columns = [np.array([p[i] for p in POINTS], "<f4") for i in range(4)]
    padding = [np.zeros((6, 3), np.uint8)] if with_padding else []
    columns += padding
    columns += [np.array([p[4:6] for p in POINTS], "<i2"), np.array([p[6] for p in POINTS], "<u4")]
    full = b"".join(column.tobytes() for column in columns)
    packed = lzf.compress(full)
    return struct.pack("<II", len(packed), len(full)) + packed


def save(path, header, data=b"", newline="\n"):
    path.write_bytes(header.replace("\n", newline).encode() + data)
    return path


def check(cloud):
    expected = np.array([p[:3] for p in POINTS], np.float32)
    np.testing.assert_array_equal(cloud.coordinates, expected)
    assert cloud.fields["color"].tolist() == [[255, 128, 7]] * 6
    assert cloud.fields["labels"].tolist() == list(range(6))
    assert cloud.fields["hist"].tolist() == [[100 + i, -i] for i in range(6)]
    assert cloud.fields.keys() == {"color", "labels", "hist"}
    assert cloud.grid_shape == (2, 3)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_gives_the_same_cloud(tmp_path, encoding, newline):
    check(
        read_cloud(
            save(tmp_path / "a.pcd", HEADER.format(encoding=encoding), body(encoding), newline)
        )
    )


def test_compressed_padding_may_be_there(tmp_path):
    data = body("binary_compressed", with_padding=True)
    check(read_cloud(save(tmp_path / "a.pcd", HEADER.format(encoding="binary_compressed"), data)))


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_fields_of_no_values_are_left_out(tmp_path, encoding):
    # Drivers of lidars, and PCL with their clouds, write padding of COUNT 0.
    header = HEADER.replace("hist label", "hist label _ none", 1).replace("2 4\n", "2 4 1 8\n", 1)
    header = header.replace("I U\n", "I U U F\n", 1).replace("2 1\n", "2 1 0 0\n", 1)
    check(read_cloud(save(tmp_path / "a.pcd", header.format(encoding=encoding), body(encoding))))


@pytest.mark.parametrize("points", ["POINTS 2\n", "WIDTH 2\n", "WIDTH 2\nHEIGHT 1\nPOINTS 2\n"])
@pytest.mark.parametrize("columns", ["COLUMNS x y z\n", "FIELDS x y z\nTYPE F F F\n"])
def test_headers_of_earlier_versions_are_read(tmp_path, points, columns):
    header = f"# .PCD v.5\nVERSION .5\n{columns}{points}DATA "
    cloud = read_cloud(save(tmp_path / "a.pcd", f"{header}ascii\n", b"1 2 3\n4 5 6\n"))
    assert cloud.coordinates.tolist() == [[1, 2, 3], [4, 5, 6]]
    data = struct.pack("<6f", *range(1, 7))
    again = read_cloud(save(tmp_path / "a.pcd", f"{header}binary\n", data))
    np.testing.assert_array_equal(again.coordinates, cloud.coordinates)
    assert again.coordinates.dtype == np.float32


def test_truth_values_of_pcl_are_read(tmp_path):
    header = "FIELDS x y z on\nSIZE 4 4 4 1\nTYPE F F F B\nWIDTH 2\nHEIGHT 1\nDATA binary\n"
    data = struct.pack("<fffBfffB", 1, 2, 3, 1, 4, 5, 6, 0)
    assert read_cloud(save(tmp_path / "a.pcd", header, data)).fields["on"].tolist() == [1, 0]


@pytest.mark.parametrize(
    ("viewpoint", "is_kept"),
    [
        ("1 2 3 0.5 0.5 0.5 0.5", True),
        ("0 0 0 5e-324 0 0 0", True),
        ("0 0 0 0 0 0 0", False),
        ("nan 0 0 1 0 0 0", False),
        ("0 0 0 1 nan 0 0", False),
        ("0 0 0 inf 0 0 0", False),
        ("0 1e13 0 1 0 0 0", False),
    ],
)
def test_viewpoints_that_are_none_are_left_out(tmp_path, viewpoint, is_kept):
    header = HEADER.replace("1 2 3 0 1 0 0", viewpoint).format(encoding="binary")
    cloud = read_cloud(save(tmp_path / "a.pcd", header, body("binary")))
    check(cloud)
    expected = tuple(map(float, viewpoint.split())) if is_kept else (0, 0, 0, 1, 0, 0, 0)
    assert cloud.header["viewpoint"] == expected
    left = "its VIEWPOINT is ignored, because it is not a position and a rotation"
    assert cloud.notes == (() if is_kept else (left,))


def test_points_that_the_header_does_not_count_are_told(tmp_path):
    fewer = HEADER.replace("WIDTH 3", "WIDTH 2").replace("POINTS 6", "POINTS 4")
    path = save(tmp_path / "a.pcd", fewer.format(encoding="binary"), body("binary"))
    with pytest.raises(FormatError, match=r"byte \d+: expected the end of .* 54 more bytes"):
        read_cloud(path)
    text = read_cloud(save(tmp_path / "a.pcd", fewer.format(encoding="ascii"), body("ascii")))
    assert len(text) == 4
    (note,) = text.notes
    assert note.endswith("bytes after its last point are ignored, beyond its header's count")
    # PCL fills files up to a page.
    whole = HEADER.format(encoding="binary")
    check(read_cloud(save(tmp_path / "a.pcd", whole, body("binary") + bytes(3900))))


def test_header_lines_may_be_absent_or_swapped(tmp_path):
    header = "FIELDS x y z\nTYPE F F F\nSIZE 4 4 4\nWIDTH 2\nFOO bar\n\nDATA ascii\n"
    cloud = read_cloud(save(tmp_path / "a.pcd", header, b"1 2 3\n\n4 5 nan\n"))
    np.testing.assert_array_equal(cloud.coordinates, [[1, 2, 3], [4, 5, np.nan]])
    assert cloud.grid_shape is None
    header = header.replace("FIELDS", "COLUMNS")
    assert len(read_cloud(save(tmp_path / "a.pcd", header, b"1 2 3\n4 5 6\n"))) == 2


def test_grid_and_viewpoint_come_out_as_they_went_in(tmp_path):
    write_cloud(
        tmp_path / "b.pcd",
        read_cloud(save(tmp_path / "a.pcd", HEADER.format(encoding="binary"), body("binary"))),
    )
    header = (tmp_path / "b.pcd").read_bytes().split(b"DATA")[0].decode()
    assert "WIDTH 3\nHEIGHT 2\nVIEWPOINT 1 2 3 0 1 0 0\nPOINTS 6\n" in header
    assert "COUNT 1 1 1 1 2 1\n" in header
    again = read_cloud(tmp_path / "b.pcd")
    check(again)
    assert again.header["viewpoint"] == (1, 2, 3, 0, 1, 0, 0)


def test_a_grid_that_does_not_fit_is_refused(tmp_path):
    with pytest.raises(FormatError, match=r"expected a grid of 4 points, got 2 rows of 3"):
        write_cloud(tmp_path / "a.pcd", Cloud(np.zeros((4, 3)), grid_shape=(2, 3)))


@pytest.mark.parametrize("kind", ["F", "U", "I"])
def test_packed_colours_have_any_type_and_an_alpha(tmp_path, kind):
    header = (
        "FIELDS x y z rgba\nSIZE 4 4 4 4\n"
        f"TYPE F F F {kind}\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA binary\n"
    )
    data = struct.pack("<fff4B", 1, 2, 3, 7, 128, 255, 9)
    cloud = read_cloud(save(tmp_path / "a.pcd", header, data))
    assert cloud.fields["color"].tolist() == [[255, 128, 7]]
    assert cloud.fields["alpha"].tolist() == [9]


def test_normals_are_written_in_the_type_of_the_coordinates(tmp_path):
    normals = np.array([[0, 0, 1]], np.float32)
    write_cloud(tmp_path / "a.pcd", Cloud(np.zeros((1, 3)), {"normals": normals}))
    assert read_cloud(tmp_path / "a.pcd").fields["normals"].dtype == np.float64
    write_cloud(tmp_path / "a.pcd", Cloud(np.zeros((1, 3), "f4"), {"normals": normals}))
    assert read_cloud(tmp_path / "a.pcd").fields["normals"].dtype == np.float32


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("count", [7, 10**12])
def test_promised_points_are_compared_with_the_file(tmp_path, encoding, count):
    header = HEADER.format(encoding=encoding).replace("POINTS 6", f"POINTS {count}")
    header = header.replace("WIDTH 3\nHEIGHT 2", f"WIDTH {count}\nHEIGHT 1")
    with pytest.raises(FormatError, match=r"a\.pcd: (byte|line) \d+: expected .*; (the|fetch)"):
        read_cloud(save(tmp_path / "a.pcd", header, body(encoding)))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((10**6, 174), r"expected 1,000,000 bytes for a block of 6 points, got \d+"),
        ((None, 175), r"expected 144 bytes for 6 points from a block of \d+, got 175"),
        ((1, 144), r"expected 144 bytes for 6 points from a block of 1, got 144"),
        ((60, 144), "expected a block that decompresses to 144 bytes; the file is corrupt"),
    ],
)
def test_compressed_block_with_wrong_sizes_is_refused(tmp_path, sizes, message):
    data = body("binary_compressed")
    packed, full = sizes
    data = struct.pack("<II", packed or len(data) - 8, full) + data[8:]
    header = HEADER.format(encoding="binary_compressed")
    with pytest.raises(FormatError, match=rf"a\.pcd: byte \d+: {message}"):
        read_cloud(save(tmp_path / "a.pcd", header, data))


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        ("FIELDS.*", "FIELDS x y w rgb _ hist label", "expected fields x, y, z, got 'x', 'y', 'w'"),
        (
            "FIELDS.*",
            "FIELDS x y x rgb _ hist label",
            "line 3: expected FIELDS to be distinct names",
        ),
        ("FIELDS.*\n", "", "expected a header line FIELDS; write the file again"),
        ("SIZE.*", "SIZE 4 4 4", "line 4: expected SIZE to be 7 integers of .*, got '4 4 4'"),
        ("SIZE.*", "SIZE 4 4 4 4 1 2 four", "line 4: expected SIZE to be 7 integers of up"),
        ("SIZE.*", "SIZE 4 4 3 4 1 2 4", "line 5: expected TYPE to be F, I or U of a known SIZE"),
        ("TYPE.*", "TYPE F F F", "line 5: expected TYPE to be 7 letters, got 'F F F'"),
        ("TYPE.*", "TYPE F F Q F U I U", "line 5: expected TYPE to be F, I or U .* for z"),
        ("COUNT.*", "COUNT 0 0 0 0 0 0 0", "line 6: expected COUNT to be above 0 for a field"),
        ("COUNT.*", "COUNT 1 1 1 1 3 9999999 1", "line 6: expected COUNT to be sizes of at most"),
        ("SIZE.*", "SIZE 4 4 4 4 0 2 4", "line 5: expected TYPE to be F, I or U of a known SIZE"),
        ("COUNT.*", "COUNT 1 2 1 1 1 1 1", "expected x, y, z of one number per point"),
        ("WIDTH.*", "WIDTH -3", "line 7: expected WIDTH to be 1 integer of up to 18 digits"),
        (
            "WIDTH.*",
            "WIDTH 1000000000000000000000",
            "line 7: expected WIDTH to be 1 integer of up to 18 digits",
        ),
        ("WIDTH.*\n", "", "expected a header line WIDTH"),
        ("VIEWPOINT.*", "VIEWPOINT 0 0 zero 1 0 0 0", "line 9: expected VIEWPOINT to be 7 numbers"),
        ("POINTS.*", "POINTS 5", r"line 10: expected POINTS to be WIDTH x HEIGHT = 6, got '5'"),
        ("DATA.*", "DATA zipped", "line 11: expected DATA to be one of ascii, binary, binary_c"),
        ("DATA.*\n", "", r"line \d+: expected the header to end with .DATA.; the file is"),
        ("(WIDTH|HEIGHT|POINTS).*", r"\1 0", "expected at least one point, got none"),
    ],
)
def test_broken_headers_name_the_line(tmp_path, pattern, replacement, message):
    header = re.sub(pattern, replacement, HEADER.format(encoding="binary"))
    with pytest.raises(FormatError, match=rf"a\.pcd: {message}"):
        read_cloud(save(tmp_path / "a.pcd", header, body("binary")))


def test_commas_between_numbers_have_another_repair_than_decimal_commas(tmp_path):
    header = "FIELDS x y z\nWIDTH 2\nDATA ascii\n"
    for line, repair in (
        (b"0.5,0,0", "separate all numbers with blanks"),
        (b"0,5 0 0", "write al"),
    ):
        with pytest.raises(FormatError, match=f"line 4: expected 3 numbers, got '.*'; {repair}"):
            read_cloud(save(tmp_path / "a.pcd", header, line + b"\n1 0 0\n"))


def test_broken_lines_are_named(tmp_path):
    lines = body("ascii").splitlines()
    lines[4] = b"1 2 3 oops 0 0 0 1 1 1"
    header = HEADER.format(encoding="ascii")
    message = r"a\.pcd: line 16: expected 10 numbers, got '1 2 3 oops 0 0 0 1 1 1'; correct"
    with pytest.raises(FormatError, match=message):
        read_cloud(save(tmp_path / "a.pcd", header, b"\n".join(lines)))
