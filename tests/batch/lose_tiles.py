"""A Ray cluster of two nodes on this machine that loses one while a cloud is segmented in tiles.

Arguments: a ``.npy`` file, and the ``.npz`` file for labels and normals.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np

from torchrg.batch.ray_tasks import run_ray
from torchrg.batch.tiles import segmented_in_tiles
from torchrg.config import load_config
from torchrg.structures import Cloud


def main(source, result):
    """Segment, lose a node when the first normals are there, and write what came of it."""
    from ray.cluster_utils import Cluster

    small = {"num_cpus": 2, "object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=small)
    lost = cluster.add_node(num_cpus=2, object_store_memory=80_000_000)
    cluster.wait_for_nodes()
    nodes = [lost]

    def lose(stage, done, of):
        if nodes and stage == "normals" and done == 1:
            cluster.remove_node(nodes.pop(), allow_graceful=False)

    with segmented_in_tiles(
        [source],
        [Cloud(np.load(source))],
        result.with_suffix(".work"),
        load_config("paper"),
        tile_size=1500,
        start=partial(run_ray, memory_limit=10**10, address=cluster.address),
        on_stage=lose,
    ) as seg:
        np.savez(result, labels=seg.labels, normals=seg.normals)
    assert not nodes
    cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
