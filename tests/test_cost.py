"""The cost of a point does not grow with the cloud: chunks work on their own points alone."""

import dataclasses
import traceback
from collections import Counter
from pathlib import Path

import pytest
from torch.utils._python_dispatch import TorchDispatchMode

import torchrg
from torchrg.config import load_config
from torchrg.normals import ESTIMATORS, estimate_normals
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room

NUM_POINTS = 509
"""A prime, which the rows of no chunk come to by chance."""


ROOT = str(Path(torchrg.__file__).parent)


class WholeCloudOperations(TorchDispatchMode):
    """Counts by place in the code the operations whose new result has a row for every point."""

    def __init__(self):
        super().__init__()
        self.places = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        results = result if isinstance(result, tuple | list) else [result]
        is_new = not function.is_view and not function._schema.is_mutable
        if is_new and any(NUM_POINTS in getattr(tensor, "shape", ()) for tensor in results):
            calls = ((frame.f_code.co_filename, line) for frame, line in traceback.walk_stack(None))
            self.places[next(call for call in calls if call[0].startswith(ROOT))] += 1
        return result


@pytest.fixture(autouse=True)
def one_thread(set_threads):
    """Operations of other threads would not be seen."""
    set_threads(1)


def segment(points, preset, chunk_size):
    segment_planes(points, dataclasses.replace(load_config(preset), chunk_size=chunk_size))


def estimate(points, method, chunk_size):
    config = dataclasses.replace(load_config("classic").normals, method=method, k=20)
    estimate_normals(points, config=config, chunk_size=chunk_size)


@pytest.mark.parametrize(
    ("work", "name"),
    [(segment, preset) for preset in ("classic", "paper", "consensus")]
    # The methods that take long run on the same code as a shorter one.
    + [
        (estimate, method)
        for method in ESTIMATORS
        if method not in ("fastmcd", "mve", "detmm", "irls")
    ],
)
def test_more_chunks_are_no_more_operations_on_the_whole_cloud(work, name):
    points = make_room(NUM_POINTS, 0.003, 0).points
    places = []
    for chunk_size in (NUM_POINTS - 1, 100):
        with WholeCloudOperations() as counted:
            work(points, name, chunk_size)
        places.append(counted.places)
    assert not places[1] - places[0]
