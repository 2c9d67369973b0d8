"""PNG files, read back by hand from the standard (ISO/IEC 15948)."""

import struct
import zlib

import numpy as np
import pytest
import torch

from torchrg.errors import FormatError, ShapeError
from torchrg.render import write_png


def read_png(path):
    """Return the samples of a PNG without palette and interlace: chunks, inflate, five filters."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, packed, header = 8, b"", None
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        body = data[place + 8 : place + 8 + length]
        (check,) = struct.unpack(">I", data[place + 8 + length : place + 12 + length])
        assert check == zlib.crc32(kind + body)
        if kind == b"IHDR":
            header = struct.unpack(">IIBBBBB", body)
        elif kind == b"IDAT":
            packed += body
        place += 12 + length
    width, height, depth, color, _, _, interlace = header
    assert interlace == 0
    step = {0: 1, 2: 3}[color] * depth // 8
    lines = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + width * step)
    rows = np.zeros((height + 1, step + width * step), dtype=np.int64)
    for number, line in enumerate(lines, start=1):
        method, values = line[0], line[1:]
        for column, value in enumerate(values, start=step):
            left, up = rows[number, column - step], rows[number - 1, column]
            corner = rows[number - 1, column - step]
            guess = left + up - corner
            near = min((left, up, corner), key=lambda x: abs(guess - x))
            add = [0, left, up, (left + up) // 2, near][method]
            rows[number, column] = (int(value) + int(add)) % 256
    samples = rows[1:, step:].astype(np.uint8).tobytes()
    kinds = {8: np.dtype(np.uint8), 16: np.dtype(">u2")}
    return np.frombuffer(samples, kinds[depth]).reshape(height, width, -1)


def test_pictures_are_read_back_as_they_were(rng, tmp_path):
    picture = torch.randint(0, 256, (13, 17, 3), generator=rng, dtype=torch.uint8)
    picture[4:9] = 255
    write_png(tmp_path / "picture.png", picture)
    np.testing.assert_array_equal(read_png(tmp_path / "picture.png"), picture)


@pytest.mark.parametrize("integers", [torch.int64, torch.int32, torch.uint16])
def test_labels_keep_sixteen_bits(rng, tmp_path, integers):
    labels = torch.randint(0, 65536, (9, 14), generator=rng)
    labels[0, :2] = torch.tensor([0, 65535])
    write_png(tmp_path / "labels.png", labels.to(integers))
    np.testing.assert_array_equal(read_png(tmp_path / "labels.png")[..., 0], labels)


def test_views_into_larger_tensors_are_written_right(rng, tmp_path):
    picture = torch.randint(0, 256, (3, 20, 26), generator=rng, dtype=torch.uint8)
    part = picture.permute(1, 2, 0)[::2, ::2]
    write_png(tmp_path / "part.png", part)
    np.testing.assert_array_equal(read_png(tmp_path / "part.png"), part)


def test_equal_pictures_are_equal_files(tmp_path):
    picture = torch.arange(600).view(10, 20, 3).to(torch.uint8)
    for name in ("a.png", "b.png"):
        write_png(tmp_path / name, picture)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (torch.zeros(4, 4, 3), "got \\(4, 4, 3\\) and float32"),
        (torch.zeros(4, 4, 4, dtype=torch.uint8), "got \\(4, 4, 4\\)"),
        (torch.zeros(0, 4, 3, dtype=torch.uint8), "got \\(0, 4, 3\\)"),
        (torch.full((2, 2), -1), "got -1 to -1; add 1 to labels"),
        (torch.full((2, 2), 65536), "got 65536 to 65536"),
        (torch.zeros(2, 2), "got \\(2, 2\\) and float32"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path, image, message):
    with pytest.raises(ShapeError, match=message):
        write_png(tmp_path / "x.png", image)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(FormatError, match="not found; create it first"):
        write_png(tmp_path / "missing" / "x.png", torch.zeros(2, 2, 3, dtype=torch.uint8))
