"""Depth, colour and poses from files."""

import math
import os
import re
import struct
import warnings
from bisect import bisect_left
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import ConfigError, DepthWarning, FormatError
from torchrg.io.colors import narrow_colors
from torchrg.io.files import DAMAGES, check_available, check_file, read_text, refusing
from torchrg.structures import FARTHEST, Array

Value = TypeVar("Value")
DEPTH_SUFFIXES = (".png", ".npy", ".pgm")
"""Suffixes of depth images."""
_CONVERTERS = {
    ".bag": "save its frames by Open3D's RGBDVideoReader",
    ".mkv": "save its frames by Open3D's azure_kinect_mkv_reader.py",
    ".r3d": "unzip it, and save what pyliblzfse reads of its .depth files as .npy, in metres",
    ".exr": "save what OpenEXR reads of it as .npy, usually in metres",
}
"""Ways to frames from recordings and images that are not read, by suffix."""
_PNG = b"\x89PNG"
_PNG_SIZE, _PNG_SIZE_AT = struct.Struct(">II"), 16
"""Width and height in the header of a PNG, and the byte at which they begin."""
_PGM = re.compile(rb"P5(?:\s|#[^\n]*\n)+?([1-9]\d{0,8})\s+([1-9]\d{0,8})\s+(\d{1,9})\s")
"""Beginning of a binary PGM: width, height and the largest value."""
_LONGEST_HEAD = 512
_MOST_OF_8_BITS, _MOST_OF_16_BITS = 255, 65535
MAX_PIXELS = 1 << 26
"""Pixels of the largest image that is read, 8192 x 8192. No depth camera has as many, and what is
made of them on the way to metres takes 1.5 GB. A library that has less ends the process."""
_MIN_MEDIAN_DEPTH, _MAX_MEDIAN_DEPTH = 0.05, 100.0
"""Median depths in meters beyond which the depth scale is doubted. Depth cameras see 0.1 to 20."""
_SAMPLED = 20_000
"""Pixels that the median is taken of."""
_MAX_SECONDS = 0.02
"""Most seconds between an image and a pose that belong together."""


