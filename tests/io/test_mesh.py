"""Faces of PLY files: the front of each vertex, in every encoding, and of damaged lists none."""

import itertools
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrg.errors import ShapeError
from torchrg.io import mesh, ply, read_cloud, write_cloud
from torchrg.io.merge import merge_clouds
from torchrg.regions.axes import transform_cloud
from torchrg.structures import Cloud

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LETTERS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I"}
LETTERS |= {"float": "f", "double": "d", "int8": "b", "uint16": "H", "int64": "q", "uint64": "Q"}


def make_points(count=30):
    return np.random.default_rng(0).normal(size=(count, 3)).round(3)


def make_faces(count=60, corners=3, num_points=30):
    """Lists of different vertices; the last two points are of no face."""
    rng = np.random.default_rng(1)
    return [rng.choice(num_points - 2, corners, replace=False).tolist() for _ in range(count)]


def fronts_by_loop(points, faces):
    """Sums of the normals of triangles around the first corner of each face."""
    sums = np.zeros((len(points), 3))
    for face in filter(None, faces):
        a = points[face[0]]
        for b, c in itertools.pairwise(face):
            sums[face] += np.cross(points[b] - a, points[c] - a)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.where(lengths > 0, lengths, 1)


def write_mesh(
    path, points, faces, order, *, code="int", length="uchar", name="vertex_indices", extra=()
):
    """A mesh; ``extra`` are properties before and behind the list, lists of two floats or words."""
    head = ["ply", f"format {order} 1.0", f"element vertex {len(points)}"]
    head += [f"property double {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}"]
    before = [word for word in extra if word.startswith("before ")]
    head += [f"property {word.removeprefix('before ')} a{i}" for i, word in enumerate(before)]
    head += [f"property list {length} {code} {name}"]
    behind = [word for word in extra if word not in before]
    head += [f"property {word} b{i}" for i, word in enumerate(behind)]
    lines, data, mark = [], b"", ORDERS[order]
    for point in points.tolist():
        lines.append(" ".join(map(repr, point)))
        data += struct.pack(mark + "ddd", *point)
    for face in faces:
        row, form = [], mark
        for word in [*before, None, *behind]:
            if word is None:
                row += [len(face), *face]
                form += LETTERS[length] + LETTERS[code] * len(face)
            elif "list" in word:
                row += [2, 7, 9]
                form += "Bff"
            else:
                row += [5]
                form += LETTERS[word.removeprefix("before ")]
        lines.append(" ".join(map(str, row)))
        data += struct.pack(form, *row)
    body = ("\n".join(lines) + "\n").encode() if order == "ascii" else data
    path.write_bytes(("\n".join(head) + "\nend_header\n").encode() + body)
    return path


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("corners", "options"),
    [
        (3, {}),
        (4, {"name": "vertex_index", "code": "uint", "length": "int"}),
        (7, {}),
        (2, {"code": "ushort", "length": "ushort"}),
        (3, {"code": "uchar", "extra": ("before uchar", "list uchar float", "float")}),
        (5, {"code": "short", "extra": ("before double", "list uchar float", "int")}),
        (4, {"code": "int64", "length": "char", "extra": ("before list uchar float",)}),
        (4, {"code": "float"}),
    ],
)
def test_fronts_are_the_sums_of_the_normals_of_faces(tmp_path, order, corners, options):
    points, faces = make_points(), make_faces(corners=corners)
    cloud = read_cloud(write_mesh(tmp_path / "a.ply", points, faces, order, **options))
    np.testing.assert_allclose(cloud.front, fronts_by_loop(points, faces), atol=1e-6)
    assert cloud.front.dtype == np.float32
    assert not cloud.front[-2:].any()
    assert cloud.notes == ()
    np.testing.assert_array_equal(cloud.coordinates, points)


@pytest.mark.parametrize("order", ORDERS)
def test_fronts_do_not_depend_on_how_much_is_read_at_a_time(tmp_path, monkeypatch, order):
    points, faces = make_points(), make_faces(500, 5)
    path = write_mesh(tmp_path / "a.ply", points, faces, order)
    monkeypatch.setattr(ply, "_BYTES_PER_READ", 100)
    monkeypatch.setattr(mesh, "_CORNERS_AT_ONCE", 10)
    np.testing.assert_allclose(read_cloud(path).front, fronts_by_loop(points, faces), atol=1e-6)


