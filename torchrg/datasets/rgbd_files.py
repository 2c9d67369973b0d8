"""Readers of depth images, color images, poses and trajectories."""

import math
import os
import re
import struct
from bisect import bisect_left
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor
from torchrg._optional import require
from torchrg.depth.values import DepthKind, convert_depth, drop_channel
from torchrg.errors import FormatError
from torchrg.io.files import (
    PARSE_ERRORS,
    check_available,
    check_file,
    decode_file,
    local_path,
    wrap_errors,
)
from torchrg.structures.colors import BYTE, WORD, narrow_colors
from torchrg.structures.points import Array

Value = TypeVar("Value")
DEPTH_SUFFIXES = (".png", ".npy", ".pgm", ".exr")
"""Suffixes of depth images."""
_CONVERTERS = {
    ".bag": "extract its frames with Open3D's RGBDVideoReader",
    ".mkv": "extract its frames with Open3D's azure_kinect_mkv_reader.py",
    ".r3d": "export it as EXR + JPG in Record3D",
}
"""How to convert unsupported recordings and images to frames, by suffix."""
_PGM = re.compile(rb"P5(?:\s|#[^\n]*\n)+?([1-9]\d{0,8})\s+([1-9]\d{0,8})\s+(\d{1,9})\s")
"""Header of a binary PGM: width, height and maximum value."""
_EXR_WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0{3}(.{16})", re.DOTALL)
"""Entry of an OpenEXR header: first and last column and row, as 32-bit integers."""
_EXR_CHANNELS = ("Z", "Y", "R")
"""Names of the channel with depth, in this order: renderers, gray images, and Record3D."""
_MAX_HEADER_BYTES = 4096
MAX_PIXELS = 1 << 26
"""Maximum pixels of an image, 8192 x 8192. No depth camera has more, and converting them to
meters takes 1.5 GB. Running out of memory in a library would end the process."""
_MAX_SECONDS = 0.02
"""Maximum time difference, in seconds, between an image and its pose."""


def read_depth(
    path: str | os.PathLike[str],
    depth_scale: float,
    depth_kind: DepthKind = "z",
    intrinsics: Tensor | None = None,
    confidence: Path | None = None,
) -> Tensor:
    """Read depth in meters, ``(H, W)``, float32, from 16-bit gray PNG or PGM, ``.npy`` or OpenEXR.

    Pixels without depth are 0, also where ``confidence``, a gray PNG, is 0. ``depth_scale`` is the
    number of depth units per meter: 1000 for millimeters, 5000 for TUM, 1 for meters. It is not
    stored in the files and never guessed. Distances along the ray, ``"ray"``, need the camera; see
    :func:`torchrg.depth.values.convert_depth`.
    """
    source = local_path(path)
    refuse_form(source)
    readers = {".png": _read_png16, ".npy": _read_npy, ".pgm": _read_pgm16, ".exr": _read_exr}
    stored = as_tensor(f"{source}", "depth", readers[source.suffix.lower()](source))
    depth = convert_depth(f"{source}", stored, intrinsics, depth_scale, depth_kind).float()
    if confidence is None:
        return depth
    image = _read_image(confidence, "PNG")
    if image.shape != (*depth.shape, 1):
        raise FormatError(
            f"{confidence}: expected a gray image of shape {tuple(depth.shape)}, as its depth, got "
            f"{image.shape}; remove it to use all depth."
        )
    return torch.where(torch.from_numpy(image[..., 0] > 0), depth, 0.0)


def refuse_form(path: Path, *others: str) -> None:
    """Raise FormatError if a file has no suffix of depth images, nor one of ``others``."""
    suffix = path.suffix.lower()
    if suffix in _CONVERTERS:
        raise FormatError(
            f"{path}: expected depth images, got {path.suffix}; {_CONVERTERS[suffix]}, and pass "
            "the folder to torchrg convert rgbd."
        )
    if suffix not in (*DEPTH_SUFFIXES, *others):
        raise FormatError(
            f"{path}: expected a depth image that ends in one of {' '.join(DEPTH_SUFFIXES)}, got "
            f"{path.suffix!r}; convert it to a 16-bit .png, or save its values with numpy.save."
        )


def read_color(source: Path) -> Tensor:
    """Read red, green and blue, shape ``(3, H, W)``, uint8, from a PNG or JPEG.

    Gray images become three equal channels, and 16-bit channels are rounded to 8 bits.
    """
    image = _read_image(source, "PNG or JPEG")
    is_known = image.dtype in (np.uint8, np.uint16) and image.ndim == 3
    if not is_known or image.shape[2] not in (1, 3, 4):
        raise FormatError(
            f"{source}: expected colors of 8 or 16 bits, got shape {image.shape} and {image.dtype}."
        )
    image = narrow_colors(image)
    channels = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    return torch.from_numpy(np.ascontiguousarray(channels.transpose(2, 0, 1)))


