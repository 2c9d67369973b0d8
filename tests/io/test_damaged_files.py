"""Whatever happens to a file, reading it gives a cloud or one line that names it."""

import random
import re
import struct
from unittest.mock import Mock

import numpy as np
import pytest

from tests.io.conftest import needs
from tests.io.e57_pages import join_e57, split_e57
from torchrg.errors import FormatError
from torchrg.io import FORMATS, read_cloud, write_cloud
from torchrg.io.text import count_text
from torchrg.structures import Cloud

WORDS = [b"\n", b" ", b"", *b"0 -1 999999999999999999 1e400 nan list O (".split()]
NUMBERS = [0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, 10**12]
PLY_TEXT = b"""ply
format ascii 1.0
element camera 1
property list uchar int q
element vertex 2
property float x
property double y
property short z
end_header
2 1 2
1.5 2 3
1.5 2 3
"""
PCD_TEXT = b"""FIELDS x y z _ rgb
SIZE 4 4 4 1 4
TYPE F F F U F
WIDTH 2
HEIGHT 1
DATA ascii
1 2 3 0 4.2e6
1 2 3 0 4.2e6
"""


def damage(data, rng):
    """Cut, flip, replace or overwrite a few bytes, more often near the beginning."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 5])):
        place = rng.randrange(min(len(data), rng.choice([100, 600, 10**9])) or 1)
        match rng.randrange(5):
            case 0:
                del data[rng.randrange(len(data) + 1) :]
            case 1:
                data[place : place + 1] = bytes([rng.randrange(256)])
            case 2:
                data[place : place + rng.randrange(9)] = rng.randbytes(rng.randrange(9))
            case 3:
                words = bytes(data).split(b" ", 60)
                words[rng.randrange(len(words))] = rng.choice(WORDS)
                data = bytearray(b" ".join(words))
            case 4:
                size = rng.choice([4, 8])
                number = rng.choice(NUMBERS) % 256**size
                data[place : place + size] = number.to_bytes(size, "little")
    return bytes(data)


def compressed_pcd():
    lzf = pytest.importorskip("lzf")
    full = np.zeros((3, 50), "<f4").tobytes()
    packed = lzf.compress(full)
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 50\nHEIGHT 1\nDATA binary_compressed\n"
    return header.encode() + struct.pack("<II", len(packed), len(full)) + packed


@pytest.fixture
def whole_files(tmp_path, make_cloud, request):
    """Files of a format, by its suffix."""

    def write(suffix):
        path = tmp_path / f"whole{suffix}"
        if suffix == ".e57":
            request.getfixturevalue("write_scan")(path, make_cloud(20))
        else:
            path = path if FORMATS[suffix].write else path.with_suffix(".xyz")
            write_cloud(path, make_cloud(20))
        return [path.read_bytes(), *further_files(tmp_path, suffix)]

    return write


def further_files(folder, suffix):
    """Files of a format that torchrg does not write so."""
    files = []
    if suffix == ".npz":
        np.savez_compressed(folder / "packed.npz", points=np.zeros((20, 3)), scale=np.ones(2))
        files.append((folder / "packed.npz").read_bytes())
    if suffix == ".ply":
        files.append(PLY_TEXT)
    if suffix == ".pcd":
        files += [PCD_TEXT, compressed_pcd()]
    return files


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", list(FORMATS))
def test_damage_gives_a_cloud_or_a_format_error(tmp_path, whole_files, suffix):
    needs(suffix)
    rng = random.Random(suffix)
    files = whole_files(suffix)
    refused = 0
    for _ in range(60 if suffix in (".e57", ".las", ".laz") else 120):
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(damage(rng.choice(files), rng))
        try:
            cloud = read_cloud(path)
        except FormatError as error:
            refused += 1
            message = str(error)
            assert message.startswith(f"{path}: ")
            assert message.endswith(".")
            assert "\n" not in message
        else:
            assert len(cloud) > 0
            assert cloud.coordinates.dtype in (np.float32, np.float64)
            assert all(len(values) == len(cloud) for values in cloud.fields.values())
    assert refused > 0


# Text says nowhere how long it is.
@pytest.mark.parametrize(
    "suffix", [kind for kind in FORMATS if FORMATS[kind].count is not count_text]
)
def test_every_file_cut_short_is_refused(tmp_path, whole_files, suffix):
    needs(suffix)
    path = tmp_path / f"cut{suffix}"
    for whole in set(whole_files(suffix)) - {PLY_TEXT, PCD_TEXT}:
        step = max(len(whole) // 40, 1)
        for end in (*range(1, len(whole), step), len(whole) - 1):
            path.write_bytes(whole[:end])
            with pytest.raises(FormatError, match=rf"cut\{suffix}: "):
                read_cloud(path)


@pytest.fixture
def e57(tmp_path, write_scan):
    """What an E57 file holds before its XML, and the XML."""
    random = np.random.default_rng(0)
    colors = random.integers(0, 256, (30, 3)).astype(np.uint8)
    points = random.random((30, 3), np.float32).astype(np.float64)
    whole = write_scan(tmp_path / "whole.e57", Cloud(points, {"color": colors}))
    return split_e57(whole.read_bytes())


def test_parts_of_an_e57_file_put_together_read_as_before(tmp_path, e57):
    (tmp_path / "again.e57").write_bytes(join_e57(*e57))
    again, whole = read_cloud(tmp_path / "again.e57"), read_cloud(tmp_path / "whole.e57")
    assert np.array_equal(again.coordinates, whole.coordinates)
    assert np.array_equal(again.fields["color"], whole.fields["color"])


@pytest.mark.filterwarnings("ignore")
def test_damaged_xml_under_valid_checksums_gives_a_cloud_or_a_format_error(tmp_path, e57):
    before, whole = e57
    rng = random.Random("xml")
    path, refused = tmp_path / "damaged.e57", 0
    for _ in range(80):
        xml = whole
        for _ in range(rng.choice([1, 1, 3])):
            kind = rng.choice(
                [rb"-?\d+(\.\d+)?(e[+-]\d+)?", rb"</?\w+[^>]*>", rb'"\w+"', rb"<(/?)"]
            )
            place = rng.choice(list(re.finditer(kind, xml)))
            new = rng.choice([*WORDS, place[0] * 2, b'"String"', b"4000000000", b"&x;", b"\xff"])
            xml = xml[: place.start()] + new + xml[place.end() :]
        path.write_bytes(join_e57(before, xml))
        try:
            assert len(read_cloud(path)) > 0
        except FormatError as error:
            refused += 1
            message = str(error)
            assert message.startswith(f"{path}: ")
            assert "\n" not in message
            assert "checksum" not in message
    assert 20 < refused < 80


@pytest.mark.parametrize("offset", [2**31, 2**32])
def test_points_far_into_a_file_are_read_from_their_place(tmp_path, offset):
    path = tmp_path / "sparse.ply"
    points = np.arange(12, dtype="<f4").reshape(4, 3)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement other {offset // 8}\nproperty double t\n"
        "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    with path.open("wb") as stream:
        stream.write(header.encode())
        stream.seek(offset, 1)
        stream.write(points.tobytes())
    assert np.array_equal(read_cloud(path).coordinates, points)
    with path.open("r+b") as stream:
        stream.truncate(path.stat().st_size - 1)
    with pytest.raises(FormatError, match=f"byte {len(header) + offset}: expected 48 bytes"):
        read_cloud(path)


def test_a_cloud_beyond_memory_is_refused_by_its_name(tmp_path, make_cloud, monkeypatch):
    write_cloud(tmp_path / "large.npy", make_cloud(5))
    monkeypatch.setattr("torchrg.io.npy.assemble_cloud", Mock(side_effect=MemoryError))
    with pytest.raises(FormatError, match=r"large\.npy: not enough memory for its points"):
        read_cloud(tmp_path / "large.npy")
