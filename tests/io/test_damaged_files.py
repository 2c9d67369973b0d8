"""Whatever happens to a file, reading it gives a cloud or one line that names it."""

import random
import struct

import numpy as np
import pytest

from torchrg.errors import FormatError
from torchrg.io import FORMATS, read_cloud, write_cloud

WORDS = [
    b"0",
    b"-1",
    b"999999999999999999",
    b"1e400",
    b"nan",
    b"\n",
    b" ",
    b"",
    b"list",
    b"O",
    b"(",
]
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


def whole_files(folder, make_cloud, suffix):
    write_cloud(folder / f"whole{suffix}", make_cloud(20))
    files = [(folder / f"whole{suffix}").read_bytes()]
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
def test_damage_gives_a_cloud_or_a_format_error(tmp_path, make_cloud, suffix, capfd):
    pytest.importorskip({".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy"))
    rng = random.Random(suffix)
    files = whole_files(tmp_path, make_cloud, suffix)
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
@pytest.mark.parametrize("suffix", [kind for kind in FORMATS if kind not in (".xyz", ".txt")])
def test_every_file_cut_short_is_refused(tmp_path, make_cloud, suffix):
    pytest.importorskip({".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy"))
    (whole, *_) = whole_files(tmp_path, make_cloud, suffix)
    path = tmp_path / f"cut{suffix}"
    for end in range(1, len(whole), max(len(whole) // 40, 1)):
        path.write_bytes(whole[:end])
        with pytest.raises(FormatError, match=rf"cut\{suffix}: "):
            read_cloud(path)
