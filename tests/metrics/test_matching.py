"""One-to-one pairs against the rule of the paper, read literally."""

import pytest
import torch

from torchrg.metrics import contingency_table, match_regions


def matched_by_loops(labels, truth):
    """Section III.B: each the other's maximum overlap; ties by IoU, then by label."""
    regions = {a: {i for i, x in enumerate(labels) if x == a} for a in set(labels) - {-1}}
    faces = {b: {i for i, x in enumerate(truth) if x == b} for b in set(truth) - {-1}}

    def best(own, others):
        ranked = [
            (-len(own & other), -len(own & other) / len(own | other), name)
            for name, other in others.items()
            if own & other
        ]
        return min(ranked)[2] if ranked else None

    return sorted(
        (a, b)
        for a, region in regions.items()
        for b, face in faces.items()
        if best(region, faces) == b and best(face, regions) == a
    )


def matched(labels, truth):
    table = contingency_table(torch.tensor(labels), torch.tensor(truth))
    pairs = match_regions(table)
    regions = table.region_labels[table.regions[pairs]].tolist()
    faces = table.face_labels[table.faces[pairs]].tolist()
    return sorted(zip(regions, faces, strict=True))


@pytest.mark.parametrize("seed", range(40))
def test_pairs_are_those_of_the_literal_rule(seed):
    rng = torch.Generator().manual_seed(seed)
    count, names = (12, 4) if seed % 2 else (60, 9)
    labels, truth = torch.randint(-1, names, (2, count), generator=rng).tolist()
    assert matched(labels, truth) == matched_by_loops(labels, truth)


def test_equal_overlaps_go_to_the_larger_iou():
    # Region 0 shares two points with each face, and face 2 is the smaller one; and mirrored.
    assert matched([0, 0, 0, 0, -1], [1, 1, 2, 2, 1]) == [(0, 2)]
    assert matched([1, 1, 2, 2, 1], [0, 0, 0, 0, -1]) == [(2, 0)]


def test_equal_overlaps_and_ious_go_to_the_lower_label():
    assert matched([5, 5, 5, 5], [2, 2, 1, 1]) == [(5, 1)]
    assert matched([2, 2, 1, 1], [5, 5, 5, 5]) == [(1, 5)]


def test_a_second_choice_is_no_pair():
    # Region 1 overlaps only face 0, which overlaps region 0 more.
    assert matched([0, 0, 0, 1, 1], [0, 0, 0, 0, 0]) == [(0, 0)]


def test_nothing_in_common_gives_no_pair():
    assert matched([0, 0, -1, -1], [-1, -1, 0, 0]) == []
