"""Whole pictures: what they show, and what they do not depend on."""

import pytest
import torch

from torchrg.errors import ConfigError, ShapeError
from torchrg.render import color_planes, make_camera, render_cloud
from torchrg.scenes import make_room

RED, BLUE = (220, 30, 30), (30, 30, 220)
VIEWS = ["cutaway", "above", "outside", "sensor"]


@pytest.fixture(scope="module")
def room():
    scene = make_room(4000, seed=2)
    return scene.points + 1, color_planes(scene.labels, scene.points), scene.normals


def square(depth, color, half=1.0, count=60):
    line = torch.linspace(-half, half, count)
    points = torch.cartesian_prod(line, line, torch.tensor([depth]))
    return points, torch.tensor(color, dtype=torch.uint8).repeat(len(points), 1)


def hue_share(picture, color):
    """Share of pixels whose largest channel is that of a color."""
    chosen = picture.float()
    drawn = chosen.amin(dim=-1) < 200
    channel = torch.tensor(color).argmax()
    return float((drawn & (chosen.argmax(dim=-1) == channel)).float().mean())


def front_camera(width=80, height=60):
    return make_camera(torch.eye(4), 50.0, ((width - 1) / 2, (height - 1) / 2), width, height)


def test_what_is_in_front_hides_what_is_behind(rng):
    near, red = square(2.0, RED, half=0.5)
    far, blue = square(4.0, BLUE, half=2.0)
    order = torch.randperm(len(near) + len(far), generator=rng)
    points, colors = torch.cat([near, far])[order], torch.cat([red, blue])[order]
    picture = render_cloud(points, colors, view=front_camera())
    assert picture[30, 40].argmax() == 0
    assert picture[30, 58].argmax() == 2
    # 50 px * 1 m / 2 m = 25 px a side, and 50 px behind it
    assert hue_share(picture, RED) == pytest.approx(25 * 25 / 4800, rel=0.2)
    assert hue_share(picture, RED) + hue_share(picture, BLUE) == pytest.approx(
        50 * 50 / 4800, rel=0.15
    )


def test_surfaces_are_closed_at_every_distance(rng):
    for depth in (1.5, 6.0, 30.0):
        flat = depth * (torch.rand(3000, 2, generator=rng) * 2.4 - 1.2)
        points = torch.cat([flat, torch.full((3000, 1), depth)], dim=1)
        colors = torch.tensor(BLUE, dtype=torch.uint8).repeat(3000, 1)
        picture = render_cloud(points, colors, view=front_camera())
        assert bool((picture[5:-5, 5:-5].float().mean(dim=-1) < 160).all())


def face_of_box(eye, pose, size, focal):
    """The face of the unit cube that each pixel sees, by rays; -1 next to it."""
    places = torch.arange(size) - (size - 1) / 2
    rows, columns = torch.meshgrid(places, places, indexing="ij")
    rays = torch.stack([columns / focal, rows / focal, torch.ones(size, size)], dim=-1)
    low, high = ((side - eye) / (rays @ pose[:3, :3]) for side in (0.0, 1.0))
    first, axis = torch.minimum(low, high).max(dim=-1)
    face = 2 * axis + (high < low).gather(-1, axis[..., None]).squeeze(-1)
    return torch.where(first < torch.maximum(low, high).amin(dim=-1), face, -1)


