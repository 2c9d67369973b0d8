"""Colors: planes that touch against brute force, and to eyes that lack a cone."""

import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from torchrg.errors import ConfigError, ShapeError
from torchrg.neighbors import search_knn
from torchrg.regions.adjacency import KnnAdjacency
from torchrg.render import color_curvature, color_normals, color_planes, color_sharp
from torchrg.render.colors import palette_of_planes, rgb_to_lab
from torchrg.scenes import make_room

CLEARLY = 20.0  # in Lab; 2.3 is just noticeable
DICHROMACIES = {
    "protanopia": (
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ),
    "deuteranopia": (
        (0.367322, 0.860646, -0.227968),
        (0.280085, 0.672501, 0.047413),
        (-0.011820, 0.042940, 0.968881),
    ),
    "tritanopia": (
        (1.255528, -0.076749, -0.178779),
        (-0.078411, 0.930809, 0.147602),
        (0.004733, 0.691367, 0.303900),
    ),
}
"""How linear RGB looks to eyes that lack one kind of cone: rows of the matrices of Machado et al.,
A physiologically-based model for simulation of color vision deficiency, 2009, severity 1."""


def without_cone(colors, matrix):
    """Return sRGB colors ``(C, 3)`` as eyes of a dichromacy see them."""
    linear = rgb_to_linear_rgb(colors.T[None, :, :, None])[0, :, :, 0].T
    seen = (linear @ linear.new_tensor(matrix).T).clamp(0, 1)
    return linear_rgb_to_rgb(seen.T[None, :, :, None])[0, :, :, 0].T


def lab_of(colors):
    return rgb_to_lab(colors.double() / 255)


def test_lab_has_the_published_value_of_red():
    red = torch.tensor([[[255, 0, 0]]], dtype=torch.uint8)
    expected = torch.tensor([[[53.24, 80.09, 67.20]]], dtype=torch.float64)
    torch.testing.assert_close(lab_of(red), expected, atol=0.02, rtol=0)


def test_planes_that_touch_look_clearly_different():
    room = make_room(20_000, seed=3)
    colors = color_planes(room.labels, room.points)
    table = torch.zeros(int(room.labels.max()) + 1, 3, dtype=torch.uint8)
    table[room.labels[room.labels >= 0]] = colors[room.labels >= 0]
    first, second = KnnAdjacency(search_knn(room.points, 9)).contacts(room.labels)[0].T
    distances = (lab_of(table[first]) - lab_of(table[second])).norm(dim=1)
    assert len(distances) > 200
    assert float(distances.amin()) > CLEARLY
    assert float(distances.median()) > 60
    _, a, b = lab_of(table).unbind(dim=1)
    hues = torch.atan2(b, a).rad2deg()
    turns = ((hues[first] - hues[second] + 180) % 360 - 180).abs()
    assert float(turns.amin()) > 14
    assert float(turns.quantile(0.05)) > 29


def test_colors_do_not_depend_on_the_order_of_the_points():
    room = make_room(5000, seed=1)
    order = torch.randperm(5000, generator=torch.Generator().manual_seed(0))
    colors = color_planes(room.labels, room.points)
    assert torch.equal(color_planes(room.labels[order], room.points[order]), colors[order])


def test_equal_labels_have_equal_colors_and_no_plane_is_gray():
    labels = torch.arange(300).repeat(3) % 150 - 1
    colors = color_planes(labels)
    for label in range(-1, 149):
        assert len(colors[labels == label].unique(dim=0)) == 1
    gray = torch.full((3,), 176, dtype=torch.uint8)
    assert bool((colors[labels == -1] == gray).all())
    distances = (lab_of(colors[labels >= 0]) - lab_of(gray)).norm(dim=1)
    assert float(distances.amin()) > 10


def test_matched_planes_have_the_colors_of_the_reference(rng):
    points = torch.rand(9000, 3, generator=rng)
    reference = (points[:, 0] * 9).long()
    labels = 8 - reference  # the same planes under other names
    labels[reference == 4] = -1
    expected = color_planes(reference, points)
    expected[reference == 4] = 176
    assert torch.equal(color_planes(labels, points, reference=reference), expected)


