"""Kernels count in 64 bits: more points than memory holds, in memory that repeats itself."""

import contextlib
import ctypes
import mmap
import os
import sys

import pytest

from tests.kernels.clouds import needs_library
from torchrg import kernels

PART = 3 * 2**20
"""Bytes that repeat: whole pages, and whole points of three float64."""
NUM_POINTS = 2**31 // 3 + 10
"""Points whose coordinates are more than int32 counts."""


@contextlib.contextmanager
def repeating_memory(size):
    """Give the address of so many bytes, which are the same few megabytes again and again."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    file, size = os.memfd_create("part"), -(-size // PART) * PART
    os.ftruncate(file, PART)
    start = libc.mmap(None, size, 0, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1, 0)
    both, fixed = mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_SHARED | 0x10
    for place in range(start, start + size, PART):
        assert libc.mmap(place, PART, both, fixed, file, 0) == place
    os.close(file)
    yield ctypes.c_void_p(start)
    libc.munmap(ctypes.c_void_p(start), ctypes.c_size_t(size))


@pytest.mark.slow
@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.skipif(sys.platform != "linux", reason="needs memory that repeats itself")
def test_cells_hold_more_points_than_a_third_of_int32():
    starts, side = (ctypes.c_int32 * 126)(), ctypes.c_int64(5)
    corner = [ctypes.c_double(number) for number in (0, 0, 0, 1)]
    lengths = ctypes.c_int64(NUM_POINTS), ctypes.c_int64(len(starts))
    fill = kernels._library().fill_cells
    with contextlib.ExitStack() as stack:
        sizes = (24 * NUM_POINTS, 4 * NUM_POINTS, 4 * NUM_POINTS, 24 * NUM_POINTS)
        points, rows, cells, placed = (
            stack.enter_context(repeating_memory(size)) for size in sizes
        )
        assert fill(*lengths, points, starts, side, side, *corner, rows, cells, placed) == 0
    # All points are at zero, in the first cell that has one on every side.
    assert starts[31:33] == [0, NUM_POINTS]
