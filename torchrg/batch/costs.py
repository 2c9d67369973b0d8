"""What converting a plan costs, told before it starts: disk, memory, hours."""

import time
from typing import Any, NamedTuple

import torch

from torchrg.batch.run import Plan
from torchrg.config import DepthConfig
from torchrg.depth import make_intrinsics, segment_depth
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.scenes import make_room

_TRIED = 20_000
"""Points of a made room on which the settings are timed: about a second for most of them."""
_IMAGE = (120, 160)
"""Height and width of the depth image on which they are timed."""


class Costs(NamedTuple):
    """About what a plan takes.

    Attributes:
        disk: Bytes of the results.
        memory: Bytes of memory of all scans that run at a time.
        workers: How many these are.
        seconds: Time of the whole plan on this machine, where it does nothing else.
    """

    disk: int
    memory: int
    workers: int
    seconds: float


def estimate_costs(plan: Plan, *, workers: int, limit: int) -> Costs:
    """Return about what the scans of a plan that are not done take.

    Time is that of the settings on a small made room, now and on this machine, in proportion to the
    numbers of points.

    Args:
        plan: The plan.
        workers: How many scans may run at a time.
        limit: Bytes of memory that they may take together.
    """
    jobs = plan.to_convert
    if not jobs:
        return Costs(0, 0, 0, 0.0)
    source = jobs[0].source
    num_points = sum(job.scan.num_points for job in jobs)
    memory, at_once = 0, 0
    for needed in sorted((job.memory for job in jobs), reverse=True)[:workers]:
        if at_once and memory + needed > limit:
            break
        memory, at_once = memory + needed, at_once + 1
    seconds = seconds_per_point(source.settings, superpoints=getattr(source, "superpoint", False))
    return Costs(
        source.bytes_per_point * num_points, memory, at_once, seconds * num_points / at_once
    )


def seconds_per_point(settings: Any, *, superpoints: bool = False) -> float:  # noqa: ANN401
    """Return the time of one thread for a point with these settings, measured now.

    Args:
        settings: Those of clouds, or of depth images; then a point is a pixel.
        superpoints: Whether superpoints of the cloud are made too.

    Example:
        >>> from torchrg.config import load_config
        >>> 1e-8 < seconds_per_point(load_config("classic")) < 1
        True
    """
    room = make_room(_TRIED, noise=0.003, seed=0).points
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 0.003 * torch.randn(_IMAGE, generator=generator)
    camera = make_intrinsics(_IMAGE[1], _IMAGE[1], _IMAGE[1] / 2, _IMAGE[0] / 2)

    def work(share: int) -> int:
        if isinstance(settings, DepthConfig):
            return segment_depth(depth[: _IMAGE[0] // share], camera, settings).labels.numel()
        seg = segment_planes(room[: _TRIED // share], settings)
        if superpoints:
            make_superpoints(room[: _TRIED // share], seg)
        return len(seg.labels)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        work(10)  # Loads what is imported late.
        begin = time.process_time()
        number = work(1)
        return (time.process_time() - begin) / number
    finally:
        torch.set_num_threads(threads)
