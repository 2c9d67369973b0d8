"""Which regions meet and along which length: against literal loops, however much at a time."""

import math
from collections import defaultdict

import numpy as np
import pytest
import torch

from torchrg.linalg import unsigned_angle_deg
from torchrg.neighbors import search_knn
from torchrg.regions import adjacency
from torchrg.regions.adjacency import KnnAdjacency, find_adjacency
from torchrg.structures import Neighbors


def touching_regions(k, masked):
    """Points of six regions in a cube, flat and curved ones, and planes at many angles."""
    generator = torch.Generator().manual_seed(5)
    points = torch.rand(400, 3, generator=generator, dtype=torch.float64)
    points[7] = points[8]
    labels = (points[:, 0] * 3).long() + 3 * (points[:, 1] * 2).long()
    labels[::9] = -1
    neighbors = search_knn(points, k)
    mask = torch.rand(neighbors.indices.shape, generator=generator) < 0.8
    mask[:, :2] = True
    normal = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    normal[3] = normal[0]
    normal /= normal.norm(dim=1, keepdim=True)
    thickness = torch.linspace(0.01, 0.06, 6, dtype=torch.float64)
    curved = torch.tensor([False, False, True, False, False, False])
    mask = mask.sort(dim=1, descending=True).values if masked else None
    return points, labels, Neighbors(neighbors.indices, mask), normal, (thickness, curved)


def contacts_by_loops(labels, neighbors):
    """Return rows, neighbors and columns of the edges of each pair of regions."""
    found = defaultdict(list)
    for row, near in enumerate(neighbors.indices.tolist()):
        for column, other in enumerate(near):
            counts = neighbors.valid is None or bool(neighbors.valid[row, column])
            ends = sorted((int(labels[row]), int(labels[other])))
            if counts and ends[0] >= 0 and ends[0] != ends[1]:
                found[tuple(ends)].append((row, other, column))
    return found


def length_on_line(points, edges, first, second):
    """Return how many steps from cell to cell the middles of edges take along a line."""
    along = np.cross(first, second)
    along /= np.linalg.norm(along)
    size = np.mean([np.linalg.norm(points[a] - points[b]) for a, b, _ in edges])
    middles = [(points[a] + points[b]) / 2 - points[0] for a, b, _ in edges]
    cells = {math.floor(middle @ along / size) for middle in middles}
    return size * sum(cell + 1 in cells for cell in cells)


def length_of_curve(points, edges, neighbors, planes, thickness):
    """Return the length that Cauchy and Crofton give, and how many of the edges are flat."""
    total, flat = 0.0, 0
    for row, other, column in edges:
        counted = 8 if neighbors.valid is None else int(neighbors.valid[row, 1:9].sum())
        last = points[int(neighbors.indices[row, counted])]
        spacing, edge = np.linalg.norm(last - points[row]), points[other] - points[row]
        steep = max(abs(edge @ plane) for plane in planes)
        if column <= 8 and steep <= max(4 * thickness, spacing / 4):
            flat += 1
            size = np.linalg.norm(edge)
            total += (math.pi * spacing / counted) ** 2 / (2 * size) if size > 0 else 0
    return total, flat


@pytest.mark.parametrize("masked", [False, True])
def test_lengths_are_those_of_literal_loops(masked):
    points, labels, neighbors, normal, (thickness, curved) = touching_regions(20, masked)
    found = find_adjacency(points, labels, neighbors, normal, thickness, curved=curved)
    xyz, planes, expected = points.numpy(), normal.numpy(), {}
    for (a, b), edges in contacts_by_loops(labels, neighbors).items():
        angle = float(unsigned_angle_deg(normal[a], normal[b]))
        if angle > 15 and not curved[a] and not curved[b]:
            length, count = length_on_line(xyz, edges, planes[a], planes[b]), len(edges)
        else:
            thick = float(max(thickness[a], thickness[b]))
            length, count = length_of_curve(xyz, edges, neighbors, planes[[a, b]], thick)
        if count >= 3:
            expected[a, b] = length, angle
    pairs = list(map(tuple, found.pairs.tolist()))
    assert pairs == sorted(expected)
    assert {bool(curved[a] or curved[b]) for a, b in pairs} == {False, True}
    values = torch.stack([found.boundary_length, found.dihedral_deg], dim=1)
    np.testing.assert_allclose(values, [expected[pair] for pair in pairs], rtol=1e-9)


@pytest.mark.parametrize("masked", [False, True])
def test_contacts_are_those_of_literal_loops(masked):
    _, labels, neighbors, *_ = touching_regions(9, masked)
    contacts = contacts_by_loops(labels, neighbors)
    pairs, counts = KnnAdjacency(neighbors).contacts(labels)
    assert list(map(tuple, pairs.tolist())) == sorted(contacts)
    assert counts.tolist() == [len(contacts[pair]) for pair in sorted(contacts)]


def test_rows_taken_at_a_time_change_no_bit(monkeypatch):
    points, labels, neighbors, normal, (thickness, curved) = touching_regions(20, masked=True)

    def find():
        return find_adjacency(points, labels, neighbors, normal, thickness, curved=curved)

    whole = find()
    monkeypatch.setattr(adjacency, "ROWS_IN_CACHE", 7)
    assert all(torch.equal(a, b) for a, b in zip(find(), whole, strict=True))


def test_planes_that_meet_far_away_are_measured_as_near_ones():
    # Shifted bytes make coordinates of any size, and edges between them as long.
    pairs, cells = torch.tensor([0, 0, 1, 1, 2000, 2000]), torch.tensor([-3, -3, 2, 7, 7, 2])
    far = torch.tensor([-(2**53), -(2**53), 2**53, 5, 5, 2**53])
    for cell in (cells, far):
        expected = sorted(set(zip(pairs.tolist(), cell.tolist(), strict=True)))
        found = adjacency.unique_cells(pairs, cell)
        assert list(zip(*(part.tolist() for part in found), strict=True)) == expected
