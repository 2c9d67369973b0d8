"""The SegComp and EVOPS protocols against their definitions, written out in loops."""

from itertools import product

import pytest
import torch
from benchmarks.protocols import SegCompCounts, count_segcomp, score_evops, score_voxels

from torchrg.errors import ConfigError
from torchrg.metrics import contingency_table


def sets_of(labels):
    return {a: {i for i, x in enumerate(labels) if x == a} for a in set(labels) - {-1}}


def segcomp_by_definition(labels, truth, limit):
    """Hoover et al., section 2.4: list all instances, then let the best means take their parts."""
    regions, faces = sets_of(labels), sets_of(truth)
    instances = []
    for (a, region), (b, face) in product(regions.items(), faces.items()):
        fractions = len(region & face) / len(region), len(region & face) / len(face)
        if min(fractions) > limit:
            instances.append((sum(fractions) / 2, 0, {("region", a), ("face", b)}))
    for kind, own, wholes, other, parts in (
        (1, "face", faces, "region", regions),
        (2, "region", regions, "face", faces),
    ):
        for name, whole in wholes.items():
            inside = {p: len(s & whole) / len(s) for p, s in parts.items()}
            inside = {p: value for p, value in inside.items() if value > limit}
            held = sum(len(parts[p] & whole) for p in inside) / len(whole)
            if len(inside) >= 2 and held > limit:
                mean = (sum(inside.values()) / len(inside) + held) / 2
                instances.append((mean, kind, {(own, name)} | {(other, p) for p in inside}))
    taken, counts = set(), [0, 0, 0]
    for _, kind, members in sorted(instances, key=lambda one: (-one[0], one[1])):
        if not members & taken:
            taken |= members
            counts[kind] += 1
    return SegCompCounts(
        *counts,
        missed=len({("face", b) for b in faces} - taken),
        noise=len({("region", a) for a in regions} - taken),
    )


def evops_by_definition(labels, truth):
    """Kornilova et al.: precision, recall, and the mean IoU of what matches."""
    regions, faces = sets_of(labels), sets_of(truth)
    iou = [len(a & b) / len(a | b) for a, b in product(regions.values(), faces.values())]
    matches = [x for x in iou if x >= 0.75]
    mean = sum(matches) / len(matches) if matches else 0
    return (len(matches) / len(regions), len(matches) / len(faces), mean)


def spoiled_labels(seed):
    """Truth with faces of all sizes, and labels that split, merge, drop and blur some of them."""
    rng = torch.Generator().manual_seed(seed)
    truth = torch.randint(4, 30, (12,), generator=rng).tolist()
    truth = torch.repeat_interleave(torch.arange(12), torch.tensor(truth))
    part = torch.rand(len(truth), generator=rng)
    labels = truth.clone()
    cut = 0.02 + 0.5 * float(torch.rand(1, generator=rng))
    labels[(truth < 4) & (part < cut)] += 20
    labels[(truth == 0) & (part > 0.9)] = 50
    labels[(truth == 5) | ((truth == 6) & (part > 0.1 * float(seed % 3)))] = 30
    labels[(truth == 7) & (part < 0.95)] = 8
    labels[(truth == 9) & (part < 0.7)] = -1
    stray = torch.rand(len(truth), generator=rng) < 0.05
    labels[stray] = torch.randint(-1, 12, (int(stray.sum()),), generator=rng)
    truth[torch.rand(len(truth), generator=rng) < 0.03] = -1
    return labels, truth


@pytest.mark.parametrize("limit", [0.5, 0.8, 0.95])
@pytest.mark.parametrize("seed", range(6))
def test_segcomp_counts_are_those_of_the_definition(seed, limit):
    labels, truth = spoiled_labels(seed)
    expected = segcomp_by_definition(labels.tolist(), truth.tolist(), limit)
    assert count_segcomp(contingency_table(labels, truth), threshold=limit) == expected


