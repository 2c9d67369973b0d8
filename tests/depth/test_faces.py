"""Faces a few pixels wide, faces that something nearer parts, and strips along rounded edges."""

import math

import pytest
import torch

from torchrg.depth import segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.depth.faces import join_strips
from torchrg.depth.pixels import InverseCloud
from torchrg.depth.windows import (
    NARROW,
    Image,
    Windows,
    find_jitter,
    fit_narrow_windows,
    fit_windows,
    window_pixels,
)

HEIGHT, WIDTH, FOCAL = 240, 320, 262.5
CAMERA = make_intrinsics(FOCAL, FOCAL, 159.5, 119.5)


def rays():
    u, v = torch.meshgrid(torch.arange(WIDTH), torch.arange(HEIGHT), indexing="xy")
    ray = torch.stack([(u - 159.5) / FOCAL, (v - 119.5) / FOCAL, torch.ones_like(u)], dim=-1)
    return ray.double()


def step_in_a_wall(view):
    """Return depth and faces of a wall whose right half is 20 cm behind the left one.

    The side between the two is seen at a grazing angle, less than five pixels wide.
    """
    left, right, side = 2.0, 2.2, 0.25 / view[..., 0].clamp(min=1e-9)
    depth = torch.where(side > right, right, torch.where(side > left, side, left))
    depth = torch.where(view[..., 0] < 0.25 / right, right, depth)
    face = torch.where((depth > left) & (depth < right), 1, torch.where(depth == left, 0, 2))
    return depth, face


def test_narrow_windows_are_those_of_a_literal_least_squares_fit(rng):
    height, width = 14, 17
    u, v = torch.arange(width).double() - 8, torch.arange(height).double() - 7
    image = torch.randn(height, width, generator=rng, dtype=torch.float64)
    seen = torch.rand(height, width, generator=rng) < 0.8
    seen.view(-1)[[1, 40, 7 * width + 8, -1]] = True
    pixels = seen.flatten().nonzero().squeeze(1)
    numbers = torch.full((height, width), -1)
    numbers.view(-1)[pixels] = torch.arange(len(pixels))
    planes = Windows(*fit_narrow_windows(Image(image, seen, u, v), numbers, pixels))
    for shape, (rows, columns) in enumerate(NARROW):
        held = torch.stack([at for at, _ in window_pixels(numbers, pixels, rows, columns)], dim=1)
        for pixel in (1, 40, 7 * width + 8, height * width - 1):
            number = int(numbers.view(-1)[pixel])
            row, column = divmod(pixel, width)
            inside = torch.zeros_like(seen)
            top, left = max(row - rows // 2, 0), max(column - columns // 2, 0)
            area = (slice(top, row + rows // 2 + 1), slice(left, column + columns // 2 + 1))
            inside[area] = seen[area]
            found = held[number]
            assert found[found >= 0].tolist() == inside.flatten().nonzero().squeeze(1).tolist()
            deviation = planes.deviation[shape, number]
            if int(inside.sum()) < 0.4 * rows * columns:
                assert deviation.isinf()
                continue
            x, y = u.expand_as(image)[inside], v[:, None].expand_as(image)[inside]
            matrix = torch.stack([x, y, torch.ones_like(x)], dim=1)
            solution = torch.linalg.lstsq(matrix, image[inside][:, None]).solution[:, 0]
            rest = image[inside] - matrix @ solution
            expected = (rest.square().sum() / (len(x) - 3)).sqrt()
            torch.testing.assert_close(deviation, expected)
            slopes = torch.stack([planes.u_slope[shape, number], planes.v_slope[shape, number]])
            torch.testing.assert_close(slopes, solution[:2])


@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.1, 0.4])
def test_jitter_of_rays_is_found(jitter, rng):
    u, v = torch.arange(WIDTH).double() - 159.5, torch.arange(HEIGHT).double() - 119.5
    moved = [torch.randn(HEIGHT, WIDTH, generator=rng).double() * jitter for _ in range(2)]
    image = 0.5 + 0.001 * (u + moved[0]).abs() + 0.0005 * (v[:, None] + moved[1])
    seen = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    found = find_jitter(fit_windows(Image(image, seen, u, v))[2], 2)
    assert found == pytest.approx(min(jitter, 0.15), rel=0.1, abs=1e-4)


def test_faces_a_few_pixels_wide_are_regions():
    depth, face = step_in_a_wall(rays())
    assert 2 <= int((face == 1)[0].sum()) <= 4
    seg = segment_depth(depth.float(), CAMERA)
    assert len(seg.planes) == 3
    inside = seg.labels[face == 1]
    side = int(inside.mode().values)
    assert float((inside == side).double().mean()) > 0.7
    assert float((face[seg.labels == side] == 1).double().mean()) > 0.7
    normal = seg.planes.normal[side].double()
    assert abs(float(normal[0])) > 0.9


def test_a_wall_behind_a_post_is_one_region():
    depth = 3 / (1 + 0.2 * rays()[..., 0])
    depth[:, 140:170] = 1.5
    seg = segment_depth(depth.float(), CAMERA)
    assert len(seg.planes) == 2
    assert seg.labels[100, 20] == seg.labels[100, 300]


def test_a_shadow_without_depth_beside_a_post_parts_no_wall():
    depth = torch.full((HEIGHT, WIDTH), 3.0)
    depth[:, 140:170], depth[:, 170:185] = 1.5, 0.0
    assert len(segment_depth(depth, CAMERA).planes) == 2
    depth[:, 140:185] = 0.0
    assert len(segment_depth(depth, CAMERA).planes) == 2


def test_planes_that_end_stay_apart():
    # Through a gap between two fronts the wall behind is seen, also where a post hides a part.
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, 140:170] = 3.0
    seg = segment_depth(depth, CAMERA)
    assert len(seg.planes) == 3
    # Nor does it help that a post stands in most of the gap.
    depth[:, 140:163] = 1.0
    assert len(segment_depth(depth, CAMERA).planes) == 4
    # Behind the post one side is 5 cm farther away.
    depth[:, 140:170], depth[:, 170:] = 1.0, 2.05
    assert len(segment_depth(depth, CAMERA).planes) == 3


