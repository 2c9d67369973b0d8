"""What is left out of a picture, on rooms whose walls are known."""

import pytest
import torch

from torchrg.render.cutaway import choose_viewpoint, find_sides
from torchrg.render.surface import sample_surface

SIZE = (6.0, 4.0, 2.5)
UP = torch.tensor([0.0, 0, 1])


def rectangle(rng, low, high, density=250.0):
    """Points on an axis-aligned rectangle."""
    low, high = torch.tensor(low), torch.tensor(high)
    sides = (high - low)[high > low]
    count = int(density * sides.prod())
    return low + (high - low) * torch.rand(count, 3, generator=rng)


def box_room(rng, size=SIZE, table=True):
    """Points of a room, and the face of each: floor, ceiling, x0, x1, y0, y1, table."""
    x, y, z = size
    faces = [
        ((0.0, 0.0, 0.0), (x, y, 0.0)),
        ((0.0, 0.0, z), (x, y, z)),
        ((0.0, 0.0, 0.0), (0.0, y, z)),
        ((x, 0.0, 0.0), (x, y, z)),
        ((0.0, 0.0, 0.0), (x, 0.0, z)),
        ((0.0, y, 0.0), (x, y, z)),
    ]
    if table:
        faces.append(((0.4 * x, 0.4 * y, 0.75), (0.7 * x, 0.7 * y, 0.75)))
    parts = [rectangle(rng, *face) for face in faces]
    points = torch.cat(parts) + 0.003 * torch.randn(sum(map(len, parts)), 3, generator=rng)
    return points, torch.repeat_interleave(torch.tensor([len(part) for part in parts]))


def kept_share(points, faces, view, *, up=UP, labeled=True, **settings):
    """Share of each face that a view keeps."""
    surface = sample_surface(points)
    sides = find_sides(surface, faces[surface.rows] if labeled else None, up)
    cut = choose_viewpoint(surface, sides, view, up, **settings).cut
    face = faces[surface.rows]
    return torch.bincount(face, (sides.of_points & cut) == 0) / torch.bincount(face)


@pytest.mark.parametrize("labeled", [True, False])
@pytest.mark.parametrize("azimuth_deg", [30.0, 210.0])
def test_cutaway_leaves_out_ceiling_and_near_walls_only(rng, azimuth_deg, labeled):
    points, faces = box_room(rng)
    fractions = kept_share(points, faces, "cutaway", azimuth_deg=azimuth_deg, labeled=labeled)
    assert float(fractions[1]) < 0.02
    assert float(fractions[[0, 6]].amin()) > 0.85
    walls = fractions[2:6]
    assert int((walls < 0.1).sum()) == 2
    assert int((walls > 0.8).sum()) == 2
    assert min(walls[0], walls[1]) < 0.1 < max(walls[0], walls[1])


def test_a_ceiling_much_sparser_than_the_rest_is_left_out(rng):
    points, faces = box_room(rng)
    kept = (faces != 1) | (torch.rand(len(faces), generator=rng) < 0.03)
    fractions = kept_share(points[kept], faces[kept], "cutaway", azimuth_deg=30.0)
    assert float(fractions[1]) == 0
    assert float(fractions[[0, 6]].amin()) > 0.85


@pytest.mark.parametrize(("scale", "turn_deg"), [(1e-4, 0.0), (1e3, 28.0)])
def test_cut_does_not_depend_on_unit_heading_or_origin(rng, scale, turn_deg):
    points, faces = box_room(rng)
    angle = torch.tensor(turn_deg).deg2rad()
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.tensor(0.0), torch.tensor(1.0)
    turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one]).view(3, 3)
    moved = scale * ((points @ turn.T).double() + torch.tensor([5e5, 4e6, 100.0]))
    fractions = kept_share(moved, faces, "cutaway", azimuth_deg=30.0)
    assert float(fractions[1]) == 0
    assert int((fractions[2:6] < 0.1).sum()) == 2
    assert float(fractions[[0, 6]].amin()) > 0.85


def test_outside_leaves_out_nothing(rng):
    points, faces = box_room(rng)
    assert float(kept_share(points, faces, "outside").amin()) == 1


def test_a_table_as_large_as_half_the_room_is_no_ceiling(rng):
    points, faces = box_room(rng, table=False)
    top = rectangle(rng, (0.9, 0.6, 0.75), (5.1, 3.4, 0.75))
    points = torch.cat([points[faces != 1], top])
    faces = torch.cat([faces[faces != 1], torch.full((len(top),), 6)])
    assert float(kept_share(points, faces, "above")[6]) == 1


def test_upward_axis_is_a_setting(rng):
    points, faces = box_room(rng)
    fractions = kept_share(points[:, [0, 2, 1]], faces, "above", up=torch.tensor([0.0, 1, 0]))
    assert float(fractions[1]) == 0
    assert float(fractions[[0, 2, 3, 4, 5, 6]].amin()) > 0.85


