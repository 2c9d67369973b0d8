"""Every public function of tensors works in a forked child of a process that has used it.

The parent has OpenMP threads, which a child does not inherit: an operation of the child that waits
for them never returns.
"""

import multiprocessing
import os

import pytest
import torch

from tests.calls import CLASSIC, calls, public_functions, segmented_room
from torchrg.transforms import SegmentPlanes

NUM_POINTS = 33_000
"""Above 32,768 values, an operation of torch uses several threads."""
SECONDS_UNTIL_HUNG = 120
# The parent has threads on purpose: that is what a fork must survive.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning"),
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks"),
]


def run_all(queue=None):
    """Call everything; put the names into a queue as they finish."""
    for name, call in calls(NUM_POINTS).items():
        call()
        if queue is not None:
            queue.put(name)


@pytest.fixture
def two_threads(set_threads):
    set_threads(2)
    # A new team of OpenMP threads, whatever the calls below use.
    torch.rand(NUM_POINTS * 10).sin_()


def test_every_public_function_is_called():
    assert public_functions() == calls(NUM_POINTS).keys() - {"collate_offset"}


def test_every_public_function_returns_in_a_forked_child(two_threads):
    run_all()
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=run_all, args=(queue,))
    child.start()
    child.join(SECONDS_UNTIL_HUNG)
    is_hung = child.is_alive()
    child.kill()
    done = []
    while not queue.empty():
        done.append(queue.get())
    assert not is_hung, f"waits after {done[-1:]}"
    assert child.exitcode == 0
    assert done == [*calls(NUM_POINTS)]


def test_hugging_face_maps_in_two_processes(two_threads):
    datasets = pytest.importorskip("datasets")
    points = segmented_room(NUM_POINTS)[0].points.numpy()
    rooms = datasets.Dataset.from_dict({"coord": [points] * 2}).with_format("torch")
    expected = SegmentPlanes(CLASSIC)(rooms[0])["plane"]
    mapped = rooms.map(SegmentPlanes(CLASSIC), num_proc=2)
    assert all(torch.equal(room["plane"], expected) for room in mapped)
