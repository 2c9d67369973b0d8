"""The internal indices against closed forms and against the printed equations in loops."""

import math

import numpy as np
import pytest
import torch

from tests.metrics.sphere_clusters import indices_by_loops, scattered
from torchrg.errors import ConfigError, ShapeError
from torchrg.metrics import score_clusters

INDICES = ("cp", "sp", "dbi", "dvi")


def indices(score):
    return {name: getattr(score, name) for name in INDICES}


@pytest.mark.parametrize("spread", [0.01, 0.2, 1.0])
@pytest.mark.parametrize("sizes", [[1, 7], [20, 3, 12], [9, 9, 9, 9, 9, 2]])
def test_indices_are_those_of_the_printed_equations(rng, sizes, spread):
    directions, labels = scattered(rng, sizes, spread)
    expected = indices_by_loops(directions, labels)
    assert indices(score_clusters(directions, labels)) == pytest.approx(expected, rel=1e-7)


def test_exact_parallel_walls_give_the_limits():
    normals = torch.eye(3)[[0, 0, 1, 1, 0]] * torch.tensor([1, -1, 1, 1, -1])[:, None]
    score = score_clusters(normals, torch.tensor([4, 4, 6, 6, 9]))
    assert indices(score) == pytest.approx(
        {"cp": 0, "sp": math.pi / 3, "dbi": math.inf, "dvi": 0}, abs=1e-12
    )


def test_rounding_does_not_tell_parallel_walls_apart():
    # Exact walls of one direction whose normals were rounded differently, and another direction.
    wall = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    normals = torch.cat([wall, wall + 1e-15 * torch.eye(3)[:1], wall.roll(1)]).repeat(50, 1)
    score = score_clusters(normals, torch.arange(3).repeat(50))
    assert score.dvi == 0
    assert score.dbi == math.inf


def test_exact_planes_of_distinct_directions_are_infinitely_separate():
    score = score_clusters(torch.eye(3)[[0, 0, 1, 1]], torch.tensor([0, 0, 1, 1]))
    assert (score.cp, score.dbi, score.dvi) == (0, 0, math.inf)
    assert score.sp == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("distinct", [False, True])
def test_scores_do_not_depend_on_order_signs_length_or_names(rng, distinct):
    directions, labels = scattered(rng, [30, 40, 50, 5], 0.1)
    score = score_clusters(directions, labels, distinct_directions=distinct)
    order = torch.randperm(len(labels), generator=rng)
    scale = torch.randn(len(labels), 1, generator=rng, dtype=torch.float64)
    other = score_clusters(
        (scale * directions)[order], 90 - 7 * labels[order], distinct_directions=distinct
    )
    assert indices(other) == pytest.approx(indices(score), rel=1e-9)


def test_scores_do_not_depend_on_the_chunks(rng, monkeypatch):
    directions, labels = scattered(rng, [30, 40, 50, 5], 0.3)
    score = score_clusters(directions, labels)
    for max_pairs in (1, 7, 1000):
        monkeypatch.setattr("torchrg.metrics.sphere._MAX_PAIRS", max_pairs)
        other = score_clusters(directions, labels)
        assert indices(other) == pytest.approx(indices(score), rel=1e-12)


def test_tiny_spreads_are_right(rng):
    # An arc cosine of products would give 1e-8 for all of these.
    directions, labels = scattered(rng, [40, 40], 1e-11, axes=torch.eye(3)[:2])
    big, _ = scattered(torch.Generator().manual_seed(0), [40, 40], 1e-4, axes=torch.eye(3)[:2])
    small, wide = score_clusters(directions, labels), score_clusters(big, labels)
    assert small.cp == pytest.approx(wide.cp * 1e-7, rel=0.01)
    assert small.dvi == pytest.approx(wide.dvi * 1e7, rel=0.01)


def test_float32_normals_score_as_float64(rng):
    directions, labels = scattered(rng, [30, 40, 50], 0.2)
    score = score_clusters(directions.float(), labels)
    assert indices(score) == pytest.approx(indices(score_clusters(directions, labels)), rel=1e-5)
    assert score_clusters(directions.float().numpy(), labels.numpy()) == score