def _read_png16(source: Path) -> NDArray[np.uint16]:
    """Return the values of a 16-bit gray PNG, shape ``(H, W)``."""
    image = _read_image(source, "PNG")
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 1:
        raise FormatError(
            f"{source}: expected a 16-bit gray PNG, got shape {image.shape} and {image.dtype}; "
            "8-bit or color images cannot represent depth."
        )
    values: NDArray[np.uint16] = image[..., 0]
    return values


def _read_image(source: Path, kinds: str, read: Callable[[str], Array] | None = None) -> Array:
    """Return the pixels of an image, shape ``(H, W, C)``; ``read`` replaces the library."""
    from kornia_rs import io

    check_file(source)
    if source.suffix.lower() in (".png", ".exr") and (count := num_pixels(source)) > MAX_PIXELS:
        raise FormatError(
            f"{source}: expected an image of at most {MAX_PIXELS:,} pixels, got {count:,} in its "
            "header; resize it, unless the file is corrupt."
        )
    with wrap_errors(f"{source}: expected a {kinds} image, got: ", Exception):
        # Without a mode argument, the library detects bit depth and channels.
        return np.asarray((read or io.read_image)(str(source)))


def _read_exr(source: Path) -> Array:
    """Return the depth channel of an OpenEXR image, shape ``(H, W)``, float32."""
    library = require("OpenEXR", extra="exr", purpose="read .exr depth images")

    def read(path: str) -> Array:
        channels = library.File(path, separate_channels=True).channels()
        known = [name for name in _EXR_CHANNELS if name in channels]
        (name,) = [*channels] if len(channels) == 1 else known[:1]
        pixels: Array = channels[name].pixels
        return pixels

    kinds = f"OpenEXR (one channel, or {', '.join(_EXR_CHANNELS)})"
    return _read_image(source, kinds, read).astype(np.float32)


def _read_pgm16(source: Path) -> NDArray[np.uint16]:
    """Return the values of a 16-bit binary PGM, shape ``(H, W)``."""
    check_file(source)
    content = source.read_bytes()
    header = _PGM.match(content)
    if header is None or not BYTE < int(header[3]) <= WORD:
        raise FormatError(
            f"{source}: expected a 16-bit binary PGM, P5, got {content[:16]!r}; 8 bits are too few."
        )
    width, height, start = int(header[1]), int(header[2]), header.end()
    available = len(content) - start
    check_available(source, start, 2 * width * height, "its pixels", available=available)
    if available > 2 * width * height:
        raise FormatError(
            f"{source}: expected {2 * width * height:,} bytes for {width} x {height} pixels, got "
            f"{available:,}; correct the size in its header, or write it again."
        )
    values = np.frombuffer(content, ">u2", width * height, start)
    return values.astype(np.uint16).reshape(height, width)


def image_size(path: Path) -> tuple[int, int] | None:
    """Return width and height from a depth image header; None if corrupt or missing."""
    try:
        if path.suffix.lower() == ".npy":
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            height, width = drop_channel(array).shape
            return width, height
        with path.open("rb") as stream:
            head = stream.read(_MAX_HEADER_BYTES)
        if head.startswith(b"\x89PNG"):
            width, height = struct.unpack_from(">II", head, offset=16)
            return width, height
        if window := _EXR_WINDOW.search(head):
            left, top, right, bottom = struct.unpack("<4i", window[1])
            return max(right - left, 0) + 1, max(bottom - top, 0) + 1
    except (OSError, *PARSE_ERRORS):
        return None
    header = _PGM.match(head)
    return (int(header[1]), int(header[2])) if header else None


def num_pixels(path: Path) -> int:
    """Return the number of pixels of a depth image, 0 if :func:`image_size` returns None."""
    return math.prod(image_size(path) or (0,))


def _read_npy(source: Path) -> Array:
    """Return the array of a ``.npy`` file, shape ``(H, W)``; floating point as float64."""
    values = drop_channel(read_array(source))
    if values.ndim != 2 or values.size == 0:
        raise FormatError(f"{source}: expected depth of shape (H, W), got {values.shape}.")
    return values.astype(np.float64) if values.dtype.kind == "f" else values


def read_array(source: Path) -> Array:
    """Return the numbers of a ``.npy`` file."""
    check_file(source)
    with wrap_errors(f"{source}: expected an array of numbers, got: ", OSError, *PARSE_ERRORS):
        values: Array = np.load(source, allow_pickle=False)
        if values.dtype.kind not in "fiu":
            raise TypeError(f"{values.dtype}")
    return values


def read_numbers(path: Path, count: int, what: str) -> list[list[float]]:
    """Read rows of ``count`` numbers, described by ``what`` in messages."""
    return _numbers(path, _rows(path, count, what))


def read_timed(path: Path) -> tuple[list[float], list[str]]:
    """Read rows of a time and a file name; return times (ascending) and names."""
    rows = _rows_by_time(path, 2, "a time and a file name")
    return [float(time) for time, _ in rows], [name for _, name in rows]


