"""Angle errors of normals: known angles, loops, and normals that are not there."""

import math

import numpy as np
import pytest
import torch

from torchrg.errors import ShapeError
from torchrg.metrics import score_normals


def turned(ground_truth, degrees, rng):
    """Turn unit vectors by given angles about random axes across them."""
    axis = torch.randn(ground_truth.shape, generator=rng, dtype=torch.float64)
    across = torch.nn.functional.normalize(torch.linalg.cross(ground_truth, axis), dim=-1)
    angles = torch.deg2rad(degrees)[..., None]
    return angles.cos() * ground_truth + angles.sin() * across


@pytest.fixture
def ground_truth(rng):
    return torch.nn.functional.normalize(
        torch.randn(200, 3, generator=rng, dtype=torch.float64), dim=1
    )


@pytest.mark.parametrize("count", [1, 2, 5, 6, 200])
def test_indices_are_those_of_the_known_angles(rng, ground_truth, count):
    degrees = 90 * torch.rand(count, generator=rng, dtype=torch.float64) ** 3
    score = score_normals(turned(ground_truth[:count], degrees, rng), ground_truth[:count])
    known = degrees.numpy()
    assert score.msae == pytest.approx(np.mean(known**2), rel=1e-8)
    assert score.rms == pytest.approx(np.sqrt(np.mean(known**2)), rel=1e-8)
    assert score.mean == pytest.approx(np.mean(known), rel=1e-8)
    assert score.median == pytest.approx(np.median(known), rel=1e-8)
    assert score.under_5_deg == np.mean(known < 5)
    assert score.under_10_deg == np.mean(known < 10)
    assert score.under_20_deg == np.mean(known < 20)
    assert (score.points, score.invalid) == (count, 0)


def test_signs_and_lengths_do_not_matter(rng, ground_truth):
    normals = turned(ground_truth, torch.full((200,), 30.0).double(), rng)
    scale = torch.randn(2, 200, 1, generator=rng, dtype=torch.float64)
    score = score_normals(scale[0] * normals, 1e-200 * scale[1] * ground_truth)
    assert score.mean == pytest.approx(30, rel=1e-8)
    assert score.msae == pytest.approx(900, rel=1e-8)


@pytest.mark.parametrize("degrees", [1e-9, 1e-5, 0.01, 45.0, 89.9999999, 90.0])
def test_angles_of_any_size_are_accurate(rng, ground_truth, degrees):
    score = score_normals(
        turned(ground_truth, torch.full((200,), degrees).double(), rng), ground_truth
    )
    assert score.mean == pytest.approx(degrees, rel=1e-5, abs=1e-13)
    assert score.mean <= 90


def test_equal_normals_have_no_error_in_float32(ground_truth):
    # The arc cosine of a float32 product would be up to 0.03 degrees.
    assert score_normals(ground_truth.float(), ground_truth.float()).msae == 0


def test_bounds_are_not_included(monkeypatch):
    errors = torch.tensor([4.9, 5.0, 10.0, 19.9, 20.0], dtype=torch.float64)
    monkeypatch.setattr("torchrg.metrics.normals.unsigned_angle_deg", lambda *_: errors)
    score = score_normals(torch.ones(5, 3), torch.ones(5, 3))
    assert (score.under_5_deg, score.under_10_deg, score.under_20_deg) == (0.2, 0.4, 0.8)


def test_normals_that_are_not_there_are_left_out_and_counted(rng, ground_truth):
    normals = turned(ground_truth, torch.full((200,), 7.0).double(), rng)
    spoiled = normals.clone()
    spoiled[0] = 0
    spoiled[1, 2] = math.nan
    spoiled[2, 0] = math.inf
    valid = torch.ones(200, dtype=torch.bool)
    valid[3] = False
    score = score_normals(spoiled, ground_truth, valid=valid)
    assert score == score_normals(normals[4:], ground_truth[4:])._replace(invalid=4)


def test_points_without_a_true_normal_count_nowhere(ground_truth):
    unknown = ground_truth.clone()
    unknown[:3] = torch.tensor([[0.0, 0, 0], [math.nan, 0, 0], [0, math.inf, 0]])
    normals = ground_truth.clone()
    normals[0] = 0
    assert score_normals(normals, unknown) == score_normals(ground_truth[3:], ground_truth[3:])


@pytest.mark.parametrize("count", [0, 4])
def test_errors_over_no_point_are_nan(count):
    score = score_normals(torch.zeros(count, 3), torch.ones(count, 3))
    assert all(math.isnan(value) for value in score[:7])
    assert (score.points, score.invalid) == (0, count)


def test_normal_maps_are_accepted(ground_truth):
    grid = ground_truth.reshape(10, 20, 3)
    valid = torch.ones(10, 20, dtype=torch.bool)
    valid[3] = False
    flat = score_normals(ground_truth, ground_truth.roll(1, 0), valid=valid.reshape(-1))
    assert score_normals(grid, ground_truth.roll(1, 0).reshape(10, 20, 3), valid=valid) == flat


def test_numpy_and_mixed_precision_are_accepted(rng, ground_truth):
    normals = turned(ground_truth, torch.full((200,), 7.0).double(), rng)
    valid = np.arange(200) > 5
    score = score_normals(normals.float().numpy(), ground_truth, valid=valid)
    assert score.mean == pytest.approx(7, rel=1e-6)
    assert score.points == 194


def test_blocks_change_nothing(rng, ground_truth, monkeypatch):
    normals = turned(ground_truth, 90 * torch.rand(200, generator=rng, dtype=torch.float64), rng)
    whole = score_normals(normals, ground_truth)
    monkeypatch.setattr("torchrg.metrics.normals._CHUNK", 7)
    assert score_normals(normals, ground_truth) == whole


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"normals": torch.zeros(4, 2)}, r"normals of shape \(\*, 3\), got \(4, 2\)"),
        ({"normals": torch.zeros(5, 3)}, r"truth of shape \(\*, 3\) with \*=\(5,\), got \(4, 3\)"),
        ({"normals": torch.zeros(4, 3).int()}, "normals of float32 or float64, got int32"),
        ({"ground_truth": torch.zeros(4, 3).half()}, "truth of float32 or float64, got float16"),
        ({"valid": torch.zeros(4)}, "valid of bool, got float32"),
        ({"valid": torch.zeros(3) > 0}, r"valid of shape \(\*\) with \*=\(4,\), got \(3,\)"),
        ({"valid": [True] * 4}, "valid to be a tensor or a NumPy array, got list"),
        ({"normals": torch.zeros(4, 3, device="meta")}, "on one device, got meta and cpu"),
    ],
)
def test_input_that_does_not_fit_is_refused(arguments, message):
    whole = {"normals": torch.ones(4, 3), "ground_truth": torch.ones(4, 3), **arguments}
    with pytest.raises(ShapeError, match=f"score_normals: expected .*{message}"):
        score_normals(**whole)
