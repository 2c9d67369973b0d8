"""Write a cloud in the forms that the contenders read, in a process of its own.

    python -m peers.clouds "room 100000 random" FOLDER

What a program is said to have needed at most includes what its parent had when it started it, so
the parent has to stay small.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import torchrg
from torchrg.neighbors import canonical_order

SEED = 7


def read_points(cloud: str) -> NDArray[np.float32]:
    """Read a scan, or make a room in random order or in the order of a space-filling curve."""
    if not cloud.startswith("room "):
        points = torchrg.read_cloud(cloud).points
        return points[points.isfinite().all(dim=1)].float().numpy()
    _, size, order = cloud.split()
    points = torch.as_tensor(torchrg.scenes.make_room(int(size), 0.003, SEED).points).float()
    shuffled = torch.randperm(len(points), generator=torch.Generator().manual_seed(SEED))
    points = points[shuffled]
    return (points[canonical_order(points)] if order == "sorted" else points).numpy()


def main(cloud: str, folder: str) -> None:
    """Write ``cloud.npy`` and ``cloud.f32``."""
    points = read_points(cloud)
    np.save(Path(folder) / "cloud.npy", points)
    points.tofile(Path(folder) / "cloud.f32")


if __name__ == "__main__":
    main(*sys.argv[1:])
