"""Functions of patches and the pipeline on a device give what they give on the CPU.

The tests of CUDA carry the marker ``cuda`` and are skipped where there is no device; none was at
hand when they were written. On ``--device pretend`` they run without one. What is compared with the
CPU asks for an ``accelerator``.
"""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torchrg
from tests import pretend
from tests.test_inputs import CALLS, PATCHES, argument
from torchrg.datasets import collate_offset
from torchrg.io.result import Result
from torchrg.linalg.moments import reduce_runs
from torchrg.metrics import score_clusters, score_labels, score_normals
from torchrg.normals import ESTIMATORS
from torchrg.render import make_page
from torchrg.transforms import SegmentDepth


@pytest.mark.parametrize("name", CALLS)
def test_results_are_those_of_the_cpu(name, accelerator):
    expected = CALLS[name](argument(name))
    found = CALLS[name](argument(name).to(accelerator))
    assert found.device.type == torch.device(accelerator).type
    assert found.dtype == expected.dtype
    if not found.is_floating_point():
        assert torch.equal(found.cpu(), expected)
        return
    # Sums run in another order; a sign, or one of two equal choices, may be another.
    close = torch.isclose(found.cpu().abs(), expected.abs(), rtol=1e-3, atol=1e-4, equal_nan=True)
    assert close.double().mean() > 0.98


@pytest.mark.parametrize("name", [name for name in PATCHES if name != "irls"])
def test_gradients_stay_on_their_device(name, accelerator):
    patches = argument(name).to(accelerator).requires_grad_()
    (PATCHES[name](patches) ** 2).sum().backward()
    assert patches.grad.device == patches.device
    assert patches.grad.isfinite().all()


@pytest.mark.parametrize("method", sorted(ESTIMATORS.keys() - {"consensus", "irls"}))
def test_gradients_of_clouds_stay_on_their_device(method, accelerator):
    points = argument("cloud").to(accelerator).requires_grad_()
    torchrg.estimate_normals(points, method=method, k=10).curvature.sum().backward()
    assert points.grad.device == points.device
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
def test_planes_are_those_of_the_cpu(preset, accelerator):
    room = torchrg.scenes.make_room(num_points=4000, noise=0.003, seed=0)
    expected = torchrg.segment_planes(room.points, preset)
    found = torchrg.segment_planes(room.points.to(accelerator), preset)
    assert found.labels.device.type == torch.device(accelerator).type
    assert (found.labels.cpu() == expected.labels).double().mean() > 0.98


def test_scores_are_those_of_the_cpu(accelerator, rng):
    labels, truth = torch.randint(-1, 9, (2, 500), generator=rng)
    normals, other = torch.randn(2, 500, 3, generator=rng, dtype=torch.float64)
    for score, arguments in (
        (score_labels, (labels, truth)),
        (score_clusters, (normals, labels)),
        (score_normals, (normals, other)),
    ):
        found = score(*(argument.to(accelerator) for argument in arguments))
        assert found == pytest.approx(score(*arguments), rel=1e-9)


def test_depth_is_that_of_the_cpu(accelerator):
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    depth = torch.full((1, 30, 40), 2.0)
    depth[..., 20:] = 3.0
    sample = {"depth": depth.to(accelerator), "intrinsics": camera.to(accelerator)}
    expected = SegmentDepth()({"depth": depth, "intrinsics": camera})["plane"]
    assert torch.equal(SegmentDepth()(sample)["plane"].cpu(), expected)


