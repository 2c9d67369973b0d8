"""Depth images, color images and trajectories in files."""

import struct
import zlib

import kornia_rs
import numpy as np
import pytest
import torch

from tests.datasets import captures_tree
from tests.datasets.captures_tree import FRAMES, HEIGHT, WIDTH, write_text
from tests.datasets.test_rgbd import expected_pose, write_depth
from torchrg.datasets.rgbd_files import image_size, read_color, read_depth, read_trajectory
from torchrg.errors import FormatError


def test_quaternions_have_any_length_and_zero_is_no_pose(tmp_path):
    quaternions = ["0 0 2 2", "0 0 0 0", "nan nan nan nan", "0 0 inf 1", "0.1 0.2 0.3 -0.4"]
    rows = [f"{time} 0.5 0.25 2 {words}\n" for time, words in enumerate(quaternions)]
    write_text(tmp_path / "track.txt", "".join(rows))
    times, found = read_trajectory(tmp_path / "track.txt")
    assert times == [0, 1, 2, 3, 4]
    assert all(pose[:3, :3].isnan().all() for pose in found[1:4])
    poses = torch.stack([found[0], found[4]])
    torch.testing.assert_close(poses[0], expected_pose(), rtol=0, atol=1e-15)
    assert (poses[:, :3, 3] == torch.tensor([0.5, 0.25, 2]).double()).all()
    turn = poses[1, :3, :3]
    torch.testing.assert_close(turn @ turn.T, torch.eye(3).double(), rtol=0, atol=1e-15)
    # x y z w = (1, 2, 3, -4) / sqrt(30), by the formula of Hamilton, in thirtieths.
    expected = torch.tensor([[4.0, 28, -10], [-20, 10, 20], [22, 4, 20]]).double() / 30
    torch.testing.assert_close(turn, expected, rtol=0, atol=1e-15)


def test_depth_without_meaning_is_zero(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[np.nan, np.inf, -1, 0, 2]]))
    assert read_depth(tmp_path / "a.npy", depth_scale=1).tolist() == [[0, 0, 0, 0, 2]]


def test_color_images_of_16_bits_are_rounded_to_8(tmp_path):
    eight = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    image = eight * np.uint16(257) + np.uint16(100) * (eight < 255)
    kornia_rs.io.write_image_png_u16(str(tmp_path / "a.png"), image, "rgb")
    assert torch.equal(read_color(tmp_path / "a.png"), torch.from_numpy(eight).permute(2, 0, 1))


def test_a_png_that_says_it_is_huge_is_refused_before_it_is_unpacked(tmp_path):
    path = tmp_path / "depth.png"
    write_depth(path, 1500)
    header = bytearray(path.read_bytes())
    header[16:24] = struct.pack(">II", 30_000, 30_000)
    header[29:33] = struct.pack(">I", zlib.crc32(bytes(header[12:29])))
    path.write_bytes(bytes(header))
    with pytest.raises(FormatError, match=r"depth\.png: expected an image of at most .* got 900,"):
        read_depth(path, depth_scale=1000)


def test_a_header_of_an_array_with_an_open_bracket_is_refused(tmp_path):
    path = tmp_path / "depth.npy"
    np.save(path, np.ones((4, 6)))
    path.write_bytes(path.read_bytes().replace(b"(4, 6), }", b"(4, 6,(, "))
    with pytest.raises(FormatError, match=r"depth\.npy: expected an array of numbers, got: "):
        read_depth(path, depth_scale=1)


def test_portable_graymaps_are_read_as_they_are_stored(tmp_path):
    path = tmp_path / "a.pgm"
    path.write_bytes(b"P5\n# a comment 3 4\n3 2\n65535\n" + bytes(range(12)))
    assert image_size(path) == (3, 2)
    expected = [[0x0001, 0x0203, 0x0405], [0x0607, 0x0809, 0x0A0B]]
    assert (read_depth(path, depth_scale=1024) * 1024 == torch.tensor(expected)).all()
    for content, message in (
        (b"P5\n3 2\n65535\n" + bytes(11), "expected 12 bytes for its pixels, got 11"),
        (b"P5\n2 2\n65535\n" + bytes(12), "expected 8 bytes for 2 x 2 pixels, got 12; correct"),
        (b"P5\n3 2\n255\n" + bytes(6), "expected a 16-bit binary PGM, P5, got b'P5"),
        (b"P2\n1 1\n65535\n7\n", "expected a 16-bit binary PGM, P5, got b'P2"),
        (b"P5\n0 2\n65535\n", "expected a 16-bit binary PGM"),
        (b"P5\n99999999 99999999\n65535\n", "for its pixels, got 0; the file is truncated"),
        (b"P5 # " + b"9 " * 1000, "expected a 16-bit binary PGM"),
    ):
        path.write_bytes(content)
        with pytest.raises(FormatError, match=message):
            read_depth(path, depth_scale=1)


def test_sizes_are_read_from_the_beginning_or_not_at_all(tmp_path):
    for name in ("a.png", "a.npy", "a.pgm"):
        captures_tree.write_depth(tmp_path / name, FRAMES[0].depth)
        assert image_size(tmp_path / name) == (WIDTH, HEIGHT)
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:9])
        assert image_size(tmp_path / name) is None
        (tmp_path / name).unlink()
        assert image_size(tmp_path / name) is None
    np.save(tmp_path / "cube.npy", np.zeros((2, 3, 4)))
    assert image_size(tmp_path / "cube.npy") is None
