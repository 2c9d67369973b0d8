"""PLY files of other programs, whole and broken."""

import struct

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import ply, read_cloud, write_cloud
from torchrg.structures import Cloud

POINTS = [(1.5, -2.0, 3.0), (4.0, 5.25, -6.0), (float("nan"), 0.0, 1e30)]
HEADER = """ply
format {order} 1.0
comment made by hand
element vertex 3
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property short label
end_header
"""
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def save(path, header, body=b"", newline="\n"):
    path.write_bytes(header.replace("\n", newline).encode() + body)
    return path


def binary_body(order):
    return b"".join(struct.pack(order + "fffBBBh", *p, 255, 128, 7, -1) for p in POINTS)


def text_body():
    return "".join(f"{x} {y} {z} 255 128 7 -1\n" for x, y, z in POINTS).encode()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("order", ["ascii", *ORDERS])
def test_every_encoding_gives_the_same_cloud(tmp_path, order, newline):
    body = text_body() if order == "ascii" else binary_body(ORDERS[order])
    cloud = read_cloud(save(tmp_path / "a.ply", HEADER.format(order=order), body, newline))
    np.testing.assert_array_equal(cloud.coordinates, np.array(POINTS, np.float32))
    assert cloud.coordinates.dtype == np.float32
    assert cloud.fields["color"].tolist() == [[255, 128, 7]] * 3
    assert cloud.fields["color"].dtype == np.uint8
    assert cloud.fields["labels"].tolist() == [-1, -1, -1]
    assert all(values.dtype.isnative for values in cloud.fields.values())


@pytest.mark.parametrize(
    ("properties", "values", "name", "expected"),
    [
        ("float nx\nproperty float ny\nproperty float nz", "fff", "normals", [[0.0, 0.0, 1.0]]),
        (
            "uchar diffuse_red\nproperty uchar diffuse_green\nproperty uchar diffuse_blue",
            "BBB",
            "color",
            [[0, 0, 1]],
        ),
        ("float red\nproperty float green\nproperty float blue", "fff", "color", [[0, 0, 255]]),
        ("float scalar_Label\nproperty char a\nproperty char b", "fbb", "labels", [0]),
        ("float scalar_Curvature\nproperty char a\nproperty char b", "fbb", "curvature", [0.0]),
        ("double scalar_mine\nproperty char a\nproperty char b", "dbb", "mine", [0.0]),
        ("char f_0\nproperty char f_1\nproperty char f_2", "bbb", "f", [[0, 0, 1]]),
        ("uint64 label\nproperty int64 a\nproperty uint8 b", "QqB", "labels", [0]),
    ],
)
def test_names_of_other_programs_are_known(tmp_path, properties, values, name, expected):
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty double x\n"
        f"property double y\nproperty double z\nproperty {properties}\nend_header\n"
    )
    body = struct.pack("<ddd" + values, 1, 2, 3, 0, 0, 1)
    cloud = read_cloud(save(tmp_path / "a.ply", header, body))
    assert cloud.fields[name].tolist() == expected
    assert cloud.coordinates.dtype == np.float64


@pytest.mark.parametrize("order", ["ascii", *ORDERS])
def test_other_elements_before_and_after_are_passed_over(tmp_path, order):
    header = HEADER.format(order=order).replace(
        "element vertex",
        "obj_info x\nelement camera 1\nproperty double f\nelement strip 2\n"
        "property list uchar int i\nelement empty 4\nelement vertex",
    )
    header = header.replace(
        "end_header", "element face 2\nproperty list uchar int vertex_indices\nend_header"
    )
    if order == "ascii":
        body = b"1.5\n2 0 1\n2 1 2\n" + text_body() + b"3 0 1 2\n3 0 2 1\n"
    else:
        mark = ORDERS[order]
        strips = struct.pack(mark + "dBiiBii", 1.5, 2, 0, 1, 2, 1, 2)
        body = strips + binary_body(mark)
        body += struct.pack(mark + "BiiiBiii", 3, 0, 1, 2, 3, 0, 2, 1)
    cloud = read_cloud(save(tmp_path / "a.ply", header, body))
    np.testing.assert_array_equal(cloud.coordinates, np.array(POINTS, np.float32))
    assert set(cloud.fields) == {"color", "labels"}
    reported = "1 of camera, 2 of strip"
    assert cloud.notes == (f"elements skipped (only vertices and faces are read): {reported}",)


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_names_are_read_in_the_letters_they_were_written_in(tmp_path, kind):
    fields = {"höhe_à": np.arange(3.0), "高さ": np.ones(3)}
    write_cloud(tmp_path / f"a.{kind}", Cloud(np.eye(3), fields))
    assert list(read_cloud(tmp_path / f"a.{kind}").fields) == list(fields)
    data = (tmp_path / f"a.{kind}").read_bytes()
    (tmp_path / f"b.{kind}").write_bytes(
        data.replace("höhe_à".encode(), "höhe_à".encode("latin-1")).replace("高さ".encode(), b"h")
    )
    assert list(read_cloud(tmp_path / f"b.{kind}").fields) == ["höhe_à", "h"]


