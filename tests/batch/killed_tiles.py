"""Segment a cloud in tiles, and kill this process by SIGKILL when it has written so many arrays.

Arguments: a ``.npy`` file, a working directory, how many writes to live for (0: for ever).
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np

from torchrg.config import load_config
from torchrg.pipeline import segment_planes
from torchrg.structures import Cloud
from torchrg.tiles import TileStore, TileTask


def main(path, folder, writes):
    """Segment, and note each tile that is done in a log beside the folder."""
    write, run, left = TileStore.write, TileTask.run, [writes]

    def counted_write(files, *given):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        write(files, *given)

    def noted_run(task):
        written = run(task)
        with Path(f"{folder}.log").open("a") as log:
            log.write(f"{task.name}\n")
        return written

    TileStore.write, TileTask.run = counted_write, noted_run
    points = np.load(path)
    seg = segment_planes(
        [Cloud(points)], load_config("classic"), store=TileStore(folder, tile_size=600)
    )
    np.savez(f"{folder}.npz", labels=seg.labels, normals=seg.normals, area=seg.planes.area)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
