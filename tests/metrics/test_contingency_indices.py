"""Agreement of labellings against scikit-learn and against loops."""

import pytest
import torch
from sklearn.metrics import adjusted_rand_score

from torchrg.metrics import adjusted_rand_index, contingency_table, segmentation_covering
from torchrg.metrics.contingency import ContingencyTable


def pairs_of_labels():
    rng = torch.Generator().manual_seed(3)
    for count, ours, true in ((2, 2, 2), (10, 3, 4), (200, 1, 6), (200, 30, 4), (5000, 60, 60)):
        yield torch.randint(-1, ours, (2, count), generator=rng) % (true + 1) - 1
    ground_truth = torch.randint(-1, 20, (3000,), generator=rng)
    yield torch.stack(
        [torch.where(torch.rand(3000, generator=rng) < 0.2, -1, ground_truth), ground_truth]
    )
    yield torch.stack([ground_truth, ground_truth])
    yield torch.stack([ground_truth // 2, ground_truth])
    degenerate = [
        ([], []),
        ([0], [5]),
        ([-1], [5]),
        ([0, 0, 0], [1, 1, 1]),
        ([-1, -1, -1], [-1, -1, -1]),
        ([-1, -1, -1], [0, 0, 1]),
        ([0, 1, 2], [0, 0, 0]),
        ([0, 1, 2], [2, 1, 0]),
    ]
    yield from (torch.tensor(pair, dtype=torch.int64) for pair in degenerate)


@pytest.mark.filterwarnings("ignore:The number of unique classes:UserWarning")
@pytest.mark.parametrize(("labels", "ground_truth"), list(pairs_of_labels()))
def test_adjusted_rand_index_is_that_of_scikit_learn(labels, ground_truth):
    table = contingency_table(labels, ground_truth)
    expected = adjusted_rand_score(ground_truth.numpy(), labels.numpy())
    assert adjusted_rand_index(table) == pytest.approx(expected, abs=1e-12)


def test_rand_index_of_billions_of_points_does_not_overflow():
    # Two regions, two faces, each overlap a quarter of 4e9 points: independent labellings.
    quarter = torch.full((4,), 10**9)
    table = ContingencyTable(
        region_labels=torch.arange(2),
        face_labels=torch.arange(2),
        region_sizes=quarter[:2] * 2,
        face_sizes=quarter[:2] * 2,
        regions=torch.tensor([0, 0, 1, 1]),
        faces=torch.tensor([0, 1, 0, 1]),
        overlaps=quarter,
        num_points=4 * 10**9,
    )
    assert adjusted_rand_index(table) == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_covering_is_the_sum_over_faces_by_loops(seed):
    rng = torch.Generator().manual_seed(seed)
    labels, ground_truth = torch.randint(-1, 6, (2, 80), generator=rng)
    total, weight = 0.0, 0
    for face in set(ground_truth.tolist()) - {-1}:
        own = ground_truth == face
        best = max(
            float(((labels == region) & own).sum() / ((labels == region) | own).sum().double())
            for region in set(labels.tolist()) - {-1}
        )
        total, weight = total + best * int(own.sum()), weight + int(own.sum())
    table = contingency_table(labels, ground_truth)
    assert segmentation_covering(table) == pytest.approx(total / weight, abs=1e-14)


def test_covering_without_a_face_is_zero():
    assert segmentation_covering(contingency_table(torch.tensor([0]), torch.tensor([-1]))) == 0