@pytest.mark.slow
@pytest.mark.skipif(
    pretend.missing_requirement() is not None, reason=f"needs {pretend.missing_requirement()}"
)
def test_a_pretend_device_gives_what_the_cpu_gives(pytestconfig):
    """Run this file and the checks of the device in another process.

    Torch has room for one device that is not its own, for good. Deadlocks end at the time limit.
    """
    checks = Path(pretend.__file__).with_name("checks.py")
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "--device", "pretend", __file__, checks]
    done = subprocess.run(
        command, cwd=pytestconfig.rootpath, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout[-3000:]


def gradient_by_grad(function, x):
    return torch.func.grad(lambda points: function(points).square().sum())(x)


def gradient_by_vmap(function, x):
    x = x.detach().requires_grad_()
    torch.vmap(function)(x).square().sum().backward()
    return x.grad


def gradient_by_compile(function, x):
    torch.compiler.reset()
    x = x.detach().requires_grad_()
    torch.compile(function, backend="aot_eager", fullgraph=True)(x).square().sum().backward()
    return x.grad


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("name", ["detmcd", "qn"])
@pytest.mark.parametrize("differentiate", [gradient_by_grad, gradient_by_vmap, gradient_by_compile])
def test_gradients_of_opaque_functions_are_those_of_the_cpu(name, differentiate, device):
    """A device has one backward thread, so a gradient within a gradient must not wait for it."""
    function = PATCHES[name] if name == "qn" else lambda x: torchrg.robust.fit_detmcd(x).location
    expected = differentiate(function, argument("qn"))
    found = differentiate(function, argument("qn").to(device))
    assert found.device.type == torch.device(device).type
    assert torch.allclose(found.cpu(), expected, atol=1e-6)


def test_jacobians_of_opaque_functions_are_those_of_the_cpu(accelerator):
    x = argument("qn")[0]
    expected = torch.func.jacrev(torchrg.robust.qn)(x)
    found = torch.func.jacrev(torchrg.robust.qn)(x.to(accelerator))
    assert torch.allclose(found.cpu(), expected, atol=1e-6)


@pytest.fixture
def seen(room, accelerator):
    """Points of a room on the CPU and on the accelerator, and their integer classes."""
    scene = room(3000)
    return scene.points, scene.points.to(accelerator), (scene.points[:, 0] > 0).long()


def same(found, expected):
    """Return whether a tensor of a device has the values of one of the CPU."""
    return found.dtype == expected.dtype and torch.allclose(
        found.cpu(), expected, atol=1e-5, equal_nan=True
    )


@pytest.mark.parametrize("options", [{"voxel": 0.1}, {"within": True}, {"sort": "area"}])
def test_options_of_segmentations_give_the_labels_of_the_cpu(options, seen, accelerator):
    points, on_device, classes = seen
    inside = {"within": classes} if "within" in options else options
    expected = torchrg.segment_planes(points, **inside)
    inside = {
        name: getattr(value, "to", lambda _, v=value: v)(accelerator)
        for name, value in inside.items()
    }
    found = torchrg.segment_planes(on_device, **inside)
    assert torch.equal(found.labels.cpu(), expected.labels)
    assert same(found.normals, expected.normals)
    assert same(found.planes.area, expected.planes.area)
    assert found.planes.area.device == found.labels.device == on_device.device


def test_superpoints_with_colors_are_those_of_the_cpu(seen):
    points, on_device, classes = seen
    colors = classes[:, None].expand(-1, 3).to(torch.uint8) * 200
    expected = torchrg.make_superpoints(points, colors=colors)
    found = torchrg.make_superpoints(on_device, colors=colors.to(on_device.device))
    assert found.labels.device == found.plane.device == on_device.device
    assert torch.equal(found.labels.cpu(), expected.labels)
    assert all(torch.equal(*pair) for pair in zip(found.cpu().levels, expected.levels, strict=True))


def test_transforms_of_batches_give_what_they_give_on_the_cpu(seen):
    points, on_device, _ = seen
    offset = torch.tensor([1000, 3000])
    transform = torchrg.transforms.SegmentPlanes(config="classic")
    expected = transform({"coord": points, "offset": offset})
    found = transform({"coord": on_device, "offset": offset.to(on_device.device)})
    assert torch.equal(found["plane"].cpu(), expected["plane"])
    batch = collate_offset([found, found])
    assert batch["plane"].device == batch["offset"].device == on_device.device
    assert batch["offset"].tolist() == [1000, 3000, 4000, 6000]


def test_segmentations_on_disk_are_those_of_the_device(seen, tmp_path, monkeypatch):
    monkeypatch.setattr(torchrg.scratch, "_MIN_BYTES", 2**10)
    points, on_device, _ = seen
    with torchrg.scratch.on_disk(tmp_path):
        found = torchrg.segment_planes(on_device, "classic").labels
    assert torch.equal(found.cpu(), torchrg.segment_planes(points, "classic").labels)


def test_results_of_a_device_are_shown(seen):
    points, on_device, _ = seen
    seg = torchrg.segment_planes(on_device, "classic")
    parts = torchrg.make_superpoints(on_device, seg)
    assert seg.show() is not None
    result = Result.from_segmentation(torchrg.Cloud(points.numpy()), seg, parts)
    assert make_page(result) is not None
    assert torch.equal(result.fields["labels"].long(), seg.labels.cpu())
    assert result.plane_of_superpoint.device == result.table.area.device == points.device


def test_metrics_of_modules_are_those_of_the_cpu(seen, accelerator):
    pytest.importorskip("torchmetrics")
    points, _, classes = seen
    expected = torchrg.metrics.score_partition(classes, classes % 3, points)
    found = torchrg.metrics.score_partition(
        *(x.to(accelerator) for x in (classes, classes % 3, points))
    )
    assert found == pytest.approx(expected)


def test_superpoints_move_to_a_device_and_back(device):
    one = torch.tensor([0, 0, 1])
    parts = torchrg.structures.Superpoints(one, torch.tensor([-1, -1]), (one // 2,))
    moved = parts.to(device)
    assert {moved.labels.device, moved.plane.device, moved.levels[0].device} == {
        torch.zeros(0, device=device).device
    }
    assert torch.equal(moved.cpu().levels[0], one // 2)


def test_autocast_of_the_device_changes_no_fit(accelerator):
    patches = argument("jet").to(accelerator)
    expected = torchrg.normals.fit_jet(patches).normals
    with torch.autocast(torch.device(accelerator).type, dtype=torch.bfloat16):
        found = torchrg.normals.fit_jet(patches).normals
    assert torch.equal(found, expected)


def test_reweighted_gradients_of_singular_patches_are_finite(device):
    """Half of the points of each patch lie on a line, and the others on a plane through it."""
    x = argument("qn").to(device)
    x[:, :, 2] = 0
    x[:, :9, 1] = 0
    x.requires_grad_()
    fit = torchrg.robust.fit_detmcd(x, inliers="reweighted")
    fit.location.sum().backward()
    assert x.grad.isfinite().all()


@pytest.mark.parametrize("how", ["sum", "min", "max"])
@pytest.mark.parametrize("kind", [torch.int64, torch.float32])
def test_runs_of_any_length_and_dtype_are_reduced(how, kind, device):
    values, counts = torch.tensor([3, 1, 2], dtype=kind), torch.tensor([2, 1])
    expected = {"sum": [4, 2], "min": [1, 2], "max": [3, 2]}[how]
    found = reduce_runs(values.to(device), counts.to(device), how)
    assert found.tolist() == expected
    assert found.dtype == kind
    assert len(reduce_runs(values[:0].to(device), counts[:0].to(device), how)) == 0
