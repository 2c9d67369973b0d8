"""Faces joined by a few doubtful points are reported apart; smooth surfaces stay whole."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.regions import growing_clouds
from tests.regions.growing_clouds import papers_growing
from torchrg import load_config, segment_planes
from torchrg.metrics import score_labels
from torchrg.neighbors import search_knn
from torchrg.regions import grow_regions

PLAIN = papers_growing(
    seed_rule="curvature", connectivity=None, coplanarity=False, min_size=20, max_angle_deg=15.0
)
CUTTING = dataclasses.replace(PLAIN, cut_bridges=True)
CUT = load_config("consensus")
WHOLE = dataclasses.replace(CUT, growing=dataclasses.replace(CUT.growing, cut_bridges=False))


def grow_plain_and_cutting(points, normals):
    """Return the labels of exact normals without cutting, which must be one region, and with it."""
    curvature, neighbors = torch.zeros(len(points), dtype=torch.float64), search_knn(points, 12)
    cloud = points, normals, curvature, neighbors
    assert int(grow_regions(*cloud, PLAIN).max()) == 0
    return grow_regions(*cloud, CUTTING)


def crease(angle_deg, noise, joint, width=0.5, num_points=4000):
    """Faces 0.5 and ``width`` wide, 1 meter long, that meet in an arc; 1 on the second."""
    rng = np.random.default_rng(0)
    along, across = rng.uniform(-0.5, width, num_points), rng.uniform(0, 1, num_points)
    angle = np.radians(angle_deg)
    half = joint * angle / 2
    turn = np.full(num_points, angle) * (along > 0)
    if joint > 0:
        turn = np.clip((along + half) / (2 * half), 0, 1) * angle
    arc = np.stack([joint * np.sin(turn), joint * (1 - np.cos(turn))])
    rest = np.where(along > 0, np.maximum(along - half, 0), np.minimum(along + half, 0))
    run = np.stack([rest * np.cos(turn), rest * np.sin(turn)]) + arc
    bumps = noise * rng.normal(size=num_points)
    x, z = run + bumps * np.stack([-np.sin(turn), np.cos(turn)])
    return torch.tensor(np.stack([x, across, z], axis=1)).float(), torch.tensor(along > 0).long()


@pytest.mark.parametrize(
    ("angle_deg", "noise", "joint", "width"),
    [(12, 0.0002, 0.0, 0.5), (12, 0.003, 0.04, 0.5), (24, 0.003, 0.0, 0.5), (14, 0.003, 0.0, 0.2)],
)
def test_creases_stay_open(angle_deg, noise, joint, width):
    points, truth = crease(angle_deg, noise, joint, width)
    found = segment_planes(points, CUT).labels
    score = score_labels(found, truth)
    assert (score.regions, score.recall_iou80) == (2, 1.0)


@pytest.mark.parametrize(("radius", "noise"), [(0.15, 0.003), (0.3, 0.0), (2.0, 0.003)])
def test_a_column_stays_whole(radius, noise):
    rng = np.random.default_rng(1)
    angle, height = rng.uniform(0, min(2 * np.pi, 2 / radius), 4000), rng.uniform(0, 1.5, 4000)
    away = radius + noise * rng.normal(size=4000)
    points = np.stack([away * np.cos(angle), away * np.sin(angle), height], axis=1)
    whole = segment_planes(torch.tensor(points), WHOLE)
    found = segment_planes(torch.tensor(points), CUT)
    assert torch.equal(found.labels, whole.labels)
    assert float((found.labels == 0).float().mean()) > 0.95


def bridged_sheets(rng):
    """Two sheets 15 cm apart at the same height of a step, and a ramp of few points between."""
    low, high, ramp = (rng.uniform(0, 1, (n, 3)) for n in (600, 600, 12))
    low[:, 2] = high[:, 2] = 0
    high[:, 2] += 0.15
    high[:, 0] += 1.1
    ramp[:, 0] = np.linspace(0.98, 1.12, 12)
    ramp[:, 1] = 0.5 + 0.002 * ramp[:, 1]
    ramp[:, 2] = np.linspace(0.0, 0.15, 12)
    normals = np.tile([0.0, 0.0, 1.0], (1212, 1))
    tilt = np.radians(np.r_[0:40:6j, 40:0:6j])
    normals[1200:] = np.stack([-np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
    truth = torch.arange(1212) // 600
    return torch.tensor(np.concatenate([low, high, ramp])), torch.tensor(normals), truth


def test_a_ramp_of_few_points_does_not_join_two_sheets(rng):
    points, normals, truth = bridged_sheets(np.random.default_rng(2))
    found = grow_plain_and_cutting(points, normals)
    assert int(found.max()) == 1
    for face in (0, 1):
        assert len(found[truth == face].unique()) == 1
    order = torch.randperm(len(points), generator=rng)
    again = grow_plain_and_cutting(points[order] * 1e3, normals[order])
    assert torch.equal(again, found[order])


def bridged_strips(rng, turn_deg=40):
    """Two strips 5 cm wide on both sides of an edge, noise of a quarter of that, and a few points
    whose normals turn from one to the other."""
    turn, ramp = np.radians(turn_deg), np.linspace(0, 1, 10)
    along = np.r_[rng.uniform(0, 1, 1200), 0.5 + 0.005 * ramp]
    across = np.r_[rng.uniform(-0.05, 0, 600), rng.uniform(0, 0.05, 600), 0.004 * ramp - 0.002]
    tilt = np.r_[np.zeros(600), np.full(600, turn), turn * ramp]
    normals = np.stack([-np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
    points = np.stack([across * np.cos(tilt), along, across * np.sin(tilt)], axis=1)
    points += 0.012 * rng.normal(size=(1210, 1)) * normals
    return torch.tensor(points), torch.tensor(normals), torch.arange(1200) // 600


def test_narrow_strips_at_an_edge_are_not_parts_of_one_noisy_face():
    points, normals, truth = bridged_strips(np.random.default_rng(4))
    found = grow_plain_and_cutting(points, normals)[:1200]
    assert score_labels(found, truth).ari > 0.99


def panel_beside_a_cove(rng):
    """A quarter of a cylinder, at its end a flat panel turned by 40 degrees, and a few points whose
    normals turn from one to the other."""
    ramp = np.linspace(0, 1, 10)
    bend = np.r_[-rng.uniform(0, np.pi / 2, 1200), np.zeros(250)]
    flat = np.r_[np.zeros(1200), rng.uniform(0, 0.3, 240), 0.06 * (ramp - 0.5)]
    tilt = bend + np.radians(40) * np.r_[np.zeros(1200), np.ones(240), ramp]
    along = np.r_[rng.uniform(0, 1, 1440), 0.5 + 0.06 * ramp]
    x, z = np.sin(bend) + flat * np.cos(tilt), 1 - np.cos(bend) + flat * np.sin(tilt)
    normals = np.stack([-np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
    return torch.tensor(np.stack([x, along, z], axis=1)), torch.tensor(normals)


def test_a_flat_panel_is_cut_off_a_curved_surface_that_stays_whole():
    points, normals = panel_beside_a_cove(np.random.default_rng(5))
    found = grow_plain_and_cutting(points, normals)
    assert found[:1200].eq(0).all()
    assert found[1200:1440].eq(1).all()


def test_a_room_without_bridges_is_left_alone():
    points = growing_clouds.room(np.random.default_rng(3), 900, 0.005)
    cloud = growing_clouds.prepare(points, 14)
    config = dataclasses.replace(CUTTING, max_angle_deg=6.0)
    plain = dataclasses.replace(PLAIN, max_angle_deg=6.0)
    found, before = (grow_regions(*cloud, settings) for settings in (config, plain))
    assert int(before.max()) >= 2
    assert torch.equal(found, before)


@pytest.mark.parametrize("spacing", [0.02, 0.035, 0.05])
def test_both_faces_of_a_plate_are_regions_at_any_density(spacing):
    rng = np.random.default_rng(4)
    num_points = round(2 * 1.4 * 0.8 / spacing**2)
    points = rng.uniform(0, 1, (num_points, 3)) * [1.4, 0.8, 1]
    truth = torch.tensor(points[:, 2] > 0.5).long()
    points[:, 2] = 0.04 * truth.numpy() + 0.003 * rng.normal(size=num_points)
    score = score_labels(segment_planes(torch.tensor(points).float()).labels, truth)
    assert (score.regions, score.recall_iou80) == (2, 1.0)