def test_large_clusters_are_sampled_and_it_is_reported(rng):
    directions, labels = scattered(rng, [600, 50], 0.05, axes=torch.eye(3)[:2])
    full = score_clusters(directions, labels)
    score = score_clusters(directions, labels, sample_size=200, seed=3)
    assert (full.sampled_clusters, full.dvi_exact) == (0, True)
    assert score.sampled_clusters == 1
    assert (score.cp, score.sp, score.dvi) == (full.cp, full.sp, full.dvi)
    assert score.dvi_exact
    assert score.dbi != full.dbi
    assert score.dbi == pytest.approx(full.dbi, rel=0.1)


def test_a_sampled_diameter_is_reported():
    rng = torch.Generator().manual_seed(0)
    directions, labels = scattered(rng, [600, 50], 3.0)
    assert not score_clusters(directions, labels, sample_size=100).dvi_exact


def test_the_sample_depends_on_the_seed_alone(rng):
    directions, labels = scattered(rng, [600, 50], 0.05, axes=torch.eye(3)[:2])
    order = torch.randperm(650, generator=rng)
    scores = [
        score_clusters(directions, labels, sample_size=200, seed=1),
        score_clusters(-directions[order], labels[order], sample_size=200, seed=1),
        score_clusters(directions, labels, sample_size=200, seed=2),
    ]
    assert scores[1].dbi == pytest.approx(scores[0].dbi, rel=1e-12)
    assert scores[2].dbi != pytest.approx(scores[0].dbi, rel=1e-6)


def test_points_without_a_normal_are_left_out_and_counted(rng):
    directions, labels = scattered(rng, [30, 40], 0.2)
    bad = torch.tensor([[0.0, 0, 0], [math.nan, 0, 1], [math.inf, 0, 0], [1, 0, 0]])
    score = score_clusters(
        torch.cat([directions, bad]), torch.cat([labels, torch.tensor([0, 1, 8, -1])])
    )
    expected = score_clusters(directions, labels)
    assert score == expected._replace(invalid=3)
    assert (score.points, score.clusters) == (70, 2)


def test_small_clusters_count_as_unlabelled(rng):
    directions, labels = scattered(rng, [30, 5, 40], 0.2)
    kept = labels != 1
    assert score_clusters(directions, labels, min_size=6) == score_clusters(
        directions[kept], labels[kept]
    )


@pytest.mark.parametrize(("labels", "clusters"), [([], 0), ([-1, -1], 0), ([5], 1), ([5, 5], 1)])
@pytest.mark.parametrize("distinct", [False, True])
def test_fewer_than_two_clusters_have_no_separation(labels, clusters, distinct):
    normals = torch.ones(len(labels), 3)
    score = score_clusters(
        normals, torch.tensor(labels, dtype=torch.int64), distinct_directions=distinct
    )
    assert score.clusters == clusters
    assert all(math.isnan(value) for value in (score.sp, score.dbi, score.dvi))
    assert score.cp == 0 if clusters else math.isnan(score.cp)


@pytest.mark.parametrize(
    ("normals", "labels", "message"),
    [
        (torch.zeros(4, 2), torch.zeros(4).long(), r"normals of shape \(N, 3\), got \(4, 2\)"),
        (torch.zeros(4, 3), torch.zeros(3).long(), r"labels of shape \(N\) with N=4, got \(3,\)"),
        (torch.zeros(4, 3), torch.zeros(4), "integer labels, got float32"),
        (torch.zeros(4, 3).long(), torch.zeros(4).long(), "normals of float32 or float64"),
        (np.zeros((4, 3), dtype="U1"), torch.zeros(4).long(), "normals to be a tensor or a NumPy"),
        (torch.zeros(4, 3, device="meta"), torch.zeros(4).long(), "on one device, got meta and"),
    ],
)
def test_input_that_does_not_fit_is_refused(normals, labels, message):
    with pytest.raises(ShapeError, match=f"score_clusters: expected .*{message}"):
        score_clusters(normals, labels)


@pytest.mark.parametrize(
    ("setting", "value", "requirement"),
    [
        ("min_size", 0, ">= 1"),
        ("sample_size", 1, ">= 2"),
        ("max_angle_deg", -1.0, r"in \[0, 90\]"),
    ],
)
def test_settings_out_of_range_are_refused(setting, value, requirement):
    with pytest.raises(
        ConfigError, match=f"score_clusters: expected {setting} {requirement}, got {value}"
    ):
        score_clusters(torch.eye(3), torch.arange(3), **{setting: value})
