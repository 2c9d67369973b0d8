"""Arrays of other programs, whole and broken."""

import io
import pickle
import struct
import zipfile

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import estimate_points, read_cloud, write_cloud
from torchrg.structures import Cloud

POINTS = np.arange(12, dtype=np.float64).reshape(4, 3)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("name", ["points", "coord", "positions"])
def test_archives_of_numpy_are_read(tmp_path, save, name):
    arrays = {
        name: POINTS,
        "normal": np.ones((4, 3), np.float32),
        "segment": np.arange(4, dtype=np.int16)[:, None],
        "labels": np.array([[2], [1], [0], [-1]], np.int16),
        "intrinsics": np.eye(3),
        "scale": np.float64(2),
    }
    save(tmp_path / "a.npz", **arrays)
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.coordinates, POINTS)
    assert cloud.fields.keys() == {"normals", "segment", "labels"}
    assert cloud.fields["labels"].tolist() == [2, 1, 0, -1]
    assert cloud.fields["labels"].dtype == np.int64


def test_fortran_order_and_foreign_bytes_are_read(tmp_path):
    np.save(tmp_path / "a.npy", np.asfortranarray(POINTS.astype(">f4")))
    cloud = read_cloud(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.coordinates, POINTS)
    assert cloud.coordinates.flags.c_contiguous
    assert cloud.coordinates.dtype == np.dtype("=f4")


