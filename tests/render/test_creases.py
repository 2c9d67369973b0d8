"""Creases of a box, whose planes are known."""

import torch

from torchrg.render.creases import find_creases, segment_surface
from torchrg.render.surface import sample_surface


def box(count=600):
    points = torch.rand(6 * count, 3, generator=torch.Generator().manual_seed(0))
    faces = torch.arange(6 * count) % 6
    points[torch.arange(6 * count), faces // 2] = (faces % 2).float()
    return points, faces


def test_surfaces_end_at_the_faces_beside_them():
    points, faces = box()
    surface = sample_surface(points)
    rows, normals = surface.rows, torch.eye(3)[faces // 2]
    creases = find_creases(surface, faces[rows])
    bounds = creases.bounds_of(surface.points, normals[rows], surface.voxel_of)
    has_bound = (bounds[:, :, :3] != 0).any(dim=2)
    away = (points[rows] - 0.5).abs()
    away[torch.arange(len(rows)), faces[rows] // 2] = 0
    # Next to an edge there is a bound, at the face that is nearest, and points lie above it.
    at_edge = away.amax(dim=1) > 0.47
    assert float(has_bound[at_edge].any(dim=1).float().mean()) > 0.95
    heights = torch.where(has_bound, bounds[:, :, 3], torch.inf).amin(dim=1)
    near = at_edge & has_bound.any(dim=1)
    expected = 0.5 - away.amax(dim=1)
    assert float((heights - expected)[near].abs().median()) < 1e-4
    assert float((bounds[near][:, :, 3] > -1e-4).float().mean()) > 0.99


def test_voxels_at_edges_get_the_plane_that_they_lie_on():
    points, faces = box()
    surface = sample_surface(points)
    labels = segment_surface(surface)
    assert float((labels >= 0).float().mean()) > 0.9
    for label in labels[labels >= 0].unique():
        own = faces[surface.rows][labels == label]
        # Voxels at an edge have points of two faces.
        assert float((own == own.mode().values).float().mean()) > 0.85


def test_a_single_plane_has_no_crease():
    flat = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    flat[:, 2] = 0
    surface = sample_surface(flat)
    creases = find_creases(surface, torch.zeros(2000, dtype=torch.int64))
    bounds = creases.bounds_of(surface.points, torch.eye(3)[[2] * 2000], surface.voxel_of)
    assert not bool((bounds != 0).any())
