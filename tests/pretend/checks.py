"""What the pretend device refuses, and what a segmentation asks of it.

``tests/test_devices.py`` runs these tests in a process of their own, with ``--device pretend``.
"""

import pytest
import torch

import torchrg
from tests import pretend
from torchrg.errors import ShapeError
from torchrg.metrics import score_normals

X = torch.arange(6.0).to("pretend")
N = torch.arange(6).to("pretend")
REFUSED = {
    "mixed devices": lambda: X + torch.ones(6),
    "cat of mixed devices": lambda: torch.cat([X, torch.ones(6)]),
    "numpy": lambda: X.numpy(),
    "integer matrix product": lambda: N[None] @ N[:, None],
    "integer convolution": lambda: torch.conv1d(N.view(1, 1, 6), N[:3].view(1, 1, 3)),
    "integer segments": lambda: torch.segment_reduce(N, "sum", lengths=N[6:].new_tensor([6])),
    "generator of the CPU": lambda: torch.rand(3, generator=torch.Generator(), device="pretend"),
    "values on the CPU": lambda: X.index_put_((N,), torch.ones(6)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cuda_refuses_is_refused(name):
    with pytest.raises((RuntimeError, TypeError)):
        REFUSED[name]()


def test_what_cuda_allows_is_allowed():
    assert (X + torch.tensor(1.0)).device == X[torch.arange(6)].device == X.device


def test_the_watch_counts_what_a_device_does():
    with pretend.Watch() as watch:
        total = (X * 2).sum()
        total.item()
        X.cpu()
        torch.ones(3).to("pretend").nonzero()
    kinds = {name: watch.total(name) for name in pretend.KINDS}
    assert kinds == {
        "operators": 3,
        "to_cpu": 1,
        "to_device": 1,
        "items": 1,
        "waits": 1,
        "cpu_scalars": 0,
    }
    assert watch.bytes["to_cpu"] == 24


POINTS, NORMALS, NUMBERS = torch.rand(30, 3), torch.ones(30, 3), torch.zeros(30, dtype=torch.int64)
NEIGHBORS = torch.arange(30, dtype=torch.int32)[:, None].expand(-1, 3).contiguous()
MIXED = {
    "orient_normals": lambda n: torchrg.normals.orient_normals(POINTS, n(NORMALS)),
    "summarize_planes": lambda n: torchrg.regions.summarize_planes(POINTS, NORMALS, n(NUMBERS)),
    "find_sharp_points": lambda n: torchrg.normals.find_sharp_points(
        NORMALS, torchrg.structures.Neighbors(n(NEIGHBORS))
    ),
    "grow_regions": lambda n: torchrg.grow_regions(
        POINTS,
        NORMALS,
        POINTS[:, 0],
        torchrg.structures.Neighbors(NEIGHBORS),
        "classic",
        valid=n(NUMBERS == 0),
    ),
    "make_superpoints": lambda n: torchrg.make_superpoints(
        POINTS, torchrg.segment_planes(POINTS, "classic").to(n(NUMBERS).device)
    ),
    "fit_detmcd": lambda n: torchrg.robust.fit_detmcd(POINTS, n(NUMBERS == 0)),
    "score_normals": lambda n: score_normals(NORMALS, n(NORMALS)),
}


@pytest.mark.parametrize("name", MIXED)
def test_tensors_of_two_devices_are_refused_with_both_names(name):
    message = rf"^{name}: expected \w+ and \w+ on one device, got cpu and pretend:0; move"
    with pytest.raises(ShapeError, match=message):
        MIXED[name](lambda tensor: tensor.to("pretend"))


@pytest.mark.parametrize(
    ("preset", "max_round_trips", "max_operators"),
    [("classic", 90, 2300), ("consensus", 480, 29_000), ("paper", 150, 9000)],
)
def test_segmentations_ask_the_device_seldom(preset, max_round_trips, max_operators):
    points = torchrg.scenes.make_room(num_points=20_000, noise=0.003, seed=0).points.to("pretend")
    with pretend.Watch() as watch:
        torchrg.segment_planes(points, preset)
    assert watch.round_trips <= max_round_trips
    assert watch.operators <= max_operators
