"""Outlines of planes: holes, areas and degenerate regions."""

import math

import numpy as np
import pytest
import torch

from tests.regions.test_table import one_region, rotation
from torchrg.errors import MissingDependencyError
from torchrg.regions import summarize_planes
from torchrg.regions.polygons import trace_polygon


def test_outline_of_a_frame_has_a_hole_and_its_area():
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(15)
    turn = rotation(rng)
    flat = rng.uniform(-1, 1, (12000, 3)) * [1, 1, 0]
    flat = flat[np.abs(flat[:, :2]).max(axis=1) > 0.5]
    points = torch.from_numpy(flat @ turn.T + 100)
    normals = torch.from_numpy(turn[:, 2]).expand(len(points), 3)
    planes = summarize_planes(points, normals, one_region(points), outline=True)
    outer, hole = planes.outline[0]
    residual = (torch.cat([outer, hole]) * planes.normal[0]).sum(1) - planes.offset[0]
    assert residual.abs().max() < 1e-9
    back = [(ring.numpy() - 100) @ turn[:, :2] for ring in (outer, hole)]
    polygon = shapely.Polygon(back[0], [back[1]])
    assert math.isclose(polygon.area, 3.0, rel_tol=0.03)
    sign = torch.sign(planes.normal[0] @ torch.from_numpy(turn[:, 2]))
    assert shapely.LinearRing(back[0]).is_ccw == (sign > 0)
    assert shapely.LinearRing(back[1]).is_ccw != (sign > 0)


def test_outlines_of_points_and_lines_are_empty():
    pytest.importorskip("shapely")
    points = torch.zeros(6, 3)
    points[:5, 0] = torch.arange(5.0)
    labels = torch.tensor([0] * 5 + [1])
    planes = summarize_planes(points, torch.eye(3)[[2] * 6], labels, outline=True)
    assert planes.outline == ((), ())


@pytest.mark.parametrize("seed", range(4))
def test_outline_of_a_turned_and_rounded_grid(seed):
    # Squares of the grid are on circles up to rounding, so that some triangles overlap.
    shapely = pytest.importorskip("shapely")
    rng, side = np.random.default_rng(seed), np.arange(40.0)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    x, y = grid[rng.random(len(grid)) < 0.9].T
    angle = rng.uniform(0, math.pi / 2)
    turned = x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)
    outer, *holes = trace_polygon(np.round(np.stack(turned, axis=1), 12), 1.6)
    assert shapely.Polygon(outer, holes).is_valid
    assert math.isclose(shapely.Polygon(outer).area, 39**2, rel_tol=0.02)


def test_outlines_without_shapely_say_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "shapely", None)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[outline\]'"):
        summarize_planes(points, points, one_region(points), outline=True)