def write_lists(path, order, lists, place, *, code="d", length="I"):
    """Three points with a list before, between or after their coordinates."""
    words = {"I": "uint", "b": "char", "Q": "uint64", "d": "double", "h": "short"}
    axes = [f"property float {axis}" for axis in "xyz"]
    axes.insert(place, f"property list {words[length]} {words[code]} spectrum")
    head = f"ply\nformat {order} 1.0\nelement vertex {len(lists)}\n"
    head = "\n".join([head + axes[0], *axes[1:], "end_header\n"])
    body = b""
    for point, values in zip(POINTS, lists, strict=True):
        row, form = [*point], ["f"] * 3
        row[place:place] = [len(values), *values]
        form[place:place] = [length, code * len(values)]
        if order == "ascii":
            body += (" ".join(map(str, row)) + "\n").encode()
        else:
            body += struct.pack(ORDERS[order] + "".join(form), *row)
    return save(path, head, body)


@pytest.mark.parametrize("order", ["ascii", *ORDERS])
@pytest.mark.parametrize("place", [0, 1, 3])
@pytest.mark.parametrize("length", ["I", "b", "Q"])
@pytest.mark.parametrize("lists", [[(1, 2), (3, 4), (5, 6)], [(1, 2), (3,), ()], [(), (1,), ()]])
def test_lists_of_vertices_have_any_length_and_place(tmp_path, order, place, length, lists):
    cloud = read_cloud(write_lists(tmp_path / "a.ply", order, lists, place, length=length))
    np.testing.assert_array_equal(cloud.coordinates, np.array(POINTS, np.float32))
    if len(lists[1]) == 2:
        assert cloud.fields["spectrum"].tolist() == [[1, 2], [3, 4], [5, 6]]
        assert cloud.fields["spectrum"].dtype == np.float64
        assert cloud.notes == ()
    else:
        assert cloud.fields == {}
        left = "lists left out, as they are empty or differ in length: spectrum"
        assert cloud.notes == (left,)


@pytest.mark.parametrize("order", ["ascii", *ORDERS])
def test_lists_longer_than_a_block_are_read(tmp_path, order, monkeypatch):
    monkeypatch.setattr(ply, "_BYTES_PER_READ", 64)
    lists = [range(1000), range(3), range(1000)]
    cloud = read_cloud(write_lists(tmp_path / "a.ply", order, lists, 1, code="h"))
    np.testing.assert_array_equal(cloud.coordinates, np.array(POINTS, np.float32))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("lists", [[(1, 2)] * 3, [(1, 2), (3,), (4, 5, 6)]])
def test_lists_that_the_file_cannot_hold_are_damage_or_a_cut(tmp_path, order, lists):
    whole = write_lists(tmp_path / "a.ply", order, lists, 3, length="b").read_bytes()
    start = whole.index(b"end_header\n") + 11
    (tmp_path / "a.ply").write_bytes(whole[:-1])
    message = r"a\.ply: byte \d+: expected 1 more records of vertex, got \d+ bytes of an incompl"
    with pytest.raises(FormatError, match=message):
        read_cloud(tmp_path / "a.ply")
    for length in (-1, 127):
        damaged = bytearray(whole)
        struct.pack_into("b", damaged, start + 12, length)
        (tmp_path / "a.ply").write_bytes(damaged)
        with pytest.raises(FormatError, match=r"expected 3 more records .*; the file is truncated"):
            read_cloud(tmp_path / "a.ply")


@pytest.mark.parametrize("word", ["1", "3", "-2", "2.5", "nan", "1e300", "five"])
def test_lists_of_text_fill_their_lines(tmp_path, word):
    path = write_lists(tmp_path / "a.ply", "ascii", [(1, 2), (3, 4), (5, 6)], 0)
    path.write_bytes(path.read_bytes().replace(b"\n2 3 4", f"\n\n{word} 3 4".encode()))
    with pytest.raises(FormatError, match=r"a\.ply: line 11: expected a record of vertex, got '"):
        read_cloud(path)


def test_numbers_beside_lists_of_text_have_the_types_of_their_properties(tmp_path):
    path = write_lists(tmp_path / "a.ply", "ascii", [(1, 2), (3,), ()], 3, code="h")
    for number in ("2.5", "40000", "nan"):
        path.write_bytes(path.read_bytes().replace(b"2 1 2", f"2 1 {number}".encode()))
        with pytest.raises(FormatError, match="expected spectrum to be numbers of type short"):
            read_cloud(path)


