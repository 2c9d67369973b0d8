"""Float64 clouds: where float32 is fine enough, they are computed like float32 ones."""

from pathlib import Path

import numpy as np
import pytest
import torch

import torchrg
from torchrg import kernels
from torchrg.linalg.precision import coordinate_resolution, flatness_tolerance, is_single, to_single
from torchrg.neighbors import search_knn
from torchrg.scenes import make_room

UTM = torch.tensor([440_000.0, 5_400_000.0, 300.0], dtype=torch.float64)
FITTED = {"fit_normals_pca", "pass_edges"}
"""Kernels of normals and growth that take float32 alone."""


@pytest.fixture(scope="module")
def room():
    return make_room(2000, noise=0.003, seed=4).points


def test_a_near_cloud_keeps_its_values_and_a_far_one_its_differences(room):
    assert torch.equal(to_single(room.double()), room)
    far = room.double() + UTM
    single = to_single(far)
    assert single.dtype == torch.float32
    offsets, expected = single.double() - single[:1].double(), far - far[:1]
    # Coordinates below 8 m are rounded by up to 2^-22 m.
    assert float((offsets - expected).abs().max()) <= 1.01 * 2.0**-21


@pytest.mark.parametrize(
    "change",
    [
        lambda points: points.float(),
        lambda points: points.requires_grad_(),
        lambda points: torch.cat([points, torch.full((1, 3), 1e7)]),
        lambda points: points * 1e13,
        lambda points: points * 1e-13,
        lambda points: points[:0],
        lambda points: points[:1].repeat(5, 1),
        lambda points: torch.cat([points, points.new_full((1, 3), torch.nan)]),
    ],
)
def test_other_points_are_unchanged(room, change):
    points = change(room.double())
    assert to_single(points) is points


@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
@pytest.mark.parametrize("offset", [0.0, UTM], ids=["near", "far"])
def test_labels_of_float64_are_those_of_float32(room, preset, offset):
    single, double = (
        torchrg.segment_planes(points, preset) for points in (room, room.double() + offset)
    )
    assert torch.equal(single.labels, double.labels)
    for values in (double.normals, double.curvature, double.planes.normal, double.planes.rms):
        assert values.dtype == torch.float64
    cosine = (double.normals * single.normals).sum(dim=1).abs()
    assert float(cosine[double.valid].min()) > 1 - 1e-4
    lengths = double.normals[double.valid].norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones_like(lengths), rtol=1e-6, atol=0)
    # The table is that of the exact points.
    first = double.labels == 0
    distances = (room[first].double() + offset) @ double.planes.normal[0] - double.planes.offset[0]
    assert float(distances.square().mean().sqrt()) == pytest.approx(float(double.planes.rms[0]))


def doors(points):
    """Each public function that fits or grows, by its name."""
    fit = torchrg.estimate_normals(points, method="pca", k=20)
    neighbors = search_knn(points, 20)
    columns = points, fit.normals.to(points), fit.curvature.to(points)
    rms = fit.residual_rms.to(points)
    return {
        "estimate_normals": lambda: torchrg.estimate_normals(points, method="pca", k=20),
        "its neighbors": lambda: torchrg.estimate_normals(
            points, method="pca", neighbors=neighbors
        ),
        "grow_regions": lambda: torchrg.grow_regions(*columns, neighbors, residual_rms=rms),
        "segment_planes": lambda: torchrg.segment_planes(points, "classic"),
        "a transform": lambda: torchrg.transforms.EstimateNormals(method="pca", k=20)(
            {"coord": points}
        ),
        "make_superpoints": lambda: torchrg.make_superpoints(points),
    }


@pytest.mark.skipif(kernels.name_of_library() is None, reason="without kernels")
@pytest.mark.parametrize("offset", [0.0, UTM], ids=["near", "far"])
@pytest.mark.parametrize("name", doors(torch.rand(30, 3)))
def test_every_door_runs_kernels_on_float64(room, monkeypatch, name, offset):
    call, called = doors(room.double() + offset)[name], set()
    run = kernels.call

    def record(kernel, *arguments):
        called.add(kernel)
        return run(kernel, *arguments)

    monkeypatch.setattr(kernels, "call", record)
    call()
    assert called & FITTED


def test_points_closer_than_the_steps_of_float32_are_still_two(room):
    twins = torch.cat([room.double(), room.double() + 1e-9])
    seg = torchrg.segment_planes(twins, "classic")
    assert seg.num_copies == 0
    assert torch.equal(*seg.labels.view(2, -1))
    assert torch.isfinite(seg.normals).all()


def test_gradients_keep_the_precision_of_the_points(room):
    points = room[:400].double().requires_grad_()
    fit = torchrg.estimate_normals(points, method="pca", k=20)
    exact = np.linalg.svd(_patch(points.detach(), 7))[2][2]
    cosine = abs(float(fit.normals[7].detach() @ torch.from_numpy(exact)))
    assert cosine == pytest.approx(1, abs=1e-14)
    fit.curvature.sum().backward()
    assert points.grad.dtype == torch.float64


def _patch(points, row):
    patch = points[search_knn(points, 20).indices[row].long()].numpy()
    return patch - patch.mean(axis=0)


PACKAGE = Path(__file__).parents[2] / "torchrg"
# The largest number that a file can hold.
MAY_ASK_FOR_PRECISION = {"datasets/s3dis.py"}


def test_tolerance_of_a_plane_grows_with_the_distance_from_the_origin(dtype):
    near = flatness_tolerance(torch.ones(1, 5, 3, dtype=dtype), torch.ones(1, dtype=dtype))
    far = flatness_tolerance(torch.full((1, 5, 3), 1e4, dtype=dtype), torch.ones(1, dtype=dtype))
    assert 9 < near / torch.finfo(dtype).eps < 11
    assert 1e3 < far / near < 1e4


def test_tolerances_stand_here_alone():
    asking = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if "finfo" in path.read_text() and path.parent.name != "linalg"
    }
    assert asking <= MAY_ASK_FOR_PRECISION


def test_coordinate_resolution_by_example():
    assert repr(coordinate_resolution(torch.tensor([[0.0, -2.0, 1.0]])) < 1e-6) == "tensor([True])"


def test_is_single_by_example():
    assert is_single(torch.tensor([0.1, torch.nan]).double())
    assert not is_single(torch.tensor([0.1], dtype=torch.float64))
