"""Faces that bend, columns and balls in depth images without noise."""

import math

import pytest
import torch

from torchrg.depth import segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.structures import UNLABELED

HEIGHT, WIDTH, FOCAL = 240, 320, 262.5
CAMERA = make_intrinsics(FOCAL, FOCAL, 159.5, 119.5)
STEP = 2e-4
"""Depth as files hold it, at a scale of 5000: in steps of 0.2 mm."""
BENDS = {
    "cushion": lambda s, t: 0.003 * (1 - (s / 0.4) ** 2 - (t / 0.4) ** 2),
    "waves": lambda s, t: 0.0015 * torch.sin(21 * s) * torch.sin(21 * t + 1),
    "ripples": lambda s, t: 0.0015 * torch.sin(63 * s) * torch.sin(63 * t + 1),
}
"""How far a face is from its plane at two places along it: at most 3 mm from end to end."""


def rays():
    u = (torch.arange(WIDTH).double() - 159.5) / FOCAL
    v = ((torch.arange(HEIGHT).double() - 119.5) / FOCAL)[:, None]
    return torch.stack(torch.broadcast_tensors(u, v, torch.ones(1, 1).double()), dim=-1)


def stored(depth):
    return ((depth / STEP).round() * STEP).float()


def sofa(bend):
    """Return depth and faces of a floor, a wall, and two seats with backs and fronts, bent."""
    tilt = math.radians(25)
    turn = torch.eye(3).double()
    turn[1:, 1:] = torch.tensor(
        [[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]]
    )
    view = rays() @ turn
    depth = torch.full((HEIGHT, WIDTH), torch.inf, dtype=torch.float64)
    truth = torch.full((HEIGHT, WIDTH), UNLABELED)
    faces = [(1, 1.4, (-4, 0), (4, 6), False), (2, 3.6, (-4, -3), (4, 2), False)]
    for left in (-0.7, 0.0):
        right = left + 0.68
        faces += [
            (1, 0.95, (left, 2.0), (right, 2.8), True),
            (2, 2.0, (left, 0.95), (right, 1.4), True),
            (2, 2.8, (left, 0.35), (right, 0.95), True),
        ]
    for number, (axis, place, low, high, is_bent) in enumerate(faces):
        others = [other for other in range(3) if other != axis]
        along = place / view[..., axis]
        for _ in range(4):
            ends = (view * along[..., None])[..., others]
            s, t = (ends - (torch.tensor(low) + torch.tensor(high)) / 2).unbind(dim=-1)
            along = (place + (bend(s, t) if is_bent else 0)) / view[..., axis]
        inside = ((ends >= torch.tensor(low)) & (ends <= torch.tensor(high))).all(dim=-1)
        nearer = inside & (along > 0) & (along < depth)
        depth, truth = torch.where(nearer, along, depth), torch.where(nearer, number, truth)
    return torch.where(depth.isfinite(), depth, 0.0), truth


def columns():
    """Return depth and surfaces of a wall, a floor, a column and a ball."""
    view = rays()
    depth = torch.full((HEIGHT, WIDTH), 4.5, dtype=torch.float64)
    truth = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    floor = 1.2 / view[..., 1].clamp(min=1e-9)
    column, ball = torch.tensor([-0.7, 0, 3.0]).double(), torch.tensor([0.5, 0.4, 2.2]).double()
    surfaces = [floor]
    for middle, radius, axes in ((column, 0.25, [0, 2]), (ball, 0.3, [0, 1, 2])):
        across, middle = view[..., axes], middle[axes]
        a, b = across.square().sum(dim=-1), across @ middle
        root = b * b - a * (middle @ middle - radius**2)
        surfaces.append(torch.where(root > 0, (b - root.clamp(min=0).sqrt()) / a, torch.inf))
    for number, surface in enumerate(surfaces, start=1):
        truth = torch.where(surface < depth, number, truth)
        depth = torch.minimum(depth, surface)
    return depth, truth


def share_of_one_region(labels, face):
    inside = labels[face]
    return float((inside == inside[inside >= 0].mode().values).double().mean())


@pytest.mark.parametrize("bend", BENDS)
def test_bent_faces_without_noise_are_whole_regions(bend):
    depth, truth = sofa(BENDS[bend])
    seg = segment_depth(stored(depth), CAMERA)
    for face in range(8):
        is_face = (truth == face) & (depth > 0)
        labels = seg.labels[is_face]
        assert float((labels >= 0).double().mean()) >= 0.98, face
        assert share_of_one_region(seg.labels, is_face) >= 0.95, face
        assert float((truth[seg.labels == labels.mode().values] == face).double().mean()) > 0.95
    assert len(seg.planes) <= 10


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_columns_and_balls_are_regions_with_and_without_noise(noise, rng):
    depth, truth = columns()
    noisy = depth + noise * torch.randn(depth.shape, generator=rng, dtype=torch.float64)
    seg = segment_depth(stored(noisy), CAMERA)
    for surface, least in ((2, 0.8), (3, 0.8)):
        assert share_of_one_region(seg.labels, truth == surface) >= least
    if noise == 0:
        column = seg.labels[truth == 2].mode().values
        assert bool(seg.planes.curved[column])


def test_columns_with_the_noise_of_a_sensor_fall_into_few_parts(rng):
    depth, truth = columns()
    noise = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    noisy = depth + noise * torch.randn(depth.shape, generator=rng, dtype=torch.float64)
    seg = segment_depth(stored(noisy), CAMERA)
    assert len(seg.planes) <= 8
    assert share_of_one_region(seg.labels, truth == 2) >= 0.7


@pytest.mark.parametrize("angle", [12.0, 20.0, 40.0])
def test_creases_without_noise_stay_open(angle):
    half = math.tan(math.radians(angle / 2))
    view = rays()
    left, right = 2 / (1 + half * (view[..., 0] + 0.1)), 2 / (1 - half * (view[..., 0] + 0.1))
    seg = segment_depth(stored(torch.maximum(left, right)), CAMERA)
    assert seg.planes.count.tolist()[2:] == []
    assert len(seg.planes) == 2
    assert not seg.planes.curved.any()


def test_small_steps_without_noise_stay_open():
    depth = torch.full((HEIGHT, WIDTH), 2.0, dtype=torch.float64)
    depth[:, 160:] = 2.005
    seg = segment_depth(stored(depth), CAMERA)
    assert seg.planes.offset.tolist() == pytest.approx([2.0, 2.005], abs=1e-5)