@pytest.mark.parametrize(
    ("labels", "truth", "expected"),
    [
        ("..........", "aaaaabbbbb", (0, 0, 0, 2, 0)),
        ("aaaaabbbbb", "..........", (0, 0, 0, 0, 2)),
        # Exactly 80 % is not more than 80 %.
        ("aaaa......", "aaaaa.....", (0, 0, 0, 1, 1)),
        # A crumb inside the face: both together explain the face better than the big one alone.
        ("aaaaaaaaab", "aaaaaaaaaa", (0, 1, 0, 0, 0)),
    ],
)
def test_segcomp_counts_and_evops_where_there_is_little_by_hand(labels, truth, expected):
    table = contingency_table(
        *(
            torch.tensor([-1 if letter == "." else ord(letter) for letter in word])
            for word in (labels, truth)
        )
    )
    assert count_segcomp(table) == expected
    if "." * 10 in (labels, truth):
        assert set(score_evops(table)) == {0.0}


@pytest.mark.parametrize("seed", range(6))
def test_evops_indices_are_those_of_the_definition(seed):
    labels, truth = spoiled_labels(seed)
    score = score_evops(contingency_table(labels, truth))
    expected = evops_by_definition(labels.tolist(), truth.tolist())
    assert 0 < score.precision < 1
    assert score == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("threshold", [0.4, 1.0])
def test_segcomp_refuses_a_threshold_without_unique_classes(threshold):
    table = contingency_table(torch.tensor([0]), torch.tensor([0]))
    with pytest.raises(ConfigError, match=r"count_segcomp: expected threshold in \[0.5, 1\), got"):
        count_segcomp(table, threshold=threshold)


def voxels_by_definition(points, labels, truth, size):
    """The published evaluator, literally: voxels of each plane as sets, one plane at a time."""
    low = points.amin(dim=0)
    cells = [tuple(cell) for cell in ((points - low) / size).floor().long().tolist()]
    regions, faces = sets_of(labels), sets_of(truth)
    face_of = {}
    for a, region in regions.items():
        held = {b: len(region & face) for b, face in faces.items()}
        best = max(sorted(held), key=lambda b: held[b])
        face_of[a] = best if held[best] >= len(region) / 2 else None
    inside = {name: {cells[i] for i in rows} for name, rows in regions.items()}
    true = {name: {cells[i] for i in rows} for name, rows in faces.items()}
    found, all_true = set().union(*inside.values()), set().union(*true.values())
    right = set().union(*(inside[a] & true[b] for a, b in face_of.items() if b is not None))
    return len(right) / len(found), len(right) / len(all_true)


@pytest.mark.parametrize("seed", range(4))
def test_voxel_shares_are_those_of_the_definition(seed):
    labels, truth = spoiled_labels(seed)
    rng = torch.Generator().manual_seed(seed)
    points = torch.rand(len(truth), 3, generator=rng, dtype=torch.float64)
    points[:, 0] += 0.3 * truth.clamp(min=0)
    score = score_voxels(points, labels, truth, voxel_size=0.25)
    precision, recall = voxels_by_definition(points, labels.tolist(), truth.tolist(), 0.25)
    assert (score.precision, score.recall) == pytest.approx((precision, recall), abs=1e-14)
    assert 0 < recall < 1
    order = torch.randperm(len(truth), generator=rng)
    assert score_voxels(points[order], labels[order], truth[order], voxel_size=0.25) == score


def test_split_faces_cost_no_voxels_and_merged_ones_do():
    points = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
    truth = (points[:, 0] >= 2).long()
    split = points[:, 0].long()
    assert score_voxels(points, split, truth, voxel_size=1.0) == (1.0, 1.0, 1.0)
    merged = torch.zeros_like(truth)
    assert score_voxels(points, merged, truth, voxel_size=1.0) == (0.5, 0.5, 0.5)
    nothing = torch.full_like(truth, -1)
    assert score_voxels(points, nothing, truth, voxel_size=1.0) == (0.0, 0.0, 0.0)
    points[0] = torch.nan
    assert score_voxels(points, split, nothing, voxel_size=1.0) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("truth", "recall"), [([0, 0, 1, 2], 0.5), ([0, 0, 1, 2, 3], 0.0)])
def test_a_region_has_a_face_if_that_holds_half_of_its_points(truth, recall):
    points = torch.arange(float(len(truth)))[:, None] * torch.tensor([1.0, 0, 0])
    labels, truth = torch.zeros(len(truth), dtype=torch.int64), torch.tensor(truth)
    assert score_voxels(points, labels, truth, voxel_size=1.0).recall == recall