def read_depth(
    path: str | os.PathLike[str], *, depth_scale: float, no_depth: int | None = None
) -> Tensor:
    """Read depth in metres, ``(H, W)``, float32, from gray PNG or PGM of 16 bits, or ``.npy``.

    It is 0 where there is none (0, negative, not finite, or ``no_depth``, as 65535 in 7-Scenes).
    ``depth_scale`` is the stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for
    metres. It is not in the files, and never guessed.

    Warns:
        DepthWarning: If the median depth is below 5 cm or beyond 100 m.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "depth.npy"
        >>> np.save(path, np.array([[1500, 0]], dtype=np.uint16))
        >>> read_depth(path, depth_scale=1000)
        tensor([[1.5000, 0.0000]])
    """
    if not 0 < depth_scale < float("inf"):
        raise ConfigError(f"read_depth: expected depth_scale > 0, got {depth_scale}.")
    source = Path(path)
    refuse_recording(source)
    readers = {".png": _read_png16, ".npy": _read_npy, ".pgm": _read_pgm16}
    reader = readers.get(source.suffix.lower())
    if reader is None:
        suffixes = " ".join(DEPTH_SUFFIXES)
        raise FormatError(
            f"{source}: expected a depth image that ends in one of {suffixes}, got "
            f"{source.suffix!r}."
        )
    stored = reader(source)
    depth = stored.astype(np.float64)
    with np.errstate(invalid="ignore"):
        bad = ~(np.isfinite(depth) & (depth > 0))
    if no_depth is not None:
        bad |= stored == no_depth
    seen = depth[~bad]
    # A sample tells the scale, and takes no time.
    seen = seen[:: len(seen) // _SAMPLED + 1] / depth_scale
    median = float(np.median(seen)) if len(seen) else _MIN_MEDIAN_DEPTH
    if not _MIN_MEDIAN_DEPTH <= median <= _MAX_MEDIAN_DEPTH:
        warnings.warn(
            f"{source}: expected a median depth of {_MIN_MEDIAN_DEPTH} to {_MAX_MEDIAN_DEPTH:g} m, "
            f"got {median:,.4g} m with --depth-scale {depth_scale:g}; pass 1000 for millimeters, 1 "
            "for meters.",
            DepthWarning,
            stacklevel=2,
        )
    return torch.from_numpy((np.where(bad, 0, depth) / depth_scale).astype(np.float32))


def refuse_recording(path: Path) -> None:
    """Raise FormatError with what converts it, of a file that holds depth and is not read."""
    if (tool := _CONVERTERS.get(path.suffix.lower())) and not path.is_dir():
        raise FormatError(
            f"{path}: expected depth images, got {path.suffix}; {tool}, and give the folder to "
            "torchrg convert rgbd."
        )


def read_color(source: Path) -> Tensor:
    """Read red, green and blue, shape ``(3, H, W)``, uint8, from a PNG or JPEG.

    A gray image has three equal channels, and channels of 16 bits are rounded to 8.
    """
    image = _read_image(source, "PNG or JPEG")
    is_known = image.dtype in (np.uint8, np.uint16) and image.ndim == 3
    if not is_known or image.shape[2] not in (1, 3, 4):
        raise FormatError(
            f"{source}: expected a color image of 8 or 16 bits a channel, got shape {image.shape} "
            f"and {image.dtype}."
        )
    image = narrow_colors(image)
    channels = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    return torch.from_numpy(np.ascontiguousarray(channels.transpose(2, 0, 1)))


def _read_png16(source: Path) -> NDArray[np.uint16]:
    """Return the values of a gray PNG of 16 bits, shape ``(H, W)``."""
    image = _read_image(source, "PNG")
    if image.dtype != np.uint16 or image.ndim != 3 or image.shape[2] != 1:
        raise FormatError(
            f"{source}: expected a gray PNG of 16 bits, got shape {image.shape} and {image.dtype}; "
            "depth does not fit into 8 bits or colours."
        )
    values: NDArray[np.uint16] = image[..., 0]
    return values


def _read_image(source: Path, kinds: str) -> Array:
    """Return what an image holds, shape ``(H, W, C)``."""
    from kornia_rs import io

    check_file(source)
    if source.suffix.lower() == ".png" and (count := num_pixels(source)) > MAX_PIXELS:
        raise FormatError(
            f"{source}: expected an image of at most {MAX_PIXELS:,} pixels, got {count:,} in its "
            "header; the file may be corrupt, or make it smaller."
        )
    with refusing(f"{source}: expected a {kinds} image, got: ", Exception):
        # Without a mode, the library says how many bits and channels there are.
        return np.asarray(io.read_image(str(source)))


def _read_pgm16(source: Path) -> NDArray[np.uint16]:
    """Return the values of a binary PGM of 16 bits, shape ``(H, W)``."""
    check_file(source)
    content = source.read_bytes()
    header = _PGM.match(content)
    if header is None or not _MOST_OF_8_BITS < int(header[3]) <= _MOST_OF_16_BITS:
        raise FormatError(
            f"{source}: expected a binary PGM of 16 bits, P5, got {content[:16]!r}; depth does not "
            "fit into 8 bits."
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
    """Return width and height by the beginning of a depth image; None if damaged or not there."""
    try:
        if path.suffix.lower() == ".npy":
            height, width = np.load(path, mmap_mode="r", allow_pickle=False).shape
            return width, height
        with path.open("rb") as stream:
            head = stream.read(_LONGEST_HEAD)
        if head.startswith(_PNG):
            width, height = _PNG_SIZE.unpack_from(head, _PNG_SIZE_AT)
            return width, height
    except (OSError, *DAMAGES):
        return None
    header = _PGM.match(head)
    return (int(header[1]), int(header[2])) if header else None


def num_pixels(path: Path) -> int:
    """Return the number of pixels of a depth image, 0 where :func:`image_size` does not know it."""
    return math.prod(image_size(path) or (0,))


def _read_npy(source: Path) -> NDArray[np.number]:
    """Return the values of a ``.npy`` file, shape ``(H, W)``."""
    check_file(source)
    with refusing(f"{source}: expected an array of numbers, got: ", OSError, *DAMAGES):
        values: NDArray[np.number] = np.load(source, allow_pickle=False)
    if values.ndim != 2 or values.dtype.kind not in "fiu" or values.size == 0:
        raise FormatError(
            f"{source}: expected depth of shape (H, W), got {values.shape} and {values.dtype}."
        )
    return values


def read_matrix(path: Path) -> Tensor:
    """Read a matrix of four rows of four numbers, shape ``(4, 4)``, float64."""
    rows = _words(path)
    if [len(row) for row in rows] != [4] * 4:
        raise FormatError(f"{path}: expected 4 rows of 4 numbers, got {len(rows)} rows.")
    return torch.tensor(_numbers(path, rows), dtype=torch.float64)


def read_numbers(path: Path, count: int, what: str) -> list[list[float]]:
    """Read rows of so many numbers; ``what`` says which they are."""
    return _numbers(path, _rows(path, count, what))


def known_pose(matrix: Tensor) -> Tensor | None:
    """Return a pose, or None for one that is not finite or leads nowhere: tracking was lost."""
    return matrix if bool((matrix.abs() <= FARTHEST).all()) else None


def read_timed(path: Path) -> tuple[list[float], list[str]]:
    """Read rows of a time and a file name; return times, ascending, and names."""
    rows = _rows_by_time(path, 2, "a time and a file name")
    return [float(time) for time, _ in rows], [name for _, name in rows]


def read_trajectory(path: Path) -> tuple[list[float], list[Tensor | None]]:
    """Read rows of ``time tx ty tz qx qy qz qw``; return times, ascending, and poses.

    Poses are matrices from camera to world, shape ``(4, 4)``, float64, or None; see
    :func:`known_pose`.
    """
    rows = _rows_by_time(path, 8, "time tx ty tz qx qy qz qw")
    values = torch.tensor(_numbers(path, rows), dtype=torch.float64)
    return _poses_by_time(values, _rotations(values[:, 4:]), values[:, 1:4])


def read_axis_angles(path: Path) -> tuple[list[float], list[Tensor | None]]:
    """Do as :func:`read_trajectory` with ``time rx ry rz tx ty tz``, from world to camera."""
    from scipy.spatial.transform import Rotation

    rows = _rows_by_time(path, 7, "time rx ry rz tx ty tz")
    values = torch.tensor(_numbers(path, rows), dtype=torch.float64)
    back = torch.from_numpy(Rotation.from_rotvec(values[:, 1:4].numpy()).as_matrix()).mT
    return _poses_by_time(values, back, -(back @ values[:, 4:, None])[..., 0])


def _poses_by_time(
    values: Tensor, turns: Tensor, places: Tensor
) -> tuple[list[float], list[Tensor | None]]:
    """Return the times of rows, and matrices of turns ``(n, 3, 3)`` and places ``(n, 3)``."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(values), 1, 1)
    poses[:, :3, :3], poses[:, :3, 3] = turns, places
    return values[:, 0].tolist(), [known_pose(pose) for pose in poses]


def read_nearest(
    times: list[float], path: Path, read: Callable[[Path], tuple[list[float], Sequence[Value]]]
) -> list[Value | None]:
    """Return what a list by time has nearest to each of some times, None where that is too far.

    It is None everywhere if there is no such file.
    """
    others, values = read(path) if path.is_file() else ([], [])
    nearest: list[Value | None] = []
    for time in times:
        place = bisect_left(others, time)
        around = range(max(place - 1, 0), min(place + 1, len(others)))
        best = min(around, key=lambda i: abs(others[i] - time), default=None)
        if best is not None and abs(others[best] - time) > _MAX_SECONDS:
            best = None
        nearest.append(None if best is None else values[best])
    return nearest


def _rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices of quaternions x y z w of any length, shape ``(n, 3, 3)``.

    They are not numbers where the quaternion is zero or not finite.
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
    """Return the words of each row, which are so many, by the time that the first of them is."""
    rows = _rows(path, num_words, what)
    times = [time for (time,) in _numbers(path, [row[:1] for row in rows])]
    wrong = next((time for time in times if not math.isfinite(time)), None)
    if wrong is not None:
        raise FormatError(f"{path}: expected finite times, got {wrong}; repair or delete its row.")
    return [rows[i] for i in sorted(range(len(rows)), key=times.__getitem__)]


def _rows(path: Path, num_words: int, what: str) -> list[list[str]]:
    """Return the words of each row, which are so many."""
    rows = _words(path)
    wrong = next((row for row in rows if len(row) != num_words), [])
    if wrong or not rows:
        got = repr(" ".join(wrong)[:60]) if wrong else "none"
        raise FormatError(
            f"{path}: expected {what} in each row, got {got}; the file may be corrupt."
        )
    return rows


def _words(path: Path) -> list[list[str]]:
    """Return the words of each row; ``#`` begins a comment."""
    lines = read_text(path).splitlines()
    words = (line.split("#")[0].replace(",", " ").split() for line in lines)
    return [row for row in words if row]


def _numbers(path: Path, rows: list[list[str]]) -> list[list[float]]:
    """Return words as numbers."""
    try:
        return [[float(word) for word in row] for row in rows]
    except ValueError as error:
        raise FormatError(f"{path}: expected numbers: {error}.") from error
