"""Projection and framing against plain NumPy."""

import math

import numpy as np
import pytest
import torch

from torchrg.render.cameras import (
    FIELD_OF_VIEW_DEG,
    fit_camera,
    local_camera,
    make_camera,
    project,
    sensor_camera,
    view_axes,
)


def project_by_hand(points, rotation, position, focal, center):
    """Pixels of points as a textbook has it, in float64."""
    local = (np.asarray(points, dtype=np.float64) - position) @ rotation.T
    return focal * local[:, :2] / local[:, 2:] + center, local


def random_rotation(rng):
    return torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64))[0]


@pytest.mark.parametrize("finer", [1, 2, 3])
@pytest.mark.parametrize("far", [0.0, 5e6])
def test_projection_equals_the_textbook(rng, finer, far):
    rotation, position = random_rotation(rng), torch.tensor([1.0, 2, 3], dtype=torch.float64) + far
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    camera = make_camera(matrix, 500.0, (319.5, 200.25), 640, 400)
    local = torch.randn(50, 3, generator=rng) + 6 * rotation[2].float()
    origin = position + torch.tensor([0.25, -0.5, 0.125], dtype=torch.float64)
    positions, pixels = project(local_camera(camera, origin, finer=finer), local)
    expected, axes = project_by_hand(
        local.double() + origin, rotation.numpy(), position.numpy(), 500.0, (319.5, 200.25)
    )
    np.testing.assert_allclose(positions, axes, atol=2e-5)
    np.testing.assert_allclose(pixels, (expected + 0.5) * finer - 0.5, atol=2e-2)


def test_axes_are_a_right_handed_frame_with_up_upwards(rng):
    toward, up = torch.randn(2, 3, generator=rng, dtype=torch.float64)
    axes = view_axes(toward, up)
    torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(axes)) == pytest.approx(1)
    assert float(axes[2] @ toward) == pytest.approx(-float(toward.norm()))
    assert float(axes[1] @ up) < 0
    assert float(axes[0] @ up) == pytest.approx(0, abs=1e-12)


def pixels_of(camera, points):
    return camera.project(points[None].double())[0]


@pytest.mark.parametrize("shape", [(200, 120), (120, 200), (200, None)])
def test_fitted_camera_shows_all_points_as_large_as_it_can(rng, shape):
    width, height = shape
    points = torch.randn(300, 3, generator=rng) * torch.tensor([5.0, 2.0, 1.0]) + 30
    axes = view_axes(torch.randn(3, generator=rng), torch.tensor([0.0, 0, 1]))
    camera = fit_camera(points, axes, width=width, height=height)
    size = torch.tensor([float(camera.width), float(camera.height)], dtype=torch.float64)
    pixels = pixels_of(camera, points)
    low, high = (pixels.amin(0) + 0.5) / size, (pixels.amax(0) + 0.5) / size
    assert bool((low > 0.0299).all())
    assert bool((high < 0.9701).all())
    torch.testing.assert_close(low + high, torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0)
    assert float((high - low).amax()) == pytest.approx(0.94, abs=1e-6)
    depth = (points.double() @ axes.T)[:, 2] + camera.extrinsics[0, 2, 3]
    assert bool((depth > 0).all())


def test_default_height_is_what_the_points_need(rng):
    points = torch.rand(500, 3, generator=rng) * torch.tensor([10.0, 1.0, 5.0])
    axes = view_axes(torch.tensor([0.0, -1, 0]), torch.tensor([0.0, 0, 1]))
    camera = fit_camera(points, axes, width=1000)
    assert 450 < int(camera.height) < 530
    assert int(fit_camera(points[:, [2, 1, 0]], axes, width=1000).height) == 1000


def test_angle_of_view_is_over_the_longer_side():
    axes = torch.eye(3, dtype=torch.float64)
    for width, height in ((300, 200), (200, 300)):
        camera = fit_camera(torch.rand(9, 3), axes, width=width, height=height)
        focal = float(camera.intrinsics[0, 0, 0])
        assert 2 * math.degrees(math.atan(150 / focal)) == pytest.approx(FIELD_OF_VIEW_DEG)


@pytest.mark.parametrize("count", [0, 1])
def test_one_place_is_seen_in_the_middle(count):
    point = torch.tensor([[3.0, 4.0, 5.0]])
    axes = view_axes(torch.tensor([1.0, 1, 1]), torch.tensor([0.0, 0, 1]))
    camera = fit_camera(point[:count], axes, width=40, height=30)
    if count:
        torch.testing.assert_close(
            pixels_of(camera, point)[0], torch.tensor([19.5, 14.5], dtype=torch.float64)
        )
    assert bool(camera.intrinsics.isfinite().all())


def test_points_on_the_line_of_sight_are_in_front():
    points = torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])
    camera = fit_camera(points, torch.eye(3, dtype=torch.float64), width=40)
    assert bool((points[:, 2] + camera.extrinsics[0, 2, 3] > 0).all())


def test_sensor_camera_stands_in_the_origin_and_ignores_what_is_behind(rng):
    points = torch.rand(200, 3, generator=rng) * torch.tensor([4.0, 2.0, 3.0]) + 0.5
    behind = points * torch.tensor([50.0, 50.0, -1.0])
    camera = sensor_camera(torch.cat([points, behind]), width=320)
    assert torch.equal(camera.extrinsics[0], torch.eye(4, dtype=torch.float64))
    size = torch.tensor([320.0, float(camera.height)], dtype=torch.float64)
    fractions = (pixels_of(camera, points) + 0.5) / size
    assert float(fractions.amin()) > 0.029
    assert float(fractions.amax()) < 0.971
    assert float((fractions.amax(0) - fractions.amin(0)).amax()) == pytest.approx(0.94, abs=1e-3)