def read_trajectory(path: Path) -> tuple[list[float], list[Tensor]]:
    """Read rows of ``time tx ty tz qx qy qz qw``; return times (ascending) and poses.

    Poses are camera-to-world matrices, shape ``(4, 4)``, float64, NaN where tracking was lost.
    """
    rows = _rows_by_time(path, 8, "time tx ty tz qx qy qz qw")
    values = torch.tensor(_numbers(path, rows), dtype=torch.float64)
    return values[:, 0].tolist(), make_poses(values[:, 1:4], values[:, 4:])


def read_axis_angles(path: Path) -> tuple[list[float], list[Tensor]]:
    """Like :func:`read_trajectory`, for ``time rx ry rz tx ty tz`` from world to camera."""
    from scipy.spatial.transform import Rotation

    rows = _rows_by_time(path, 7, "time rx ry rz tx ty tz")
    values = torch.tensor(_numbers(path, rows), dtype=torch.float64)
    back = torch.from_numpy(Rotation.from_rotvec(values[:, 1:4].numpy()).as_matrix()).mT
    return values[:, 0].tolist(), make_poses(-(back @ values[:, 4:, None])[..., 0], back)


def read_table(path: Path, key: str) -> list[dict[str, float]]:
    """Read a CSV table with a header that names a column ``key``; rows omit their empty cells."""
    text = StringIO(decode_file(path))
    with wrap_errors(f"{path}: expected a table with a column {key}, got: ", ValueError, KeyError):
        table = np.atleast_1d(np.genfromtxt(text, delimiter=",", names=True, autostrip=True))
        rows = table[table[key] >= 0].tolist()
    named = (zip(table.dtype.names or (), row, strict=True) for row in rows)
    return [{name: value for name, value in row if not math.isnan(value)} for row in named]


def make_poses(translations: Tensor, rotations: Tensor) -> list[Tensor]:
    """Return matrices ``(4, 4)`` from translations ``(n, 3)`` and rotations.

    Rotations are matrices ``(n, 3, 3)``, or quaternions x y z w ``(n, 4)``, see ``_rotations``.
    """
    poses = torch.eye(4, dtype=torch.float64).repeat(len(translations), 1, 1)
    poses[:, :3, :3] = _rotations(rotations) if rotations.ndim == 2 else rotations
    poses[:, :3, 3] = translations
    return [*poses]


def read_nearest(
    times: list[float], path: Path, read: Callable[[Path], tuple[list[float], Sequence[Value]]]
) -> list[Value | None]:
    """Return the value nearest to each time in a timed list, None if it is too far away.

    All are None if the file does not exist.
    """
    other_times, values = read(path) if path.is_file() else ([], [])
    nearest: list[Value | None] = []
    for time in times:
        index = bisect_left(other_times, time)
        candidates = range(max(index - 1, 0), min(index + 1, len(other_times)))
        near = [i for i in candidates if abs(other_times[i] - time) <= _MAX_SECONDS]
        best = min(near, key=lambda i: abs(other_times[i] - time), default=None)
        nearest.append(None if best is None else values[best])
    return nearest


def _rotations(quaternions: Tensor) -> Tensor:
    """Convert quaternions x y z w of any norm to rotation matrices, shape ``(n, 3, 3)``.

    Zero and non-finite quaternions give NaN.
    """
    from scipy.spatial.transform import Rotation

    matrices = torch.full((len(quaternions), 3, 3), torch.nan, dtype=torch.float64)
    lengths = quaternions.norm(dim=1)
    is_rotation = (lengths > 0) & lengths.isfinite()
    if is_rotation.any():
        rotations = Rotation.from_quat(quaternions[is_rotation].numpy()).as_matrix()
        matrices[is_rotation] = torch.from_numpy(rotations)
    return matrices


def _rows_by_time(path: Path, num_words: int, what: str) -> list[list[str]]:
    """Return rows of ``num_words`` words, sorted by time, which is the first word."""
    rows = _rows(path, num_words, what)
    times = [time for (time,) in _numbers(path, [row[:1] for row in rows])]
    wrong = next((time for time in times if not math.isfinite(time)), None)
    if wrong is not None:
        raise FormatError(f"{path}: expected finite times, got {wrong}; correct or delete its row.")
    return [rows[i] for i in sorted(range(len(rows)), key=times.__getitem__)]


def _rows(path: Path, num_words: int, what: str) -> list[list[str]]:
    """Return the non-empty rows, of ``num_words`` words each; ``#`` begins a comment."""
    lines = decode_file(path).splitlines()
    words = (line.split("#")[0].replace(",", " ").split() for line in lines)
    rows = [row for row in words if row]
    wrong = next((row for row in rows if len(row) != num_words), [])
    if wrong or not rows:
        got = repr(" ".join(wrong)[:60]) if wrong else "none"
        raise FormatError(f"{path}: expected {what} in each row, got {got}; it may be corrupt.")
    return rows


def _numbers(path: Path, rows: list[list[str]]) -> list[list[float]]:
    """Convert words to numbers."""
    with wrap_errors(f"{path}: expected numbers: ", ValueError):
        return [[float(word) for word in row] for row in rows]