@pytest.mark.parametrize("order", ["ascii", *ORDERS])
def test_records_that_the_header_does_not_count_are_told(tmp_path, order):
    body = text_body() if order == "ascii" else binary_body(ORDERS[order])
    header = HEADER.format(order=order).replace("vertex 3", "vertex 2")
    path = save(tmp_path / "a.ply", header, body)
    if order == "ascii":
        cloud = read_cloud(path)
        assert len(cloud) == 2
        rest = len(text_body().splitlines()[2]) + 1
        assert cloud.notes == (
            f"{rest} bytes after its last point are ignored, beyond its header's count",
        )
    else:
        # pyntcloud calls columns of float64 "float".
        with pytest.raises(FormatError, match=r"expected the end of the file.* 17 more bytes"):
            read_cloud(path)
        short = HEADER.format(order=order)
        np.testing.assert_array_equal(
            read_cloud(save(path, short, body + bytes(4000))).coordinates,
            np.array(POINTS, np.float32),
        )


def test_truth_values_of_pyntcloud_are_read(tmp_path):
    header = HEADER.format(order="binary_little_endian").replace("uchar red", "bool red")
    fields = read_cloud(save(tmp_path / "a.ply", header, binary_body("<"))).fields
    assert fields["color"].tolist() == [[255, 128, 7]] * 3


@pytest.mark.parametrize("order", ["ascii", *ORDERS])
@pytest.mark.parametrize("count", [4, 10**12, 10**17])
def test_promised_points_are_compared_with_the_file(tmp_path, order, count):
    body = text_body() if order == "ascii" else binary_body(ORDERS[order])
    header = HEADER.format(order=order).replace("vertex 3", f"vertex {count}")
    with pytest.raises(FormatError, match=r"a\.ply: (byte|line) \d+: expected .* got [\d,]+; the"):
        read_cloud(save(tmp_path / "a.ply", header, body))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ply\n", "plx\n"), "line 1: expected 'ply', got 'plx'"),
        (
            ("end_header", "end-header"),
            "line 12: expected a PLY header, got 'end-header'",
        ),
        (
            ("format {order} 1.0\n", ""),
            "line 11: expected a PLY header, got 'end_header'",
        ),
        (("{order}", "binary_middle_endian"), "line 2: expected a PLY header"),
        (("vertex 3", "vertex -3"), "line 4: expected a PLY header"),
        (("vertex 3", "vertex 1e3"), "line 4: expected a PLY header"),
        (("float y", "quad y"), "line 6: expected a PLY header, got 'property quad y'"),
        (("float y", "float x"), "line 6: expected one 'x', got two; rename one"),
        (("float y", "list float int y"), "line 6: expected a PLY header"),
        (("vertex 3", "point 3"), "expected an element vertex with properties, got elements point"),
        (("float y", "float why"), "expected fields x, y, z, got 'x', 'why', 'z', 'red'"),
        (("vertex 3", "vertex 0"), "expected at least one point, got none"),
        (("float z", "list uchar float z"), "line 13: expected a record of vertex, got '1.5 -2.0"),
        (("uchar red", "list float uchar red"), "line 8: expected a PLY header"),
    ],
)
def test_broken_headers_name_the_line(tmp_path, change, message):
    header = HEADER.replace(*change).format(order="ascii")
    with pytest.raises(FormatError, match=rf"a\.ply: {message}"):
        read_cloud(save(tmp_path / "a.ply", header, text_body()))


def test_header_without_end_is_cut_off(tmp_path):
    header = HEADER.format(order="ascii").replace("end_header\n", "")
    with pytest.raises(FormatError, match=r"line 12: expected the header to end with 'end_header'"):
        read_cloud(save(tmp_path / "a.ply", header))
    with pytest.raises(FormatError, match=r"line 1: expected the header to end with 'end_header'"):
        read_cloud(save(tmp_path / "a.ply", "ply"))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"4 five -6 1 2 3 0", r"line 13: expected 7 numbers, got '4 five -6 1 2 3 0'; correct"),
        (b"4 5 -6 1 2 3", "line 13: expected 7 numbers, got '4 5 -6 1 2 3'"),
        (b"4 5 -6 1 2 3 4 5", "line 13: expected 7 numbers"),
        (b"4 5 -6 1 2 256 4", "line 13: expected 7 numbers, got '4 5 -6 1 2 256 4'"),
        (b"4 5 -6 1 2 0.5 4", "line 13: expected 7 numbers"),
        (b"", "line 16: expected 3 rows of numbers, got 2"),
        (b"4" * 100, "line 13: expected 7 numbers, got '4444.*4...'; correct or delete"),
    ],
)
def test_broken_lines_are_named(tmp_path, line, message):
    lines = text_body().splitlines()
    lines[0] = line
    body = b"\n".join(lines) + b"\n"
    with pytest.raises(FormatError, match=rf"a\.ply: {message}"):
        read_cloud(save(tmp_path / "a.ply", HEADER.format(order="ascii"), body))
