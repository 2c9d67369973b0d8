"""How many points a file holds, from its header alone: to plan work before it is read."""

import struct
import zipfile
from pathlib import Path
from typing import IO, BinaryIO

from numpy.lib import format as npy_format

from torchrg.errors import FormatError
from torchrg.io import pcd, ply
from torchrg.io.files import DAMAGES

TEXT_SAMPLE = 1 << 16
E57_BYTES_PER_POINT = 12
LAS_COUNT = 107
LAS14_COUNT = 247


def estimate_points(path: Path) -> int:
    r"""Return the number of points that a file says it holds, without reading them.

    Args:
        path: A file of a format that :func:`torchrg.read_cloud` reads.

    Returns:
        The number; for text, which has no header, and for E57 an estimate from the size; 0 for a
        file that is damaged or of no known format, which reading will tell.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "corner.xyz"
        ...     _ = path.write_text("0 0 0\n1 0 0\n0 1 0\n")
        ...     estimate_points(path)
        3
    """
    try:
        with path.open("rb") as stream:
            return _count(path, stream, path.stat().st_size)
    except (OSError, FormatError, StopIteration, zipfile.BadZipFile, *DAMAGES):
        return 0


def _count(path: Path, stream: BinaryIO, size: int) -> int:
    """Return the number of points by format."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return _length_of_array(stream)
    if suffix == ".npz":
        with zipfile.ZipFile(stream) as archive:
            name = next(n for n in ("points.npy", "coord.npy") if n in archive.namelist())
            with archive.open(name) as member:
                return _length_of_array(member)
    if suffix == ".ply":
        elements = ply.read_header(path, stream).elements
        return next(element.num_records for element in elements if element.name == "vertex")
    if suffix == ".pcd":
        header = pcd.read_header(path, stream)
        return header.width * header.height
    if suffix in (".las", ".laz"):
        head = stream.read(LAS14_COUNT + 8)
        # Version 1.4 has a second count, of 64 bits; the first may be 0 there.
        old: int = struct.unpack_from("<I", head, LAS_COUNT)[0]
        return struct.unpack_from("<Q", head, LAS14_COUNT)[0] if head[25] >= 4 else old
    if suffix == ".e57":
        return size // E57_BYTES_PER_POINT
    sample = stream.read(TEXT_SAMPLE)
    return round(sample.count(b"\n") * size / max(len(sample), 1))


def _length_of_array(stream: IO[bytes]) -> int:
    """Return the number of rows of an array in NumPy's format."""
    version = npy_format.read_magic(stream)
    read = npy_format.read_array_header_1_0
    if version != (1, 0):
        read = npy_format.read_array_header_2_0
    shape, _, _ = read(stream)
    return shape[0] if shape else 0
