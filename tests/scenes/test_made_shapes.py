"""Closed shapes against formulas, implicit equations and the divergence theorem."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare, kstest

from tests.made import SHAPES, make_shape
from torchrg.errors import ConfigError

GOLDEN = (1 + 5**0.5) / 2

# Area and volume by textbook formulas.
KNOWN = {
    "cube": (6, 1),
    "cuboid": (2 * (0.6 + 0.35 + 0.21), 0.21),
    "thin_plate": (2 * (0.8 + 0.02 + 0.016), 0.016),
    "octahedron": (4 * 3**0.5 * 0.7**2, 4 / 3 * 0.7**3),
    # The edge of a dodecahedron with corners (1, 1, 1) is 2 / golden.
    "dodecahedron": (
        3 * (25 + 10 * 5**0.5) ** 0.5 * (0.7 / GOLDEN) ** 2,
        (15 + 7 * 5**0.5) / 4 * (0.7 / GOLDEN) ** 3,
    ),
    "hexagonal_prism": (2 * 1.5 * 3**0.5 * 0.25 + 6 * 0.5 * 0.7, 1.5 * 3**0.5 * 0.25 * 0.7),
    "stairs": (2 * 0.5 + 0.6 * 3.6, 0.5 * 0.6),
    "rounded_box": (
        2 * (0.8 * 0.5 + 0.5 * 0.3 + 0.3 * 0.8)
        + 2 * np.pi * 0.1 * (0.8 + 0.5 + 0.3)
        + 4 * np.pi * 0.01,
        0.8 * 0.5 * 0.3
        + 0.1 * 2 * (0.8 * 0.5 + 0.5 * 0.3 + 0.3 * 0.8)
        + np.pi * 0.01 * (0.8 + 0.5 + 0.3)
        + 4 / 3 * np.pi * 0.001,
    ),
    "capsule": (
        4 * np.pi * 0.0625 + 2 * np.pi * 0.25 * 0.6,
        4 / 3 * np.pi * 0.25**3 + np.pi * 0.0625 * 0.6,
    ),
    "cylinder": (2 * np.pi * 0.09 + 2 * np.pi * 0.3, np.pi * 0.09),
    "cone": (np.pi * 0.16 + np.pi * 0.4 * (0.16 + 1) ** 0.5, np.pi * 0.16 / 3),
    "sphere": (np.pi, np.pi / 6),
    "torus": (4 * np.pi**2 * 0.35 * 0.15, 2 * np.pi**2 * 0.35 * 0.15**2),
    # Bracket: an L less a rounded heel and toe, plus a fillet. Plate: less corners and holes.
    "bracket": (
        2 * (0.25 + 0.25 * 0.65 - (1 - np.pi / 4) * (0.04 + 0.01 - 0.0144))
        + 0.5 * (3.8 - (2 - np.pi / 2) * (0.2 + 0.1 + 0.12)),
        0.5 * (0.25 + 0.25 * 0.65 - (1 - np.pi / 4) * (0.04 + 0.01 - 0.0144)),
    ),
    "plate": (
        2 * (0.7 - 2 * (1 - np.pi / 4) * 0.15**2 - np.pi * (0.15**2 + 0.01))
        + 0.15 * (3.4 - 2 * (2 - np.pi / 2) * 0.15 + 2 * np.pi * 0.25),
        0.15 * (0.7 - 2 * (1 - np.pi / 4) * 0.15**2 - np.pi * (0.15**2 + 0.01)),
    ),
}

# Radius, height of the waves, their number: of balls with bumps.
BUMPY = {"pebble": (0.45, 0.04, 3), "coral": (0.4, 0.05, 7)}
AXES = torch.tensor([(1.0, 0.3, 0.2), (-0.4, 1, 0.1), (0.2, -0.3, 1), (1, 1, -1)]).double()


def _radius(name, towards):
    radius, height, degree = BUMPY[name]
    cosines = towards @ (AXES / AXES.norm(dim=1, keepdim=True)).T
    return radius * (1 + height * torch.cos(degree * torch.arccos(cosines)).sum(dim=-1))


def _integrate(name, nodes=600):
    """Area and volume of a ball with bumps by the midpoint rule and central differences."""
    step = np.pi / nodes
    theta = (torch.arange(-1, nodes + 1).double() + 0.5) * step
    phi = (torch.arange(-1, 2 * nodes + 1).double() + 0.5) * step
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    towards = [theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()]
    radius = _radius(name, torch.stack(towards, dim=-1))
    down = (radius[2:, 1:-1] - radius[:-2, 1:-1]) / (2 * step)
    round_ = (radius[1:-1, 2:] - radius[1:-1, :-2]) / (2 * step)
    inner, sine = radius[1:-1, 1:-1], theta[1:-1, 1:-1].sin()
    area = inner * ((inner**2 + down**2) * sine**2 + round_**2).sqrt()
    return area.sum().item() * step**2, (inner**3 / 3 * sine).sum().item() * step**2


KNOWN |= {name: _integrate(name) for name in BUMPY}


def _torus(p):
    return (torch.hypot(p[:, 0], p[:, 1]) - 0.35) ** 2 + p[:, 2] ** 2 - 0.15**2


def _rounded_box(p):
    beyond = (p.abs() - torch.tensor([0.4, 0.25, 0.15], dtype=p.dtype)).clamp(min=0)
    return (beyond**2).sum(dim=1) - 0.01


def _capsule(p):
    beyond = (p[:, 2].abs() - 0.3).clamp(min=0)
    return p[:, 0] ** 2 + p[:, 1] ** 2 + beyond**2 - 0.0625


IMPLICIT = {
    "sphere": lambda p: (p**2).sum(dim=1) - 0.25,
    "torus": _torus,
    "rounded_box": _rounded_box,
    "capsule": _capsule,
    "pebble": lambda p: p.norm(dim=1) - _radius("pebble", p / p.norm(dim=1, keepdim=True)),
    "coral": lambda p: p.norm(dim=1) - _radius("coral", p / p.norm(dim=1, keepdim=True)),
}
CONVEX = ["cube", "cuboid", "thin_plate", "octahedron", "dodecahedron", "hexagonal_prism"]


def test_every_shape_has_its_formula():
    assert set(KNOWN) == set(SHAPES)


@pytest.mark.parametrize("name", SHAPES)
def test_areas_of_faces_add_up(name):
    area = make_shape(name, 10).face_areas.sum().item()
    assert area == pytest.approx(KNOWN[name][0], rel=1e-4 if name in BUMPY else 1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_surface_is_closed_and_normals_point_outwards(name):
    shape = make_shape(name, 100_000)
    area, volume = KNOWN[name]
    normals, points = shape.normals.double(), shape.points.double()
    assert (normals.norm(dim=1) - 1).abs().max() < 1e-6
    # The flux of a constant field is zero, that of the position three times the volume.
    assert normals.mean(dim=0).abs().max() < 5 / 100_000**0.5
    height = (points * normals).sum(dim=1)
    tolerance = 5 * height.std() / 100_000**0.5
    assert (height.mean() - 3 * volume / area).abs() <= tolerance + 1e-7


@pytest.mark.parametrize("name", SHAPES)
def test_points_of_faces_are_proportional_to_areas(name):
    shape = make_shape(name, 50_000)
    counts = shape.labels.bincount(minlength=len(shape.kinds)).numpy()
    areas = shape.face_areas.numpy()
    assert chisquare(counts, areas / areas.sum() * 50_000).pvalue > 1e-4 or len(areas) == 1


@pytest.mark.parametrize("name", IMPLICIT)
def test_points_and_normals_are_those_of_the_equation(name):
    shape = make_shape(name, 20_000)
    points = shape.points.double().requires_grad_()
    values = IMPLICIT[name](points)
    [gradient] = torch.autograd.grad(values.sum(), points)
    assert values.abs().max() < 1e-6
    expected = gradient / gradient.norm(dim=1, keepdim=True)
    assert (shape.normals.double() - expected).abs().max() < 1e-5


@pytest.mark.parametrize("name", CONVEX)
def test_no_point_of_a_convex_shape_is_beyond_a_face(name):
    shape = make_shape(name, 20_000)
    heights = shape.points.double() @ shape.face_normals.T - shape.face_offsets
    assert heights.max() < 1e-6


def test_planar_faces_hold_their_points():
    for name in SHAPES:
        shape = make_shape(name, 5000)
        flat = shape.planar[shape.labels]
        labels, points = shape.labels[flat], shape.points[flat].double()
        residuals = (points * shape.face_normals[labels]).sum(dim=1) - shape.face_offsets[labels]
        assert not flat.any() or residuals.abs().max() < 1e-6
        assert torch.equal(shape.normals[flat], shape.face_normals[labels].float())


def test_points_are_spread_evenly_over_curved_faces():
    ball = make_shape("sphere", 50_000).points.double().numpy()
    # Archimedes: every coordinate of an even sphere is uniform.
    for axis in range(3):
        assert kstest(ball[:, axis] + 0.5, "uniform").pvalue > 1e-3
    torus = make_shape("torus", 50_000).points.double().numpy()
    across = np.arctan2(torus[:, 2], np.hypot(torus[:, 0], torus[:, 1]) - 0.35)
    counts, edges = np.histogram(across, bins=16, range=(-np.pi, np.pi))
    weights = 0.35 * np.diff(edges) + 0.15 * np.diff(np.sin(edges))
    assert chisquare(counts, weights / weights.sum() * 50_000).pvalue > 1e-4
    coral = make_shape("coral", 50_000).points.double()
    lengths = coral.norm(dim=1)
    # By area, the mean of 1/A' over the surface is the solid angle by the area.
    flux = (coral / lengths[:, None] * make_shape("coral", 50_000).normals.double()).sum(dim=1)
    assert (flux / lengths**2).mean() == pytest.approx(4 * np.pi / KNOWN["coral"][0], rel=0.02)
    cone = make_shape("cone", 50_000)
    heights = cone.points[cone.labels == 1, 2].double().numpy()
    assert kstest((1 - heights) ** 2, "uniform").pvalue > 1e-3
    plate = make_shape("plate", 50_000)
    top = plate.points[plate.labels == 1].double().numpy()
    inner = (np.abs(top[:, :2] - [0.3, 0.35]) < 0.15).all(axis=1)
    assert inner.sum() / len(top) == pytest.approx(
        (4 - np.pi) * 0.0225 / plate.face_areas[1].item(), rel=0.15
    )


def test_ends_of_extruded_parts_follow_their_rounded_outline():
    plate = make_shape("plate", 50_000)
    ends = plate.points[plate.labels < 2].double()
    corner = (ends[:, 0] < 0.15) & (ends[:, 1] < 0.15)
    assert corner.any()
    assert (ends[corner, :2] - 0.15).norm(dim=1).max() < 0.15 + 1e-6
    bracket = make_shape("bracket", 50_000)
    ends = bracket.points[bracket.labels < 2].double()
    fillet = (ends[:, 0] > 0.25 + 1e-6) & (ends[:, 1] > 0.25 + 1e-6)
    assert fillet.any()
    assert (ends[fillet, :2] - 0.37).norm(dim=1).min() > 0.12 - 1e-6


def test_curved_faces_are_marked():
    bracket = make_shape("bracket", 10)
    assert bracket.planar.tolist() == [True] * 8 + [False] * 3
    assert make_shape("cylinder", 10).planar.tolist() == [True, False, True]


def test_noise_is_a_share_of_the_diagonal():
    exact, noisy = (make_shape("cuboid", 50_000, noise) for noise in (0, 0.006))
    diagonal = (1 + 0.36 + 0.35**2) ** 0.5
    shifts = (noisy.points - exact.points).double().numpy() / (0.006 * diagonal)
    for axis in range(3):
        assert kstest(shifts[:, axis], "norm").pvalue > 1e-3
    assert torch.equal(noisy.normals, exact.normals)
    along = make_shape("cuboid", 50_000, 0.006, noise_direction="normal").points - exact.points
    lengths = (along * exact.normals).sum(dim=1)
    assert lengths.std().item() == pytest.approx(0.006 * diagonal, rel=0.02)
    assert (along - lengths[:, None] * exact.normals).abs().max() < 1e-6


def test_unknown_shape_is_refused():
    with pytest.raises(ConfigError, match=r"make_shape: expected name to be one of cube, .*'egg'"):
        make_shape("egg")