def test_other_elements_may_stand_between_vertices_and_faces(tmp_path):
    points, faces = make_points(), make_faces()
    for order in ORDERS:
        path = write_mesh(tmp_path / "a.ply", points, faces, order)
        head, _, body = path.read_bytes().partition(b"end_header\n")
        head = head.replace(b"element face", b"element edge 2\nproperty int v\nelement face")
        if order == "ascii":
            lines = body.splitlines(keepends=True)
            body = b"".join([*lines[: len(points)], b"1\n", b"\n", b"2\n", *lines[len(points) :]])
        else:
            at = len(points) * 24
            body = body[:at] + struct.pack(ORDERS[order] + "ii", 1, 2) + body[at:]
        path.write_bytes(head + b"end_header\n" + body)
        cloud = read_cloud(path)
        np.testing.assert_allclose(cloud.front, fronts_by_loop(points, faces), atol=1e-6)
        assert cloud.notes == ("elements skipped (only vertices and faces are read): 2 of edge",)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.replace(b"face 6", b"face 9"),
        lambda data: data.replace(b"face 6", b"face 99999999999999"),
        lambda data: data[:-12],
    ],
    ids=["promise", "huge promise", "cut off"],
)
def test_damaged_lists_are_left_out_with_a_note(tmp_path, order, change):
    path = write_mesh(tmp_path / "a.ply", make_points(), make_faces(6), order)
    path.write_bytes(change(path.read_bytes()))
    cloud = read_cloud(path)
    assert len(cloud) == 30
    assert cloud.front is None
    (note,) = cloud.notes
    assert note.startswith("faces skipped: ")
    assert "expected " in note
    assert str(path) not in note


