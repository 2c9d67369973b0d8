"""Rims: points within the noise of two planes go by where the faces end."""

import numpy as np
import pytest
import torch

from torchrg.linalg.moments import Segments
from torchrg.neighbors import canonical_order, search_knn
from torchrg.regions.edges import GrowingInput
from torchrg.regions.fit import fit_planes
from torchrg.regions.repair import refine_borders
from torchrg.structures import UNLABELED

NOISE = 0.003


def floor_and_wall(rng, num_points=6000, width=0.5, angle_deg=90.0):
    """A floor and a wall that meet in the y axis, each noisy along its normal; 1 on the wall."""
    truth = np.arange(num_points) % 2
    run, along = rng.uniform(0, width, num_points), rng.uniform(0, 1, num_points)
    noise = NOISE * rng.normal(size=num_points)
    angle = np.radians(angle_deg)
    normals = np.array([[0.0, 0, 1], [-np.sin(angle), 0, np.cos(angle)]])
    ways = np.array([[-1.0, 0, 0], [np.cos(angle), 0, np.sin(angle)]])
    points = run[:, None] * ways[truth] + noise[:, None] * normals[truth]
    points[:, 1] = along
    return points, truth, normals


def refined(points, labels, normals, valid=None, reach=9e-3, thickness=(NOISE, NOISE)):
    """Labels after refinement, in the order of the points."""
    points = torch.tensor(points)
    order = canonical_order(points)
    placed = points[order]
    valid = torch.ones(len(points), dtype=torch.bool) if valid is None else valid
    normals = torch.tensor(normals)
    cloud = GrowingInput(
        placed,
        torch.zeros_like(placed),
        torch.zeros(len(points)),
        search_knn(placed, 50, canonical=True),
        valid[order],
    )
    count = len(normals)
    planes = fit_planes(Segments(torch.arange(count)), torch.zeros(count, 3).double(), normals)
    planes = planes._replace(thickness=torch.tensor(thickness).double())
    reach = torch.full((count,), reach).double()
    found = refine_borders(cloud, torch.as_tensor(labels)[order], planes, reach)
    return torch.empty_like(found).index_copy_(0, order, found)


def nearest_plane(points, normals):
    return np.abs(points @ np.transpose(normals)).argmin(axis=1)


@pytest.mark.parametrize("angle_deg", [60.0, 90.0])
def test_the_line_where_two_planes_meet_halves_the_errors_of_the_nearest_plane(angle_deg):
    points, truth, normals = floor_and_wall(np.random.default_rng(0), angle_deg=angle_deg)
    labels = nearest_plane(points, normals)
    found = refined(points, labels, normals).numpy()
    assert (found != truth).sum() < 0.7 * (labels != truth).sum()


def test_points_without_a_label_join_what_they_lie_on():
    points, truth, normals = floor_and_wall(np.random.default_rng(1))
    labels = np.where(points[:, 0] > -0.02, UNLABELED, truth)
    labels[(truth == 1) & (points[:, 2] > 0.02)] = 1
    found = refined(points, labels, normals).numpy()
    assert (found == truth).mean() > 0.99


def test_points_far_from_every_plane_and_invalid_ones_stay_as_they_are():
    points, truth, normals = floor_and_wall(np.random.default_rng(2))
    points[:300] += [0, 0, 0.05]
    labels = truth.copy()
    labels[:600] = UNLABELED
    valid = torch.arange(len(points)) >= 600
    valid[:300] = True
    found = refined(points, labels, normals, valid=valid)
    assert (found[300:600] == UNLABELED).all()
    off = torch.tensor((np.abs(points @ normals.T) > 9e-3).all(axis=1))[:300]
    assert off.sum() > 100
    assert (found[:300][off] == UNLABELED).all()


def test_points_far_from_their_own_plane_move_to_a_nearer_one_only():
    points, truth, normals = floor_and_wall(np.random.default_rng(5))
    low = (truth == 1) & (points[:, 2] > 0.02) & (points[:, 2] < 0.05)
    labels = np.where(low, 0, truth)
    found = refined(points, labels, normals).numpy()
    assert (found[low] == 1).all()
    # Off both planes, growth decides.
    points[low] -= [0.04, 0, 0]
    assert (refined(points, labels, normals).numpy()[low] == 0).all()


@pytest.mark.parametrize("thickness", [(NOISE, 4 * NOISE), (4 * NOISE, NOISE)])
def test_a_rounded_edge_is_halved_though_one_plane_is_rougher(thickness):
    points, _, normals = floor_and_wall(np.random.default_rng(6), width=0.2)
    # A quarter of a circle with a radius of 2 cm replaces the edge.
    edge = (np.abs(points[:, [0, 2]]) < 0.02).all(axis=1)
    angle = np.random.default_rng(7).uniform(0, np.pi / 2, int(edge.sum()))
    points[edge, 0] = 0.02 * (np.sin(angle) - 1)
    points[edge, 2] = 0.02 * (1 - np.cos(angle))
    nearest = nearest_plane(points, normals)
    found = refined(points, nearest, normals, reach=0.03, thickness=thickness).numpy()
    assert (found[edge] == nearest[edge]).mean() > 0.9


def test_a_face_that_goes_on_behind_another_does_not_end_there():
    rng = np.random.default_rng(3)
    points, truth, normals = floor_and_wall(rng, 6000)
    beyond = points[truth == 0][::8] * [-1, 1, 1]
    points = np.concatenate([points, beyond])
    truth = np.concatenate([truth, np.zeros(len(beyond), dtype=int)])
    found = refined(points, truth, normals).numpy()
    behind = (truth == 0) & (points[:, 0] > 0.004)
    assert (found[behind] == 0).all()


def test_regions_that_are_not_flat_or_nearly_parallel_keep_their_points():
    points, truth, normals = floor_and_wall(np.random.default_rng(4))
    labels = np.where(np.abs(points[:, 0]) < 0.01, 0, truth)
    kept = refined(points, labels, normals, reach=float("nan"))
    assert torch.equal(kept, torch.tensor(labels))
    labels = (points[:, 1] > 0.5).astype(int)
    flat = truth == 0
    tilted = np.array([[0.0, 0, 1], [0, np.sin(0.1), np.cos(0.1)]])
    found = refined(points[flat], labels[flat], tilted, reach=1.0)
    assert torch.equal(found, torch.tensor(labels[flat]))
