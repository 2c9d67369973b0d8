"""Segment a cloud in tiles with the command, which is killed at random moments, again and again.

Arguments: a cloud, a folder for its result and the work, how often, a seed. Each process is a fork
of this one, so that nothing is loaded twice. Prints how often it ended well, and fails where the
result is then another one than that of a run that nobody has disturbed, or anything else is left.
"""

import os
import random
import signal
import sys
import time
from pathlib import Path

from torchrg.cli import main as torchrg
from torchrg.cli import segment

TILE_SIZE = 600
"""Points. Smaller than memory would make them, so that a small cloud has several."""


def start(arguments):
    """Start the command in a process of its own, and return its number."""
    number = os.fork()
    if number == 0:
        os.close(1)
        os.open(os.devnull, os.O_WRONLY)
        os._exit(torchrg(arguments))
    return number


def main(cloud, folder, kills, seed):
    """Kill, go on, compare."""
    segment.choose_tile_size = lambda num_points, limit: TILE_SIZE
    segment.memory_of_scan = lambda num_points: sys.maxsize
    rng, result = random.Random(seed), folder / "result.npz"
    arguments = ["segment", cloud, "--out", str(result), "--preset", "classic"]
    arguments += ["--workdir", str(folder / "work")]
    begin = time.perf_counter()
    assert os.waitpid(start(arguments), 0)[1] == 0
    seconds, expected, ended_well = time.perf_counter() - begin, result.read_bytes(), 0
    while kills:
        process = start(arguments)
        time.sleep(rng.uniform(0, seconds))
        os.kill(process, signal.SIGKILL)
        status = os.waitpid(process, 0)[1]
        if os.WIFSIGNALED(status):
            kills -= 1
            continue
        assert os.WEXITSTATUS(status) == 0
        check(folder, expected)
        ended_well += 1
        result.unlink()
    assert os.waitpid(start(arguments), 0)[1] == 0
    check(folder, expected)
    sys.stdout.write(f"{ended_well + 1}\n")


def check(folder, expected):
    """Check that there is the result, and nothing beside it."""
    assert (folder / "result.npz").read_bytes() == expected
    assert {path.name for path in folder.rglob("*")} == {"result.npz", "work"}


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