def roof(turn_deg, step=0.0):
    """Return labels and planes for ``join_strips``: a face, and 6 columns next to it."""
    x = rays()[0, :, 0]
    slope = math.tan(math.radians(turn_deg))
    crease = float(x[200])
    # In space: z = 2, and z = 2 + step + slope (x - 2 crease).
    planes = torch.tensor([[0, 0, 0.5], [-slope, 0, 1.0]], dtype=torch.float64)
    planes[1] /= 2 + step - slope * 2 * crease
    labels = torch.full((HEIGHT, WIDTH), -1)
    labels[:, 100:200], labels[:, 200:206] = 0, 1
    normals = torch.tensor([[0, 0, -1.0], [slope, 0, -1.0]]).double()
    normals /= normals.norm(dim=1, keepdim=True)
    return labels, planes, normals


def join(labels, planes, normals, axes=(0, 1)):
    """Return what ``join_strips`` makes of an image, or of one turned over with its axes."""
    places = [rays()[0, :, 0], rays()[:, 0, 1]]
    noise = torch.full(labels.shape, 1e-6).double()
    count = torch.bincount(labels[labels >= 0], minlength=len(planes))
    axes = [*axes, 2]
    x, y = (places[axis] for axis in axes[:2])
    planes, normals = planes[:, axes], normals[:, axes]
    cloud = InverseCloud(noise, x, y, noise, labels >= 0)
    return join_strips(cloud, labels.flatten(), planes, normals, count).view(labels.shape)


@pytest.mark.parametrize(("turn", "step", "joins"), [(20, 0, 1), (50, 0, 0), (20, 0.05, 0)])
def test_a_strip_joins_the_face_that_it_bends_away_from(turn, step, joins):
    labels, *others = roof(turn, step)
    joined = join(labels, *others)
    assert joined[:, 200:206].unique().tolist() == [1 - joins]
    assert torch.equal(joined[:, :200], labels[:, :200])
    assert torch.equal(join(labels.T, *others, axes=(1, 0)), joined.T)


def test_wide_regions_and_strips_beside_narrow_ones_stay():
    labels, *others = roof(20)
    labels[:, 200:225] = 1
    assert torch.equal(join(labels, *others), labels)
    labels[:, 206:] = -1
    labels[:, :190] = -1
    assert torch.equal(join(labels, *others), labels)


def test_one_region_or_none_stays():
    labels, planes, normals = roof(20)
    for kept in (labels.clamp(max=0), torch.full_like(labels, -1)):
        assert torch.equal(join(kept, planes[:1], normals[:1]), kept)