def put_faces_first(path):
    """Move the element of the faces, and their records, before the vertices."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    start, vertex, face = head.index(b"element"), b"element vertex", b"element face"
    elements = head[head.index(face) :] + head[head.index(vertex) : head.index(face)]
    num_points = int(head[start:].split()[2])
    if b"ascii" in head:
        lines = body.splitlines(keepends=True)
        body = b"".join([*lines[num_points:], *lines[:num_points]])
    else:
        body = body[num_points * 24 :] + body[: num_points * 24]
    path.write_bytes(head[:start] + elements + b"end_header\n" + body)
    return path


MIXED = {
    "one by one": [make_faces(80, 3 + i % 2)[i] for i in range(80)],
    "larger first": [*make_faces(40, 5), *make_faces(40), *make_faces(40, 7)],
    "one that differs": [*make_faces(79), *make_faces(1, 4)],
    "edges and none": [[], *make_faces(20), *make_faces(3, 2), [], *make_faces(20, 6)],
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("kind", MIXED)
@pytest.mark.parametrize("at_once", [50, 500, 1 << 19])
def test_faces_of_several_lengths_keep_their_side(tmp_path, order, kind, at_once, monkeypatch):
    monkeypatch.setattr(ply, "_BYTES_PER_READ", at_once)
    points, faces = make_points(), MIXED[kind]
    extra = ("before short", "list uchar float")
    path = write_mesh(tmp_path / "a.ply", points, faces, order, extra=extra)
    for change in (lambda path: path, put_faces_first):
        cloud = read_cloud(change(path))
        np.testing.assert_allclose(cloud.front, fronts_by_loop(points, faces), atol=1e-6)
        np.testing.assert_array_equal(cloud.coordinates, points)
        assert cloud.notes == ()


def test_numbers_that_end_all_lines_of_faces_are_passed_over(tmp_path):
    points, faces = make_points(), make_faces()
    path = write_mesh(tmp_path / "a.ply", points, faces, "ascii", extra=("float",))
    # MeshLab writes colors of corners as a list, and names four numbers in the header.
    path.write_bytes(path.read_bytes().replace(b" 5\n", b" 9 1 1 1 1 1 1 1 1 1\n"))
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.front, fronts_by_loop(points, faces), atol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("wrong", [30, -1, 2**31 - 1])
def test_a_face_of_a_vertex_that_there_is_not_is_damage(tmp_path, order, wrong):
    faces = make_faces(6)
    faces[3][1] = wrong
    cloud = read_cloud(write_mesh(tmp_path / "a.ply", make_points(), faces, order))
    assert cloud.front is None
    assert cloud.notes == (f"faces skipped: expected vertex indices in [0, 30), got {wrong:,}",)


@pytest.mark.parametrize("order", ORDERS)
def test_a_face_of_more_corners_than_its_mesh_can_have_is_damage(tmp_path, order):
    faces = [*make_faces(6), [0, 1] * 31]
    cloud = read_cloud(write_mesh(tmp_path / "a.ply", make_points(), faces, order))
    assert cloud.front is None
    message = "faces skipped: expected at most 60 corners a face, got 62"
    assert cloud.notes == (message,)


@pytest.mark.parametrize("place", ["first", "last"])
@pytest.mark.parametrize("word", [b"x" * 500, b"nan", b"-3", b"1e300", b"2", b"4"])
def test_words_and_lengths_that_are_none_are_damage(tmp_path, place, word):
    path = write_mesh(tmp_path / "a.ply", make_points(), make_faces(6), "ascii")
    lines = path.read_bytes().splitlines(keepends=True)
    number = -6 if place == "first" else -1
    lines[number] = word + lines[number][1:]
    path.write_bytes(b"".join(lines))
    cloud = read_cloud(path)
    assert cloud.front is None
    (note,) = cloud.notes
    assert note.startswith("faces skipped: ")
    assert len(note) < 170


def test_faces_that_cancel_or_have_no_place_say_nothing():
    points = np.array([[0.1, 0.7, 0.3], [1.3, 0.2, 0], [0.4, 1.9, 0.1], [5, 5, 5], [np.nan, 0, 0]])
    there, back = [[0, 1, 2]], [[2, 1, 0]]
    finite = np.isfinite(points).all(axis=1)

    def fronts(*faces):
        return mesh.find_fronts(map(np.array, faces), points, finite)

    assert fronts(there)[:3].any(axis=1).all()
    assert not fronts(there, back).any()
    # Not exactly each other's opposite, by rounding.
    assert not fronts(there, [[1, 0, 2]]).any()
    np.testing.assert_array_equal(fronts(there, [[0, 1, 4]]), fronts(there))
    assert not fronts([[0, 0, 1]], [[3, 3, 3]]).any()


def test_far_places_small_units_and_float32_give_the_same_fronts():
    points, faces = make_points().astype(np.float64), np.array(make_faces())
    known = np.ones(len(points), bool)
    expected = mesh.find_fronts([faces], points, known)
    for moved in (points * 1e-12, points * 1e9, points + 5e6, points.astype(np.float32)):
        found = mesh.find_fronts([faces], moved, known)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_fronts_stay_with_their_points_and_are_not_written(tmp_path):
    points, faces = make_points(), make_faces()
    cloud = read_cloud(write_mesh(tmp_path / "a.ply", points, faces, "ascii"))
    write_cloud(tmp_path / "b.ply", cloud)
    again = read_cloud(tmp_path / "b.ply")
    assert again.front is None
    assert again.fields.keys() == set()
    merged = merge_clouds([cloud, replace(cloud, front=None)])
    np.testing.assert_array_equal(merged.front, np.concatenate([cloud.front, 0 * cloud.front]))
    quarter = torch.tensor([[0.0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()
    x, y, z = cloud.front.T
    np.testing.assert_array_equal(
        transform_cloud(cloud, quarter).front, np.stack([-y, x, z], axis=1)
    )


def test_a_front_of_another_shape_is_refused():
    with pytest.raises(ShapeError, match=r"Cloud: expected front of shape \(3, 3\), got \(2, 3\)"):
        Cloud(np.eye(3), front=np.zeros((2, 3), np.float32))
