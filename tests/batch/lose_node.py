"""A Ray cluster of two nodes on this machine that loses one while scans are converted.

Argument: a folder to work in, where ``reports.json`` goes.
"""

import dataclasses
import json
import sys
from pathlib import Path

from torchrg.batch.ray_tasks import run_ray


def main(folder):
    """Convert, lose a node when both are at work, and write what came of it."""
    # Here, as the tests import every file of this folder.
    import faults
    from ray.cluster_utils import Cluster

    behaviors = {f"{i}_a": "sleep 2" for i in range(1, 7)} | {"9_b": "kill once", "8_c": "corrupt"}
    jobs = faults.make_jobs(folder, behaviors)
    small = {"num_cpus": 2, "object_store_memory": 80_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=small)
    lost = cluster.add_node(num_cpus=2, object_store_memory=80_000_000)
    cluster.wait_for_nodes()
    reports, is_lost = [], False
    for report in run_ray(jobs, memory_limit=10**10, address=cluster.address):
        if report is not None:
            reports.append(dataclasses.asdict(report))
        log = (folder / "log").read_text() if (folder / "log").exists() else ""
        sleeping = {line.split()[0] for line in log.splitlines()} - {"9_b", "8_c"}
        # Four CPUs: with three scans asleep, at least one is on the node that goes.
        if not is_lost and len(sleeping) >= 3:
            cluster.remove_node(lost, allow_graceful=False)
            is_lost = True
    assert is_lost
    cluster.shutdown()
    (folder / "reports.json").write_text(json.dumps(reports))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
