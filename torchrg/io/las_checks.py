"""What a LAS or LAZ file promises, checked before laspy and lazrs believe it.

laspy loops over as many header records as the file says, and lazrs ends the process when the memory
it asks for is not there.
"""

import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from torchrg._optional import require
from torchrg.errors import FormatError
from torchrg.io.files import check_promise

FIRST_LAYERED_FORMAT = 6


def check_header(path: Path, size: int) -> None:
    """Check the numbers of records that laspy would otherwise loop over."""
    with path.open("rb") as stream:
        head = stream.read(255)
        if head[:4] != b"LASF" or len(head) < 227:
            raise FormatError(f"{path}: byte 0: expected the header of a LAS file; fetch it again.")
        (num_records,) = struct.unpack_from("<I", head, 100)
        check_promise(
            path, byte=100, promised=54 * num_records, available=size, content="header records"
        )
        if head[25] < 4 or len(head) < 247:
            return
        start, num_extended = struct.unpack_from("<QI", head, 235)
        for _ in range(num_extended):
            content = f"{num_extended:,} extended header records"
            check_promise(path, byte=start, promised=60, available=size - start, content=content)
            stream.seek(start)
            (length,) = struct.unpack_from("<Q", stream.read(60), 20)
            start += 60
            check_promise(
                path, byte=start, promised=length, available=size - start, content=content
            )
            start += length


def check_chunks(path: Path, header: Any, size: int) -> None:  # noqa: ANN401
    """Check the number of compressed chunks; lazrs ends the process if memory for it fails."""
    start = header.offset_to_point_data
    with path.open("rb") as stream:
        stream.seek(start)
        offset = int.from_bytes(stream.read(8), "little", signed=True)
        if offset == -1:
            # The writer could not go back to the beginning, so the offset is at the end.
            stream.seek(size - 8)
            offset = int.from_bytes(stream.read(8), "little", signed=True)
        content = "the table of chunks"
        if offset < 0:
            raise FormatError(
                f"{path}: byte {start}: expected the place of {content}; fetch it again."
            )
        check_promise(path, byte=offset, promised=8, available=size - offset, content=content)
        stream.seek(offset)
        _, num_chunks = struct.unpack("<II", stream.read(8))
        # The first point of a chunk is stored as it is.
        check_promise(
            path,
            byte=offset + 4,
            promised=num_chunks * header.point_format.size,
            available=size,
            content=f"{num_chunks:,} chunks",
            at_least=True,
        )
        lazrs = require("lazrs", extra="las", purpose="read LAZ files")
        (record,) = header.vlrs.get("LasZipVlr")
        layout = lazrs.LazVlr(record.record_data)
        if layout.chunk_size() * num_chunks < header.point_count:
            raise FormatError(
                f"{path}: byte {offset}: expected chunks for {header.point_count:,} points, got "
                f"{num_chunks:,} of {layout.chunk_size():,}; the file is damaged, fetch it again."
            )
        stream.seek(start)
        table = lazrs.read_chunk_table(stream, layout)
        if header.point_format.id >= FIRST_LAYERED_FORMAT:
            _check_layers(path, stream, header, [num_bytes for _, num_bytes in table])


def _check_layers(path: Path, stream: BinaryIO, header: Any, chunks: list[int]) -> None:  # noqa: ANN401
    """Check the sizes of the layers of each chunk, each of which lazrs takes memory for."""
    point_format = header.point_format
    # Nine for the fields all points have, one for colour, one for near infrared, one for waves.
    num_layers = 9 + {6: 0, 7: 1, 8: 2, 9: 1, 10: 3}[point_format.id]
    num_layers += point_format.num_extra_bytes
    start = header.offset_to_point_data + 8
    for num_bytes in chunks:
        # A whole point and the number of points come first.
        place = start + point_format.size + 4
        stream.seek(place)
        sizes = np.frombuffer(stream.read(4 * num_layers), "<u4")
        check_promise(
            path,
            byte=place,
            promised=int(sizes.sum(dtype=np.uint64)),
            available=num_bytes,
            content="the layers of a chunk",
        )
        start += num_bytes
