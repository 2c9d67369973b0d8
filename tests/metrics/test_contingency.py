"""The table of overlaps against counting by hand."""

import numpy as np
import pytest
import torch
from sklearn.metrics import adjusted_rand_score

from torchrg.errors import ConfigError, ShapeError
from torchrg.metrics import adjusted_rand_index, contingency_table, segmentation_covering
from torchrg.metrics.contingency import ContingencyTable, is_not_ignored


def random_labels(rng, count, num_labels):
    return torch.randint(-1, num_labels, (count,), generator=rng)


def counted(labels, ground_truth):
    """Overlaps, region sizes and face sizes, by loops over the points."""
    overlaps, regions, faces = {}, {}, {}
    for label, true in zip(labels, ground_truth, strict=True):
        if label != -1:
            regions[label] = regions.get(label, 0) + 1
        if true != -1:
            faces[true] = faces.get(true, 0) + 1
        if label != -1 and true != -1:
            overlaps[label, true] = overlaps.get((label, true), 0) + 1
    return overlaps, regions, faces


def as_dicts(table):
    regions = table.region_labels[table.regions].tolist()
    faces = table.face_labels[table.faces].tolist()
    return (
        dict(zip(zip(regions, faces, strict=True), table.overlaps.tolist(), strict=True)),
        dict(zip(table.region_labels.tolist(), table.region_sizes.tolist(), strict=True)),
        dict(zip(table.face_labels.tolist(), table.face_sizes.tolist(), strict=True)),
    )


@pytest.mark.parametrize("num_labels", [1, 3, 40, 2**40])
def test_table_counts_what_loops_count(rng, num_labels):
    labels, ground_truth = random_labels(rng, 300, num_labels), random_labels(rng, 300, 5)
    table = contingency_table(labels, ground_truth)
    assert as_dicts(table) == counted(labels.tolist(), ground_truth.tolist())
    assert table.num_points == 300


@pytest.mark.parametrize(
    "kind", [np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, ">i4"]
)
def test_numpy_integers_of_any_kind_are_accepted(kind):
    labels, ground_truth = np.array([0, 0, 1, 2]).astype(kind), np.array([3, 4, 4, 4]).astype(kind)
    expected = counted(labels.tolist(), ground_truth.tolist())
    assert as_dicts(contingency_table(labels, ground_truth)) == expected


def test_ignored_points_count_nowhere(rng):
    labels, ground_truth = random_labels(rng, 300, 6), random_labels(rng, 300, 6)
    kept = ground_truth != 2
    table = contingency_table(labels, ground_truth, ignore=2)
    assert as_dicts(table) == counted(labels[kept].tolist(), ground_truth[kept].tolist())
    assert table.num_points == int(kept.sum())


def test_points_of_no_face_can_be_ignored():
    table = contingency_table(torch.tensor([0, 0, 1]), torch.tensor([5, -1, -1]), ignore=-1)
    assert as_dicts(table) == ({(0, 5): 1}, {0: 1}, {5: 1})


def test_small_regions_count_as_unlabelled():
    labels = torch.tensor([4, 4, 4, 6, 6, 9])
    ground_truth = torch.tensor([0, 0, 1, 1, 1, 1])
    table = contingency_table(labels, ground_truth, min_size=3)
    assert as_dicts(table) == ({(4, 0): 2, (4, 1): 1}, {4: 3}, {0: 2, 1: 4})


def test_size_of_a_region_is_taken_before_points_are_ignored():
    labels, ground_truth = torch.tensor([4, 4, 4]), torch.tensor([0, 8, 8])
    table = contingency_table(labels, ground_truth, min_size=3, ignore=8)
    assert as_dicts(table) == ({(4, 0): 1}, {4: 1}, {0: 1})


@pytest.mark.parametrize(
    ("labels", "ground_truth"),
    [([], []), ([-1, -1], [-1, -1]), ([-1, -1], [0, 0]), ([0, 0], [-1, -1]), ([3], [8])],
)
def test_nothing_on_a_side_gives_an_empty_side(labels, ground_truth):
    table = contingency_table(torch.tensor(labels).long(), torch.tensor(ground_truth).long())
    assert as_dicts(table) == counted(labels, ground_truth)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (torch.zeros(4), "integer labels, got float32; use .long"),
        (torch.zeros(4, dtype=torch.bool), "integer labels, got bool"),
        (np.zeros(4), "integer labels, got float64"),
        (torch.zeros(3, dtype=torch.int64), r"truth of shape \(N\) with N=3, got \(4,\)"),
        (torch.zeros(2, 2, dtype=torch.int64), r"labels of shape \(N\), got \(2, 2\)"),
        ([0, 0, 0, 0], "labels to be a tensor or a NumPy array, got list"),
        (torch.zeros(4, dtype=torch.int64, device="meta"), "one device, got meta and cpu"),
    ],
)
def test_labels_that_do_not_fit_are_refused(labels, message):
    with pytest.raises(ShapeError, match=f"contingency_table: expected .*{message}"):
        contingency_table(labels, torch.zeros(4, dtype=torch.int64))


def test_min_size_below_one_is_refused():
    labels = torch.zeros(4, dtype=torch.int64)
    with pytest.raises(ConfigError, match=r"contingency_table: expected min_size >= 1, got 0\."):
        contingency_table(labels, labels, min_size=0)


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


def test_is_not_ignored_by_example():
    assert (
        repr((is_not_ignored(torch.tensor([0, 1]), 1), is_not_ignored(torch.tensor([0]), 10**23)))
        == "(tensor([ True, False]), tensor([True]))"
    )