def test_arrays_that_are_no_points_are_refused(tmp_path):
    pose = np.array([[1.0, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    wrong = {
        "a.npy": (pose, "expected points, got a 4 x 4 pose matrix"),
        "b.npy": (POINTS.T.repeat(9, axis=1), "got 3 rows of 36 numbers; transpose them"),
    }
    for name, (values, message) in wrong.items():
        np.save(tmp_path / name, values)
        with pytest.raises(FormatError, match=rf"{name}: .*{message}"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize("names", ["xyz", "nx ny nz", "r g b"])
@pytest.mark.parametrize("code", ["M8[s]", "S3", "U3", "c16"])
def test_columns_of_several_kinds_are_one_line(tmp_path, names, code):
    # A damaged header makes one number of three a date, or text.
    types = dict.fromkeys("xyz", "f8") | dict.fromkeys(
        names.split() if " " in names else "xyz", "f8"
    )
    types[list(types)[-1]] = code
    np.save(tmp_path / "a.npy", np.zeros(4, list(types.items())))
    with pytest.raises(FormatError, match=r"a\.npy: expected ") as caught:
        read_cloud(tmp_path / "a.npy")
    assert len(str(caught.value).replace(str(tmp_path), "")) < 160


def test_arrays_that_are_left_out_are_told(tmp_path):
    more = {"scale": np.ones(2), "name": np.array("hall"), "plane_id": np.arange(4)}
    ours = {"plane_area": np.ones(4), "outline_points": np.ones((4, 3)), "provenance": np.array("")}
    np.savez(tmp_path / "a.npz", points=POINTS, **more, **ours)
    cloud = read_cloud(tmp_path / "a.npz")
    assert cloud.notes == ("scale, name skipped: not 4 rows",)
    assert list(cloud.fields) == ["plane_id"]
    with pytest.raises(FormatError, match="a field cannot be named 'plane_area'"):
        write_cloud(tmp_path / "b.npz", Cloud(POINTS, {"plane_area": np.ones(4)}))


def test_structured_arrays_are_read_by_name(tmp_path):
    values = np.zeros(4, [("X", "f4"), ("Y", "f4"), ("Z", "f8"), ("label", "u1"), ("d", "f4", 2)])
    values["Z"] = 1e6 + 0.125
    np.save(tmp_path / "a.npy", values)
    cloud = read_cloud(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.coordinates[:, 2], values["Z"])
    assert {name: v.shape for name, v in cloud.fields.items()} == {"labels": (4,), "d": (4, 2)}


class Bomb:
    """Fails if it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


def test_archives_of_records_and_of_an_array_for_each_axis_are_read(tmp_path):
    records = np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("label", "i4")])
    records["x"], records["y"], records["z"] = POINTS.T
    records["label"] = range(4)
    # pyntcloud keeps its mesh next to the points.
    np.savez_compressed(tmp_path / "a.npz", points=records, mesh=np.zeros(2, [("v1", "i4")]))
    np.savez(tmp_path / "b.npz", **{name: records[name] for name in records.dtype.names})
    np.save(tmp_path / "c.npy", records)
    expected = read_cloud(tmp_path / "c.npy")
    np.testing.assert_array_equal(expected.coordinates, POINTS)
    for name in ("a.npz", "b.npz"):
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.coordinates, expected.coordinates)
        assert {key: values.tolist() for key, values in cloud.fields.items()} == {
            key: values.tolist() for key, values in expected.fields.items()
        }
        assert estimate_points(tmp_path / name) == 4
    np.savez(tmp_path / "d.npz", points=records[["x", "y"]])
    with pytest.raises(FormatError, match=r"d\.npz: expected fields x, y, z, got 'x', 'y'"):
        read_cloud(tmp_path / "d.npz")


@pytest.mark.parametrize("change", [(b"(4, 3)", b"(3, 3)"), (b"<f8", b"<f4"), (b"4, 3", b"2, 3")])
def test_headers_of_fewer_bytes_than_there_are_are_refused(tmp_path, change):
    np.save(tmp_path / "a.npy", POINTS)
    content = (tmp_path / "a.npy").read_bytes().replace(*change)
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.npy", content)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(FormatError, match=r"expected \d+ bytes for .*, got 96; correct the sh"):
            read_cloud(tmp_path / name)


def test_pickles_are_never_loaded(tmp_path):
    bomb = np.array([Bomb()] * 4, dtype=object)
    message = "contains pickled Python objects, which are not loaded for .*; convert them"
    np.save(tmp_path / "a.npy", bomb, allow_pickle=True)
    with pytest.raises(FormatError, match=rf"a\.npy: the array {message}"):
        read_cloud(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", allow_pickle=True, points=POINTS, meta=bomb)
    with pytest.raises(FormatError, match=rf"a\.npz: 'meta\.npy' {message}"):
        read_cloud(tmp_path / "a.npz")
    for kind in (".npy", ".npz"):
        (tmp_path / f"b{kind}").write_bytes(pickle.dumps(Bomb()))
        with pytest.raises(FormatError, match=rf"b\{kind}: .*expected"):
            read_cloud(tmp_path / f"b{kind}")


def array_bytes(shape, descr="'<f8'", data=b""):
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (array_bytes((10**12, 3)), r"byte \d+: expected 24,000,000,000,000 bytes for the array of"),
        (array_bytes((4, 3), data=b"0" * 95), r"byte \d+: expected 96 bytes .*, got 95; the file"),
        (array_bytes((-4, 3)), r"byte 0: wrong shape or type in the array: \(-4, 3\)"),
        (array_bytes((-4, -3), data=b"0" * 96), "byte 0: wrong shape or type in the array"),
        (array_bytes((4, 3), "'|V0'", b"0"), "byte 0: wrong shape or type in the array"),
        (array_bytes((4, 2), data=b"0" * 64), r"expected shape \(N, 3\) or wider, got"),
        (array_bytes((), data=b"0" * 8), r"expected shape \(N, 3\) or wider, got \(\)"),
        (array_bytes((0, 3)), "expected at least one point, got none"),
        (array_bytes((4, 3), "'|O'", b"0" * 96), "the array contains pickled Python objects"),
        (array_bytes((4, 3), "'<q9'"), "byte 0: expected the header of a NumPy array"),
        (array_bytes("(4, 3", data=b"0" * 96), "byte 0: expected the header of a NumPy array"),
        (array_bytes("('a', 3)", data=b"0" * 96), "byte 0: expected the header of a NumPy array"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{", "byte 0: expected the header of a NumPy array"),
        (b"\x93NUMPY\x09\x00", "byte 0: expected the header of a NumPy array"),
        (b"\x93NUM", "byte 0: expected the header of a NumPy array"),
    ],
)
def test_broken_arrays_are_refused(tmp_path, content, message):
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(FormatError, match=rf"a\.npy: {message}"):
        read_cloud(tmp_path / "a.npy")
    if "shape (N" not in message and "wider" not in message:
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("points.npy", content)
        with pytest.raises(FormatError, match=r"a\.npz: "):
            read_cloud(tmp_path / "a.npz")


def test_sizes_in_archives_are_compared_with_the_bytes(tmp_path):
    stored = io.BytesIO()
    with zipfile.ZipFile(stored, "w") as archive:
        archive.writestr("points.npy", array_bytes((10**9, 3), data=b"0" * 96))
    data = bytearray(stored.getvalue())
    place = data.index(b"PK\x01\x02")
    # What the directory says about the size of the member, whole and packed.
    for size in (24, 20):
        struct.pack_into("<I", data, place + size, 2**32 - 2)
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(FormatError, match=r"a\.npz: byte 0: expected 4,294,967,294 bytes for"):
            read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_in_columns_are_read(tmp_path, save):
    rng = np.random.default_rng(0)
    points = np.asfortranarray(rng.random((60, 3)))
    wave = np.asfortranarray(rng.random((60, 2, 4)))
    save(tmp_path / "a.npz", plane_area=np.ones(3), points=points, wave=wave, tag=["ä"] * 60)
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.coordinates, points)
    np.testing.assert_array_equal(cloud.fields["wave"], wave)
    assert cloud.fields["tag"].tolist() == ["ä"] * 60


@pytest.mark.parametrize("name", ["plane_area", "points"])
def test_checksums_count_for_arrays_left_out_and_for_those_in_columns(tmp_path, name):
    # Longer than what is read together with their headers.
    points = np.asfortranarray(np.random.default_rng(0).random((2000, 3)))
    arrays = {"points": points, "plane_area": np.arange(1.0, 2000.0)}
    np.savez(tmp_path / "a.npz", **arrays)
    data, found = (tmp_path / "a.npz").read_bytes(), arrays[name].T.tobytes()[-8:]
    (tmp_path / "a.npz").write_bytes(data.replace(found, bytes(8)))
    with pytest.raises(FormatError, match=rf"a\.npz: '{name}\.npy': Bad CRC-32"):
        read_cloud(tmp_path / "a.npz")


def test_records_of_any_shape_and_names_are_read(tmp_path):
    dtype = [("x", "f4"), ("y", ">f8"), ("z", "i2"), ("高さ", "u1")]
    records = np.zeros((30, 2), dtype)
    records["x"] = np.arange(60).reshape(-1, 2)
    with pytest.warns(UserWarning, match="3.0"):
        np.save(tmp_path / "b.npy", records)
    cloud = read_cloud(tmp_path / "b.npy")
    assert list(cloud.fields) == ["高さ"]
    assert cloud.coordinates[:, 0].tolist() == list(range(60))


@pytest.mark.parametrize("num_points", [1, 60, 1000])
def test_arrays_are_as_numpy_writes_them(tmp_path, num_points):
    points = np.random.default_rng(0).random((num_points, 3))
    write_cloud(tmp_path / "a.npz", Cloud(points, {"tag": np.full(num_points, "ä")}))
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        for name, values in (("points", points), ("tag", np.full(num_points, "ä"))):
            np.save(tmp_path / "b.npy", values)
            assert archive.read(f"{name}.npy") == (tmp_path / "b.npy").read_bytes()


def test_unusual_compression_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("points.npy", array_bytes((4, 3), data=b"0" * 96))
    with pytest.raises(FormatError, match=r"expected 'points\.npy' stored or deflated, got compr"):
        read_cloud(tmp_path / "a.npz")


def test_what_is_no_archive_or_has_names_that_are_no_text_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK" * 50)
    with pytest.raises(
        FormatError, match=r"a\.npz: expected an archive of NumPy arrays, got: File"
    ):
        read_cloud(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", points=POINTS, extra=POINTS)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    place = data.rindex(b"extra.npy")
    data[place] = 0x93
    # The flag that names are UTF-8, in the directory.
    data[place - 46 + 9] |= 0x08
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(
        FormatError, match=r"a\.npz: expected an archive of NumPy arrays, got: 'utf-8"
    ):
        read_cloud(tmp_path / "a.npz")


def test_plain_array_is_written_without_fields(tmp_path):
    write_cloud(tmp_path / "a.npy", Cloud(POINTS))
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), POINTS)
    write_cloud(tmp_path / "a.npy", Cloud(POINTS, {"labels": np.arange(4)}))
    assert np.load(tmp_path / "a.npy").dtype.names == ("x", "y", "z", "label")


def test_one_array_of_three_columns_is_the_points(tmp_path):
    np.savez(tmp_path / "a.npz", xyz=POINTS, labels=np.arange(4), normals=POINTS)
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.coordinates, POINTS)
    assert list(cloud.fields) == ["labels", "normals"]
    assert cloud.notes == ("xyz is read as the points, as no other array has 3 columns",)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": POINTS.T}, r".* \(N, 3\), got \(3, 4\); transpose them\."),
        ({"points": POINTS.reshape(2, 2, 3)}, r".* of shape \(N, 3\), got \(2, 2, 3\)"),
        ({"x": POINTS, "y": POINTS}, r"expected an array points \(or coord\), got 'x'"),
        ({"pos": POINTS, "xyz": POINTS}, "expected an array points"),
        ({"color": POINTS, "normal": POINTS}, "expected an array points"),
        ({"arr_0": np.diag([500.0, 500, 1])}, ".* got a 3 x 3 camera matrix"),
        ({"arr_0": np.zeros((0, 3))}, "expected an array points"),
    ],
)
def test_other_archives_are_no_clouds(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(FormatError, match=rf"a\.npz: {message}"):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["color", "normal", "Normals", "rgb"])
def test_a_file_named_as_a_field_is_no_cloud(tmp_path, name):
    np.save(tmp_path / f"{name}.npy", POINTS)
    with pytest.raises(FormatError, match=rf"named as the field {name}; pass the folder"):
        read_cloud(tmp_path / f"{name}.npy")
    assert len(read_cloud(tmp_path / f"{name}.npy", columns="xyz")) == len(POINTS)
