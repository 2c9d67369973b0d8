"""The external indices together: by hand, by loops over sets, and where there is nothing."""

import json
import math

import numpy as np
import pytest
import torch

from torchrg.errors import ConfigError, ShapeError
from torchrg.metrics import (
    METRICS,
    ClusterScore,
    LabelScore,
    NormalScore,
    PartitionScore,
    score_labels,
)

SHARES = [name for name, index in METRICS["labels"].items() if index.unit != "count"]


def scored_by_loops(labels, ground_truth):
    """Precision, recall, F1 and the IoU indices, from sets of points."""
    regions = {a: {i for i, x in enumerate(labels) if x == a} for a in set(labels) - {-1}}
    faces = {b: {i for i, x in enumerate(ground_truth) if x == b} for b in set(ground_truth) - {-1}}
    iou = {
        (a, b): len(region & face) / len(region | face)
        for a, region in regions.items()
        for b, face in faces.items()
    }
    shared = {(a, b): len(regions[a] & faces[b]) for a, b in iou}

    def rank(pair):
        return (-shared[pair], -iou[pair], pair)

    pairs = [
        (a, b)
        for a, b in iou
        if shared[a, b]
        and min(rank((a, other)) for other in faces) == rank((a, b))
        and min(rank((other, b)) for other in regions) == rank((a, b))
    ]
    precision = 100 * np.mean([shared[a, b] / len(regions[a]) for a, b in pairs])
    recall = 100 * np.mean([shared[a, b] / len(faces[b]) for a, b in pairs])
    expected = {
        "precision": precision,
        "recall": recall,
        "f1": 2 * precision * recall / (precision + recall),
        "pairs": len(pairs),
        "regions": len(regions),
        "faces": len(faces),
        "points": len(labels),
        "mean_best_iou": np.mean([max(iou[a, b] for a in regions) for b in faces]),
        "fraction_labeled": np.mean([a != -1 for a in labels]),
    }
    for bound in (50, 80):
        hits = [pair for pair, value in iou.items() if value > bound / 100]
        expected[f"precision_iou{bound}"] = len({a for a, _ in hits}) / len(regions)
        expected[f"recall_iou{bound}"] = len({b for _, b in hits}) / len(faces)
    return expected


@pytest.mark.parametrize("seed", range(0, 20, 2))
def test_indices_are_those_of_loops_over_sets(seed):
    rng = torch.Generator().manual_seed(seed)
    ground_truth = torch.randint(-1, 8, (200,), generator=rng)
    noise = torch.rand(200, generator=rng) < 0.02 * seed
    labels = torch.where(noise, torch.randint(-1, 9, (200,), generator=rng), ground_truth + 30)
    labels[ground_truth == -1] = 7
    score = score_labels(labels, ground_truth)._asdict()
    expected = scored_by_loops(labels.tolist(), ground_truth.tolist())
    assert {name: score[name] for name in expected} == pytest.approx(expected, abs=1e-12)


def test_the_truth_itself_scores_full_marks(rng):
    ground_truth = torch.randint(0, 12, (400,), generator=rng)
    score = score_labels(100 - ground_truth, ground_truth)._asdict()
    full = {name: 100.0 if METRICS["labels"][name].unit == "%" else 1.0 for name in SHARES}
    full |= {name: 0.0 for name in SHARES if METRICS["labels"][name].higher_is_better is False}
    assert {name: score[name] for name in SHARES} == pytest.approx(full, abs=1e-12)
    assert score["pairs"] == score["regions"] == score["faces"] == 12


@pytest.mark.parametrize(
    ("labels", "ground_truth", "counts", "agreement"),
    [
        pytest.param([], [], (0, 0, 0, 0), 1, id="no point"),
        pytest.param([-1, -1], [-1, -1], (0, 0, 0, 2), 1, id="all unlabelled"),
        pytest.param([-1, -1, -1], [0, 0, 1], (0, 0, 2, 3), 0, id="no region"),
        pytest.param([0, 0, 1], [-1, -1, -1], (0, 2, 0, 3), 0, id="no face"),
        pytest.param([0, -1], [-1, 0], (0, 1, 1, 2), 1, id="nothing in common"),
    ],
)
def test_means_over_nothing_are_zero_and_the_counts_tell(labels, ground_truth, counts, agreement):
    score = score_labels(
        torch.tensor(labels, dtype=torch.int64), torch.tensor(ground_truth, dtype=torch.int64)
    )
    assert (score.pairs, score.regions, score.faces, score.points) == counts
    assert score.ari == agreement
    zeros = {"precision", "recall", "f1", "mean_best_iou", "recall_iou50", "covering"}
    assert {score._asdict()[name] for name in zeros} == {0.0}


def test_ignored_points_and_small_regions_score_as_if_they_were_not_there(rng):
    ground_truth = torch.randint(0, 6, (300,), generator=rng)
    labels = ground_truth.clone()
    labels[:9] = torch.tensor([20, 20, 20, 20, 21, 21, 21, 22, 23])
    cleaned, kept = torch.where(labels > 20, -1, labels), ground_truth != 3
    expected = score_labels(cleaned[kept], ground_truth[kept])
    assert score_labels(labels, ground_truth, min_size=4, ignore=3) == expected


@pytest.mark.parametrize(
    ("part", "score"),
    [
        ("labels", LabelScore),
        ("clusters", ClusterScore),
        ("normals", NormalScore),
        ("superpoints", PartitionScore),
    ],
)
def test_fields_of_scores_are_those_of_the_catalog(part, score):
    assert list(METRICS[part]) == list(score._fields)


def test_scores_are_plain_numbers_for_json(rng):
    labels, ground_truth = torch.randint(-1, 6, (2, 300), generator=rng)
    score = score_labels(labels, ground_truth)
    assert json.loads(json.dumps(score._asdict(), allow_nan=False)) == score._asdict()
    assert all(type(value) in (int, float) for value in score)
    assert all(math.isfinite(value) for value in score)


def test_labels_that_do_not_fit_are_refused():
    whole = torch.zeros(4, dtype=torch.int64)
    with pytest.raises(
        ShapeError, match=r"score_labels: expected ground_truth of shape \(N\) with N=4"
    ):
        score_labels(whole, whole[:3])
    with pytest.raises(ShapeError, match="score_labels: expected integer labels, got float32"):
        score_labels(whole.float(), whole)
    with pytest.raises(ConfigError, match="score_labels: expected min_size >= 1, got 0"):
        score_labels(whole, whole, min_size=0)


def test_precision_and_recall_of_pairs_by_example():
    score = score_labels(torch.tensor([4, 4, 4, 5]), torch.tensor([0, 0, 1, 1]))
    assert (score.precision, score.recall, score.pairs) == (83.33333333333334, 75.0, 2)
