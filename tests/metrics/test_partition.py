"""Scores of superpoints against a count by loops, and by hand."""

from collections import Counter

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError, ShapeError
from torchrg.metrics import PartitionScore, score_partition


def counted_oracle(superpoints, ground_truth, ignored):
    """ASA and mean IoU point by point."""
    scored = [i for i in range(len(ground_truth)) if ground_truth[i] not in ignored]
    parts = sorted({ground_truth[i] for i in scored})
    given = {}
    for superpoint in {superpoints[i] for i in scored} - {-1}:
        votes = Counter(ground_truth[i] for i in scored if superpoints[i] == superpoint)
        given[superpoint] = min(votes, key=lambda part: (-votes[part], part))
    found = {i: given.get(superpoints[i]) for i in scored}
    right = sum(found[i] == ground_truth[i] for i in scored)
    ious = []
    for part in parts:
        both = sum(found[i] == part and ground_truth[i] == part for i in scored)
        either = sum(found[i] == part or ground_truth[i] == part for i in scored)
        ious.append(both / either)
    return right / len(scored), sum(ious) / len(parts)


def counted_borders(superpoints, ground_truth, points, distance):
    """Recall and precision of borders from all distances."""
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = np.argsort(away, axis=1, kind="stable")[:, 1:9]
    ours, theirs = (
        [i for i in range(len(points)) if any(labels[j] != labels[i] for j in nearest[i])]
        for labels in (superpoints, ground_truth)
    )
    recall = np.mean([min(away[i, j] for j in ours) <= distance for i in theirs])
    precision = np.mean([min(away[i, j] for j in theirs) <= distance for i in ours])
    return recall, precision


@pytest.mark.parametrize("seed", range(4))
def test_scores_are_those_of_an_independent_count(seed):
    rng = np.random.default_rng(seed)
    points = rng.random((300, 3)) * [1, 1, 0.01]
    ground_truth = (points[:, 0] * 4).astype(int) + (rng.random(300) < 0.02)
    superpoints = (points[:, 0] * 5).astype(int) * 3 + (points[:, 1] * 3).astype(int) - 1
    score = score_partition(superpoints, ground_truth, points, boundary_distance=0.03)
    asa, miou = counted_oracle(superpoints.tolist(), ground_truth.tolist(), ())
    recall, precision = counted_borders(superpoints, ground_truth, points, 0.03)
    assert (score.asa, score.oracle_miou) == pytest.approx((asa, miou), rel=1e-12)
    assert score.boundary_recall == pytest.approx(recall, rel=1e-12)
    assert score.boundary_precision == pytest.approx(precision, rel=1e-12)
    assert 0 < precision < 1
    assert 0 < recall < 1
    assert score.count == len(set(superpoints.tolist()) - {-1})
    hidden = score_partition(superpoints, np.where(ground_truth == 2, -1, ground_truth), ignore=1)
    asa, miou = counted_oracle(superpoints.tolist(), ground_truth.tolist(), (1, 2))
    assert (hidden.asa, hidden.oracle_miou) == pytest.approx((asa, miou), rel=1e-12)
    assert hidden.boundary_recall is hidden.boundary_distance is None
    assert hidden.points == (~np.isin(ground_truth, (1, 2))).sum()


def test_the_truth_itself_and_single_points_are_perfect(rng):
    points = torch.rand(200, 3, generator=rng)
    ground_truth = (points[:, 0] > 0.5).long()
    score = score_partition(ground_truth, ground_truth, points)
    assert score[:4] == (1.0, 1.0, 1.0, 1.0)
    assert (score.count, score.points_per_superpoint) == (2, 100.0)
    assert score_partition(torch.arange(200), ground_truth, points)[:3] == (1.0, 1.0, 1.0)


def test_a_point_of_no_superpoint_is_wrong():
    score = score_partition(torch.tensor([-1, 0, 0]), torch.tensor([4, 4, 4]))
    assert score.asa == score.oracle_miou == pytest.approx(2 / 3)
    assert (score.count, score.points_per_superpoint, score.points) == (1, 2.0, 3)


def test_nothing_scored_gives_zero():
    empty = torch.zeros(0, dtype=torch.int64)
    assert score_partition(empty, empty, torch.zeros(0, 3))[:4] == (0.0,) * 4
    nothing = score_partition(torch.tensor([0, 1]), torch.tensor([-1, -1]))
    assert nothing == PartitionScore(0.0, 0.0, None, None, None, 2, 1.0, 0)


def test_points_that_are_not_finite_are_at_no_border():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [torch.nan, 0, 0], [2, 0, 0]])
    labels = torch.tensor([0, 0, 1, 0])
    assert score_partition(labels, labels, points)[:4] == (1.0, 1.0, 0.0, 0.0)


def test_arguments_are_checked():
    labels = torch.tensor([0, 1])
    with pytest.raises(ConfigError, match="boundary_distance > 0, got 0"):
        score_partition(labels, labels, boundary_distance=0)
    with pytest.raises(ShapeError, match="score_partition: expected points of shape"):
        score_partition(labels, labels, torch.zeros(2, 2))
    with pytest.raises(ShapeError, match="score_partition: expected ground_truth"):
        score_partition(labels, torch.zeros(3, dtype=torch.int64))


def row_of_points(count):
    """Points a meter apart: those that have a border within four places are at it."""
    return torch.arange(float(count))[:, None] * torch.tensor([1.0, 0, 0])


@pytest.mark.parametrize(("distance", "fraction"), [(1.0, 1.0), (0.99, 0.875)])
def test_borders_agree_up_to_the_distance_and_at_it(distance, fraction):
    places = torch.arange(40)
    score = score_partition(
        (places >= 21).long(), (places >= 20).long(), row_of_points(40), boundary_distance=distance
    )
    assert (score.boundary_recall, score.boundary_precision) == (fraction, fraction)


def test_borders_among_points_that_are_not_scored_do_not_count():
    ground_truth = torch.tensor([0] * 10 + [1] * 10 + [-1] * 20)
    superpoints = torch.tensor([0] * 10 + [1] * 20 + [2] * 10)
    score = score_partition(superpoints, ground_truth, row_of_points(40), boundary_distance=0.5)
    assert (score.boundary_recall, score.boundary_precision) == (1, 1)