def test_split_planes_get_colors_of_their_own(rng):
    points = torch.rand(9000, 3, generator=rng)
    reference = (points[:, 0] * 3).long()
    split = reference + 3 * ((reference == 1) & (points[:, 1] < 0.3)).long()
    colors = color_planes(split, points, reference=reference)
    whole = color_planes(reference, points)
    assert torch.equal(colors[split == 1], whole[split == 1])
    distance = (lab_of(colors[split == 4][:1]) - lab_of(whole)).norm(dim=1)
    assert float(distance.amin()) > CLEARLY


def test_images_of_labels_keep_their_shape():
    labels = torch.arange(12).view(3, 4) // 6 - 1
    assert color_planes(labels).shape == (3, 4, 3)
    assert color_planes(labels, torch.rand(3, 4, 3), reference=labels).shape == (3, 4, 3)
    assert color_planes(labels.numpy()).shape == (3, 4, 3)


@pytest.mark.parametrize("count", [0, 5])
def test_clouds_without_planes_are_gray(count):
    colors = color_planes(torch.full((count,), -1), torch.rand(count, 3))
    assert colors.tolist() == [[176] * 3] * count


def test_nonfinite_points_keep_the_color_of_their_plane():
    points = torch.rand(50, 3)
    points[7] = torch.nan
    colors = color_planes(torch.arange(50) // 25, points)
    assert torch.equal(colors[7], colors[8])


def test_normals_and_their_opposites_have_one_color(rng):
    normals = torch.nn.functional.normalize(torch.randn(200, 3, generator=rng), dim=1)
    assert torch.equal(color_normals(normals), color_normals(-normals))


def test_walls_at_a_right_angle_and_the_floor_look_clearly_different(rng):
    for up in ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)):
        axis = torch.tensor(up)
        wall = torch.linalg.cross(axis, torch.randn(3, generator=rng))
        wall = wall / wall.norm()
        normals = torch.stack([axis, wall, torch.linalg.cross(axis, wall)])
        lab = lab_of(color_normals(normals, up=up))
        distances = torch.pdist(lab)
        assert float(distances.amin()) > 0.15
        assert float(lab[0, 0]) > float(lab[1:, 0].amax())


def test_curvature_darkens_all_the_way():
    lightness = lab_of(color_curvature(torch.linspace(0, 0.1, 100)))[:, 0]
    assert bool((lightness.diff() < 0.004).all())
    assert float(lightness[0] - lightness[-1]) > 0.5


def test_curvature_scale_ends_at_a_tenth():
    ends = color_curvature(torch.tensor([0.1, 0.3, torch.nan]))
    assert torch.equal(ends[0], ends[1])
    assert ends[2].tolist() == color_curvature(torch.zeros(1))[0].tolist()


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: color_planes(torch.zeros(3)), ShapeError, "integer labels"),
        (lambda: color_planes(torch.zeros(3).long(), torch.rand(4, 3)), ShapeError, "points of"),
        (
            lambda: color_planes(torch.zeros(3).long(), reference=torch.zeros(2).long()),
            ShapeError,
            "reference of",
        ),
        (lambda: color_normals(torch.zeros(3, 2)), ShapeError, "normals of shape"),
        (lambda: color_normals(torch.zeros(3, 3), up=(0, 0, 0)), ConfigError, "up to be"),
        (lambda: color_curvature(torch.zeros(3).long()), ShapeError, "curvature of float32"),
        (lambda: color_sharp(torch.zeros(3)), ShapeError, "sharp of bool"),
    ],
)
def test_wrong_arguments_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize("dichromacy", [None, *DICHROMACIES])
def test_planes_that_touch_differ_for_all_eyes(dichromacy, rng):
    """Forty in a row, each next to the one before it."""
    labels = torch.arange(40).repeat_interleave(30)
    across, *others = torch.rand(3, 1200, generator=rng)
    points = torch.stack([labels + 0.5 * across, *others], dim=1)
    palette = palette_of_planes(labels, points)[1][:40].double() / 255
    if dichromacy is not None:
        palette = without_cone(palette, DICHROMACIES[dichromacy])
    assert float(rgb_to_lab(palette).diff(dim=0).norm(dim=1).amin()) > CLEARLY
