"""Polygons with few corners against shapes that are known."""

import numpy as np
import pytest

from torchrg.io.outlines import straighten_rings

shapely = pytest.importorskip("shapely", reason="needs the extra outline")


def ragged(corners, rng, spacing=0.05, noise=0.02):
    """The corners, with points between them that are off the sides."""
    ring = shapely.segmentize(shapely.LinearRing(corners), spacing)
    dense = np.asarray(ring.coords)[:-1]
    return np.roll(dense + rng.uniform(-noise, noise, dense.shape), 7, axis=0)


RECTANGLE = np.array([[0.0, 0], [6, 0], [6, 2.5], [0, 2.5]])
WALL_WITH_DOOR = np.array([[0.0, 0], [2, 0], [2, 2], [3, 2], [3, 0], [6, 0], [6, 2.5], [0, 2.5]])


@pytest.mark.parametrize("shape", [RECTANGLE, WALL_WITH_DOOR])
@pytest.mark.parametrize("degrees", [0.0, 33.0])
def test_corners_are_those_of_the_shape(shape, degrees):
    rng, turn = np.random.default_rng(0), np.radians(degrees)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    (ring,) = straighten_rings([ragged(shape, rng) @ axes + 9], 0.05, 0.003)
    assert len(ring) == len(shape)
    found, truth = shapely.Polygon(ring), shapely.Polygon(shape @ axes + 9)
    assert shapely.hausdorff_distance(found.exterior, truth.exterior) < 0.03
    assert found.area == pytest.approx(truth.area, rel=0.005)


def test_holes_stay_and_areas_change_by_less_than_a_hundredth():
    rng = np.random.default_rng(1)
    outer, hole = ragged(RECTANGLE, rng), ragged(RECTANGLE / 6 + 1, rng)[::-1]
    rings = straighten_rings([outer, hole], 0.05, 0.003)
    assert [len(ring) for ring in rings] == [4, 4]
    before, after = shapely.Polygon(outer, [hole]).area, shapely.Polygon(rings[0], rings[1:]).area
    assert after == pytest.approx(before, rel=0.01)
    assert not shapely.LinearRing(rings[1]).is_ccw


def test_a_round_table_keeps_its_area():
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    (ring,) = straighten_rings([circle], 0.05, 0.0)
    assert shapely.Polygon(ring).area == pytest.approx(shapely.Polygon(circle).area, rel=0.01)
    assert len(ring) < 60


def test_straight_rings_stay():
    (ring,) = straighten_rings([RECTANGLE], 0.05, 0.003)
    assert shapely.Polygon(ring).equals_exact(shapely.Polygon(RECTANGLE), 1e-12) or (
        shapely.Polygon(ring).symmetric_difference(shapely.Polygon(RECTANGLE)).area < 1e-12
    )


def test_without_shapely_rings_stay(monkeypatch):
    monkeypatch.setattr("torchrg.io.outlines.find_spec", lambda name: None)
    assert straighten_rings([RECTANGLE], 1.0, 1.0)[0] is RECTANGLE
