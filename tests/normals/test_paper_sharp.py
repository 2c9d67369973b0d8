"""Sharp feature points: eq. (9) and Algorithm 1, literally."""

import numpy as np
import pytest
import torch

from tests.kernels.clouds import both, clouds, lists, needs_library
from tests.made import make_shape
from torchrg.errors import ConfigError
from torchrg.neighbors import search_knn
from torchrg.normals import estimate_normals, find_sharp_points
from torchrg.normals.pca import fit_points_pca
from torchrg.structures import Neighbors


@pytest.fixture(scope="module")
def cube():
    """Points of a cube, their neighbors, and normals that PCA bends at the edges."""
    points = make_shape("cube", 1500, 0.004).points
    neighbors = search_knn(points, 24)
    return points, neighbors, estimate_normals(points, method="pca", neighbors=neighbors).normals


def literal(normals, neighbors, rule, limit):
    """One point at a time, as the paper says."""
    sharp = []
    for row, near in enumerate(neighbors.indices.tolist()):
        counted = [
            j
            for place, j in enumerate(near)
            if neighbors.valid is None or neighbors.valid[row, place]
        ]
        cosine = np.abs(normals[counted].double().numpy() @ normals[row].double().numpy())
        angles = np.degrees(np.arccos(np.minimum(cosine, 1)))
        if rule == "qn":
            h = len(angles) // 2 + 1
            differences = np.abs(angles[:, None] - angles)[np.triu_indices(len(angles), 1)]
            # One angle alone has no differences, and no spread.
            kth = np.sort(differences)[h * (h - 1) // 2 - 1] if len(differences) else 0.0
            sharp.append(2.2219 * kth > limit)
        else:
            sharp.append(np.sort(angles)[int(np.ceil(len(angles) / 4)) - 1] > limit)
    return torch.from_numpy(np.array(sharp))


@pytest.mark.parametrize("rule", ["qn", "percentile"])
@pytest.mark.parametrize("limit", [2.0, 5.0, 20.0])
def test_points_are_those_of_the_definition(cube, rule, limit):
    _, neighbors, normals = cube
    found = find_sharp_points(normals, neighbors, rule=rule, angle_deg=limit)
    expected = literal(normals, neighbors, rule, limit)
    # Angles rounded to float32 may pass the limit.
    assert (found != expected).sum() <= 1
    assert 0 < found.sum() < len(found)


@pytest.mark.parametrize("rule", ["qn", "percentile"])
def test_neighbors_that_do_not_count_are_left_out(cube, rule):
    points, _, normals = cube
    neighbors = search_knn(points, 24, max_distance=0.09)
    assert 0.2 < neighbors.valid.double().mean() < 0.9
    found = find_sharp_points(normals, neighbors, rule=rule)
    assert (found != literal(normals, neighbors, rule, 5.0)).sum() <= 1


def test_signs_do_not_matter(cube, rng):
    _, neighbors, normals = cube
    signs = torch.where(torch.rand(len(normals), generator=rng) < 0.5, -1.0, 1.0)[:, None]
    expected = find_sharp_points(normals, neighbors)
    assert torch.equal(find_sharp_points(normals * signs, neighbors), expected)


def test_chunk_size_does_not_matter(cube):
    _, neighbors, normals = cube
    expected = find_sharp_points(normals, neighbors)
    assert torch.equal(find_sharp_points(normals, neighbors, chunk_size=37), expected)


def test_points_without_a_normal_are_sharp_and_no_neighbors(cube):
    _, neighbors, normals = cube
    valid = torch.ones(len(normals), dtype=torch.bool)
    valid[::7] = False
    spoiled = torch.where(valid[:, None], normals, 0.0)
    found = find_sharp_points(spoiled, neighbors, valid=valid)
    assert found[~valid].all()
    counted = Neighbors(neighbors.indices, valid[neighbors.indices.long()])
    expected = literal(normals, counted, "qn", 5.0)
    assert (found != expected)[valid].sum() <= 1


def test_sharp_points_lie_at_edges(cube):
    points, neighbors, normals = cube
    sharp = find_sharp_points(normals, neighbors)
    to_edge = (0.5 - points.abs()).abs().sort(dim=1).values[:, 1]
    assert to_edge[sharp].max() < 0.25
    assert sharp[to_edge < 0.02].double().mean() > 0.8


def test_plane_has_no_sharp_points(rng):
    normals = torch.eye(3)[2:].expand(50, 3)
    neighbors = search_knn(torch.rand(50, 3, generator=rng), 10)
    for rule in ("qn", "percentile"):
        assert not find_sharp_points(normals, neighbors, rule=rule, angle_deg=0.0).any()


def test_unknown_rule_is_refused(cube):
    with pytest.raises(ConfigError, match="expected rule to be qn or percentile, got 'mad'"):
        find_sharp_points(cube[2], cube[1], rule="mad")


@pytest.mark.parametrize(("equal", "sharp"), [(5, True), (6, False)])
def test_half_of_the_neighbors_are_no_majority_for_qn(equal, sharp):
    # Of ten angles Qn is the 15th smallest difference: that of six equal ones is 0.
    angles = torch.tensor([0.0] * equal + [10.0, 20, 35, 55, 80][-(10 - equal) :]).deg2rad()
    normals = torch.stack([angles.sin(), torch.zeros(10), angles.cos()], dim=1)
    neighbors = Neighbors(torch.arange(10)[None])
    assert find_sharp_points(normals, neighbors, rule="qn", angle_deg=5).tolist() == [sharp]


@pytest.mark.skipif(not needs_library, reason="needs the library of kernels")
@pytest.mark.parametrize("rule", ["qn", "percentile"])
@pytest.mark.parametrize("k", [1, 9, 50])
def test_sharp_points_by_kernels_are_those_of_the_definition(k, rule):
    for points in clouds().values():
        near = lists(points, k, masked=False)
        normals = fit_points_pca(points, near).normals
        normals[::7] *= -1
        found, expected = both(find_sharp_points, normals, near, rule=rule, angle_deg=8.0)
        assert torch.equal(found, expected)