@pytest.mark.parametrize("eye", [(2.5, 2.0, 1.8), (2.5, 0.9, 1.5)])
def test_discs_do_not_color_the_face_beyond_an_edge(rng, eye):
    """Discs that do not end at edges color eight in a hundred pixels wrongly, for the first eye."""
    count, most = 600, 0.01
    points = torch.rand(6 * count, 3, generator=rng)
    faces = torch.arange(6 * count) % 6
    points[torch.arange(6 * count), faces // 2] = (faces % 2).float()
    colors = 250 * torch.tensor([4, 2, 1, 6, 3, 5])[:, None].bitwise_and(
        torch.tensor([4, 2, 1])
    ).gt(0)
    eye, size, focal = torch.tensor(eye), 240, 260.0
    pose = torch.eye(4)
    forward = torch.nn.functional.normalize(0.5 - eye, dim=0)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]))
    right = torch.nn.functional.normalize(right, dim=0)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    camera = make_camera(pose, focal, ((size - 1) / 2,) * 2, size, size)
    normals = torch.eye(3)[faces // 2]
    picture = render_cloud(
        points, colors[faces].byte(), view=camera, normals=normals, supersampling=1
    )
    hue = picture.float() / picture.amax(dim=-1, keepdim=True).clamp(min=1)
    seen = (hue[:, :, None] - colors.float() / 250).square().sum(dim=-1).argmin(dim=-1)
    ground_truth = face_of_box(eye, pose, size, focal)
    assert float((seen != ground_truth)[ground_truth >= 0].float().mean()) < most


@pytest.mark.parametrize("view", ["cutaway", "sensor"])
def test_picture_does_not_depend_on_the_order_of_the_points(rng, room, view):
    points, colors, normals = room
    order = torch.randperm(len(points), generator=rng)
    settings = {"view": view, "width": 100}
    one = render_cloud(points, colors, normals=normals, **settings)
    other = render_cloud(points[order], colors[order], normals=normals[order], **settings)
    assert torch.equal(one, other)


@pytest.mark.parametrize(("scale", "shift"), [(2.0**-13, 0.0), (1.0, 5e6)])
def test_picture_does_not_depend_on_unit_or_origin(room, scale, shift):
    points, colors, normals = room
    one = render_cloud(points.double(), colors, normals=normals, width=100)
    other = render_cloud(scale * points.double() + shift, colors, normals=normals, width=100)
    assert one.shape == other.shape
    differs = (one.int() - other.int()).abs().amax(dim=-1) > 8
    assert float(differs.float().mean()) < 0.01


@pytest.mark.parametrize("view", ["cutaway", "sensor"])
def test_nonfinite_points_do_not_matter(room, view):
    points, colors, normals = room
    bad = torch.tensor([[torch.nan, 0, 0], [0, torch.inf, 0], [-torch.inf, torch.nan, 1]])
    dirty = torch.cat([points[:100], bad, points[100:]])
    pad = torch.zeros(3, 3)
    settings = {"view": view, "width": 60}
    assert torch.equal(
        render_cloud(
            dirty,
            torch.cat([colors[:100], pad.byte(), colors[100:]]),
            normals=torch.cat([normals[:100], pad, normals[100:]]),
            **settings,
        ),
        render_cloud(points, colors, normals=normals, **settings),
    )


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((4, 3), torch.nan)])
def test_an_empty_cloud_is_a_white_picture(points, view):
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    picture = render_cloud(points, colors, view=view, width=40)
    assert picture.shape == (30, 40, 3)
    assert bool((picture == 255).all())
    camera = front_camera()
    assert bool((render_cloud(points, colors, view=camera) == 255).all())


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("count", [1, 3])
def test_one_place_is_a_dot_in_the_middle(view, count):
    points = torch.tensor([[3.0, -2.0, 7.0]]).repeat(count, 1)
    colors = torch.zeros(count, 3, dtype=torch.uint8)
    picture = render_cloud(points, colors, view=view, width=41, height=31)
    rows, columns = (picture[..., 0] < 255).nonzero().T
    assert 0 < len(rows) <= 16
    assert abs(float(rows.float().mean()) - 15) <= 1
    assert abs(float(columns.float().mean()) - 20) <= 1


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (1.0, 0.0, 0.0)])
def test_flat_clouds_and_lines_are_drawn(rng, normal):
    axis = torch.tensor(normal)
    flat = torch.rand(500, 3, generator=rng)
    flat = flat - (flat @ axis)[:, None] * axis
    for points in (flat, torch.rand(200, 1, generator=rng) * axis):
        colors = torch.zeros(len(points), 3, dtype=torch.uint8)
        for view in ("cutaway", "above"):
            picture = render_cloud(points, colors, view=view, width=60)
            assert bool((picture < 128).any())


def test_points_behind_the_camera_do_not_show(rng):
    near, red = square(2.0, RED)
    behind, blue = square(-2.0, BLUE)
    points, colors = torch.cat([behind, near]), torch.cat([blue, red])
    picture = render_cloud(points, colors, view=front_camera())
    assert hue_share(picture, BLUE) == 0
    assert hue_share(picture, RED) == pytest.approx(
        hue_share(render_cloud(near, red, view=front_camera()), RED), rel=0.05
    )
    assert hue_share(render_cloud(points, colors, view="sensor", width=60), BLUE) == 0


