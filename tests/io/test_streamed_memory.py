"""Reading and writing in chunks takes the memory of chunks, however long the file is."""

import subprocess
import sys

import numpy as np
import pytest

from torchrg.io import FORMATS, write_cloud
from torchrg.structures import Cloud

NUM_POINTS = 2_000_000
CHUNK_SIZE = 50_000
MOST_BYTES = 40_000_000
"""Some chunks; the cloud itself has 28 bytes a point, 56 MB, and reading it whole takes twice that
and more."""
SCRIPT = """
import resource, sys
from torchrg.io import stream_cloud, write_cloud
small, large, out = sys.argv[1:]
def pass_through(path):
    write_cloud(out, stream_cloud(path, chunk_size={chunk}))
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
pass_through(small)
before = peak()
pass_through(large)
print(peak() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="units of the peak differ elsewhere")
@pytest.mark.parametrize("suffix", list(FORMATS))
def test_memory_does_not_grow_with_the_file(tmp_path, suffix):
    pytest.importorskip({".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy"))
    rng = np.random.default_rng(0)
    num_points = NUM_POINTS // 4 if suffix in (".xyz", ".txt") else NUM_POINTS
    fields = {"intensity": rng.random(num_points, np.float32)}
    points = rng.random((num_points, 3))
    paths = [tmp_path / f"{size}{suffix}" for size in ("small", "large", "out")]
    few = slice(2 * CHUNK_SIZE)
    write_cloud(paths[0], Cloud(points[few], {"intensity": fields["intensity"][few]}))
    write_cloud(paths[1], Cloud(points, fields))
    script = SCRIPT.format(chunk=CHUNK_SIZE)
    command = [sys.executable, "-c", script, *map(str, paths)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(run.stdout) < MOST_BYTES * num_points / NUM_POINTS
