"""Functions of patches and the pipeline on a device give what they give on the CPU.

The tests of CUDA carry the marker ``cuda`` and are skipped where there is no device; none was at
hand when they were written.
"""

import pytest
import torch

import torchrg
from tests.test_inputs import CALLS, PATCHES, argument
from torchrg.metrics import score_clusters, score_labels, score_normals
from torchrg.normals import ESTIMATORS
from torchrg.transforms import SegmentDepth


@pytest.mark.parametrize("name", CALLS)
def test_results_are_those_of_the_cpu(name, device):
    expected = CALLS[name](argument(name))
    found = CALLS[name](argument(name).to(device))
    assert found.device.type == torch.device(device).type
    assert found.dtype == expected.dtype
    if not found.is_floating_point():
        assert torch.equal(found.cpu(), expected)
        return
    # Sums run in another order; a sign, or one of two equal choices, may be another.
    close = torch.isclose(found.cpu().abs(), expected.abs(), rtol=1e-3, atol=1e-4, equal_nan=True)
    assert close.double().mean() > 0.98


@pytest.mark.parametrize("name", [name for name in PATCHES if name != "irls"])
def test_gradients_stay_on_their_device(name, device):
    patches = argument(name).to(device).requires_grad_()
    (PATCHES[name](patches) ** 2).sum().backward()
    assert patches.grad.device == patches.device
    assert patches.grad.isfinite().all()


@pytest.mark.parametrize("method", sorted(ESTIMATORS.keys() - {"consensus", "irls"}))
def test_gradients_of_clouds_stay_on_their_device(method, device):
    points = argument("cloud").to(device).requires_grad_()
    torchrg.estimate_normals(points, method=method, k=10).curvature.sum().backward()
    assert points.grad.device == points.device
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
def test_planes_are_those_of_the_cpu(preset, device):
    room = torchrg.scenes.make_room(num_points=4000, noise=0.003, seed=0)
    expected = torchrg.segment_planes(room.points, preset)
    found = torchrg.segment_planes(room.points.to(device), preset)
    assert found.labels.device.type == torch.device(device).type
    assert (found.labels.cpu() == expected.labels).double().mean() > 0.98


def test_scores_are_those_of_the_cpu(device, rng):
    labels, truth = torch.randint(-1, 9, (2, 500), generator=rng)
    normals, other = torch.randn(2, 500, 3, generator=rng, dtype=torch.float64)
    for score, arguments in (
        (score_labels, (labels, truth)),
        (score_clusters, (normals, labels)),
        (score_normals, (normals, other)),
    ):
        found = score(*(argument.to(device) for argument in arguments))
        assert found == pytest.approx(score(*arguments), rel=1e-9)


def test_depth_is_that_of_the_cpu(device):
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    depth = torch.full((1, 30, 40), 2.0)
    depth[..., 20:] = 3.0
    sample = {"depth": depth.to(device), "intrinsics": camera.to(device)}
    expected = SegmentDepth()({"depth": depth, "intrinsics": camera})["plane"]
    assert torch.equal(SegmentDepth()(sample)["plane"].cpu(), expected)
