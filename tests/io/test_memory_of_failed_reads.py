"""A file that a library cannot read gives back its memory, however often it is tried."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest

from tests.io.conftest import needs
from torchrg.errors import FormatError
from torchrg.io import read_cloud, write_cloud
from torchrg.structures import Cloud

NUM_POINTS = 2_000
NUM_READS = 150
MAX_KEPT_BYTES = 30_000_000
"""A fifth of a megabyte a read; a reader that is not given back takes some."""

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")


def resident_bytes():
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def damaged_files(whole):
    flipped = [bytearray(whole) for _ in range(4)]
    for data, place in zip(flipped, (0.02, 0.1, 0.5, 0.999), strict=True):
        data[int(len(data) * place)] ^= 4
    return [*map(bytes, flipped), whole[: len(whole) // 2], whole[:-1]]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", [".e57", ".las", ".laz"])
def test_failed_reads_keep_no_memory(tmp_path, suffix, request):
    needs(suffix)
    points = np.random.default_rng(0).random((NUM_POINTS, 3))
    write = request.getfixturevalue("write_scan") if suffix == ".e57" else write_cloud
    write(tmp_path / f"whole{suffix}", Cloud(points))
    paths = []
    for number, data in enumerate(damaged_files((tmp_path / f"whole{suffix}").read_bytes())):
        path = tmp_path / f"{number}{suffix}"
        path.write_bytes(data)
        try:
            read_cloud(path)
        except FormatError:
            paths.append(path)

    def fail(count):
        for number in range(count):
            with pytest.raises(FormatError):
                read_cloud(paths[number % len(paths)])

    fail(20)
    before = resident_bytes()
    fail(NUM_READS)
    assert resident_bytes() - before < MAX_KEPT_BYTES
