"""The pages of an E57 file, each of 1,020 bytes and their checksum, and the XML at its end."""

import struct

import pytest

PAGE, WITH_CHECKSUM = 1020, 1024


def split_e57(data):
    """Return what a file holds before its XML, and the XML."""
    starts = range(0, len(data), WITH_CHECKSUM)
    content = b"".join(data[start : start + PAGE] for start in starts)
    place, length = struct.unpack_from("<QQ", data, 24)
    start = place // WITH_CHECKSUM * PAGE + place % WITH_CHECKSUM
    return content[:start], content[start : start + length]


def join_e57(before, xml):
    """Return the file of both parts, with the lengths and checksums that they have."""
    checksum = pytest.importorskip("google_crc32c").value
    content = bytearray(before + xml)
    content += bytes(-len(content) % PAGE)
    struct.pack_into("<Q", content, 16, len(content) // PAGE * WITH_CHECKSUM)
    struct.pack_into("<Q", content, 32, len(xml))
    pages = (bytes(content[start : start + PAGE]) for start in range(0, len(content), PAGE))
    return b"".join(page + checksum(page).to_bytes(4, "big") for page in pages)