def test_two_ceilings_of_different_height_go_both(rng):
    low, low_faces = box_room(rng, (6.0, 4.0, 2.2), table=False)
    high, high_faces = box_room(rng, (6.0, 4.0, 2.9), table=False)
    points = torch.cat([low, high + torch.tensor([6.2, 0.0, 0.0])])
    fractions = kept_share(points, torch.cat([low_faces, high_faces + 6]), "above")
    assert float(fractions[[1, 7]].amax()) < 0.05
    assert float(fractions[[0, 6]].amin()) > 0.95


def test_what_is_in_a_wall_goes_with_it_and_what_stands_before_it_stays(rng):
    points, faces = box_room(rng)
    pane = rectangle(rng, (1.0, -0.1, 1.0), (2.0, -0.1, 2.0))
    handle = rectangle(rng, (1.4, 0.03, 1.4), (1.5, 0.03, 1.5), density=3000.0)
    cupboard = rectangle(rng, (3.0, 0.6, 0.0), (4.0, 0.6, 2.0))
    parts = (pane, handle, cupboard)
    faces = torch.cat([faces, *(torch.full((len(part),), 7 + n) for n, part in enumerate(parts))])
    labels = torch.where(faces == 8, -1, faces)
    surface = sample_surface(torch.cat([points, *parts]))
    sides = find_sides(surface, labels[surface.rows], UP)
    cut = sides.bits_toward(torch.tensor([0.0, -1.0, 0.0]), "cutaway")
    kept, face = (sides.of_points & cut) == 0, faces[surface.rows]
    assert [bool(kept[face == n].any()) for n in (4, 7, 8)] == [False] * 3
    assert all(bool(kept[face == n].all()) for n in (0, 5, 6, 9))


def test_a_wall_between_two_rooms_stays(rng):
    points, faces = box_room(rng, table=False)
    fractions = kept_share(
        torch.cat([points, points + torch.tensor([0.0, 4.1, 0.0])]),
        torch.cat([faces, faces + 6]),
        "cutaway",
        azimuth_deg=30.0,
    )
    assert float(fractions[[5, 10]].amin()) == 1
    assert float(torch.minimum(fractions[4], fractions[11])) == 0


def test_a_room_is_seen_from_the_side_where_a_wall_is_missing(rng):
    points, faces = box_room(rng)
    kept = (faces != 1) & (faces != 4)
    surface = sample_surface(points[kept])
    sides = find_sides(surface, faces[kept][surface.rows], UP)
    assert float(choose_viewpoint(surface, sides, "outside", UP).toward[1]) < 0


def test_long_clouds_lie_across_the_picture_from_above(rng):
    points, faces = box_room(rng)
    for order in ([0, 1, 2], [1, 0, 2]):
        surface = sample_surface(points[:, order])
        sides = find_sides(surface, faces[surface.rows], UP)
        viewpoint = choose_viewpoint(surface, sides, "above", UP)
        extent = surface.points.amax(0) - surface.points.amin(0)
        right = torch.linalg.cross(viewpoint.up, viewpoint.toward)
        assert int(right.abs().argmax()) == int(extent.argmax())


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, -35.0])
def test_an_azimuth_is_one_direction_whichever_wall_is_largest(rng, turn_deg):
    points, faces = box_room(rng)
    angle = torch.tensor(turn_deg).deg2rad()
    turn = torch.tensor([[angle.cos(), angle.sin(), 0], [-angle.sin(), angle.cos(), 0], [0, 0, 1]])
    bearing = torch.tensor(turn_deg + 60).deg2rad()
    for largest in range(2, 6):
        lowered = (faces >= 2) & (faces < 6) & (faces != largest) & (points[:, 2] > 1.3)
        surface = sample_surface(points[~lowered] @ turn)
        sides = find_sides(surface, faces[~lowered][surface.rows], UP)
        toward = choose_viewpoint(surface, sides, "outside", UP, azimuth_deg=60).toward
        level = torch.nn.functional.normalize(toward[:2], dim=0)
        torch.testing.assert_close(
            level, torch.stack([bearing.cos(), bearing.sin()]), atol=0.02, rtol=0
        )


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_clouds_of_few_points_have_no_walls(rng, count):
    surface = sample_surface(torch.rand(count, 3, generator=rng))
    sides = find_sides(surface, None, UP)
    assert len(sides.directions) == 0
    assert choose_viewpoint(surface, sides, "cutaway", UP).cut == 0


def test_walls_that_voxels_at_a_corner_join_are_walls_all_the_same(room):
    surface = sample_surface(room(80_000, 0.003, 0).points)
    assert find_sides(surface, None, UP).directions.abs().max(dim=1).values.amin() > 0.99
    assert len(find_sides(surface, None, UP).directions) == 5