def test_discs_lie_in_their_planes():
    line = torch.linspace(-1, 1, 6)
    x, y = torch.cartesian_prod(line, line).unbind(dim=1)
    ridge = [torch.stack([x, y, 3 + sign * x], dim=1) for sign in (-1, 1)]
    colors = torch.tensor([RED, BLUE], dtype=torch.uint8).repeat_interleave(len(x), dim=0)
    normals = torch.tensor([[0.7, 0.0, 0.7], [-0.7, 0.0, 0.7]]).repeat_interleave(len(x), dim=0)
    picture = render_cloud(torch.cat(ridge), colors, view=front_camera(), normals=normals)
    # But for the two columns between which the sheets cross.
    columns = torch.tensor([*range(25, 39), *range(41, 55)])
    expected = torch.where(columns >= 40, 0, 2).expand(20, 28)
    assert torch.equal(picture[20:40, columns].argmax(dim=-1), expected)


def test_cutaway_shows_the_inside_and_outside_does_not():
    scene = make_room(8000, seed=5)
    is_floor = torch.tensor([kind == "floor" for kind in scene.kinds])[scene.labels]
    colors = torch.where(is_floor[:, None], torch.tensor(RED), torch.tensor(BLUE)).to(torch.uint8)
    for view, low, high in (("cutaway", 0.2, 1.0), ("above", 0.3, 1.0), ("outside", 0.0, 0.05)):
        picture = render_cloud(
            scene.points, colors, normals=scene.normals, labels=scene.labels, view=view, width=80
        )
        assert low <= hue_share(picture, RED) <= high


def test_numpy_and_tensors_give_one_picture(room):
    points, colors, normals = (part[:2000] for part in room)
    one = render_cloud(points, colors, normals=normals, width=80)
    other = render_cloud(points.numpy(), colors.numpy(), normals=normals.numpy(), width=80)
    assert torch.equal(one, other)


def test_input_that_needs_gradients_is_drawn(room):
    points, colors, normals = (part[:500] for part in room)
    picture = render_cloud(
        points.clone().requires_grad_(), colors, normals=normals.clone().requires_grad_(), width=50
    )
    assert not picture.requires_grad


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"points": torch.rand(5, 2)}, ShapeError, "render_cloud: expected points of shape"),
        ({"colors": torch.rand(5, 3)}, ShapeError, "colors of uint8, got float32"),
        ({"colors": torch.zeros(4, 3, dtype=torch.uint8)}, ShapeError, "expected colors of shape"),
        ({"normals": torch.zeros(4, 3)}, ShapeError, "expected normals of shape"),
        ({"labels": torch.zeros(4).long()}, ShapeError, "expected labels of shape"),
        ({"labels": torch.zeros(5)}, ShapeError, "expected integer labels, got float32"),
        ({"points": torch.zeros(5, 3).long()}, ShapeError, "points of float32 or float64"),
        ({"view": "inside"}, ConfigError, "view to be one of cutaway, above, outside, sensor"),
        ({"up": (0.0, 0.0, 0.0)}, ConfigError, "up to be a direction"),
        ({"width": 0}, ConfigError, "width from 1 to 8,192, got 0"),
        ({"height": 0}, ConfigError, "height from 1 to 8,192, got 0"),
        ({"supersampling": 0}, ConfigError, "supersampling from 1 to 16, got 0"),
        ({"width": 8192, "height": 8192}, ConfigError, "at most 67,108,864 subpixels, got 8,192 x"),
        ({"supersampling": 16}, ConfigError, "pixels with supersampling 16; lower one of them"),
    ],
)
def test_wrong_arguments_are_refused(changes, error, message):
    given = {"points": torch.rand(5, 3), "colors": torch.zeros(5, 3, dtype=torch.uint8)}
    with pytest.raises(error, match=message):
        render_cloud(**{**given, **changes})


def test_a_given_camera_checks_the_other_arguments():
    points, colors = square(2.0, RED, count=3)
    with pytest.raises(ConfigError, match="render_cloud: expected supersampling from 1 to 16"):
        render_cloud(points, colors, view=front_camera(), supersampling=0)
    with pytest.raises(ShapeError, match="render_cloud: expected colors"):
        render_cloud(points, colors[:2], view=front_camera())


def test_an_up_direction_may_name_an_axis(room):
    points, colors, _ = room
    named = render_cloud(points, colors, width=60, up="-y")
    assert torch.equal(named, render_cloud(points, colors, width=60, up=(0.0, -1.0, 0.0)))
