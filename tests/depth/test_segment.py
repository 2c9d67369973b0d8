"""Planes of depth images: rendered rooms with truth, a real frame, and what must not matter."""

import math
import pickle

import pytest
import torch

from tests.made import build_scanned_room, cameras_around, render_depth
from tests.made.cameras import KINECT_LAYOUT
from torchrg.depth import DepthConfig, segment_depth
from torchrg.depth.camera import find_intrinsics, make_intrinsics
from torchrg.errors import ShapeError
from torchrg.io import read_cloud
from torchrg.linalg import unsigned_angle_deg
from torchrg.metrics import score_labels
from torchrg.structures import UNLABELED
from torchrg.structures.planes import PLANE_COLUMNS

SMALL = make_intrinsics(100.0, 100.0, 79.5, 59.5)


def rendered(seed, camera, *, sensor, width=640, height=480):
    model = build_scanned_room(seed, layout=KINECT_LAYOUT)
    cameras = cameras_around(model, 4, seed=seed, width=width, height=height)
    return render_depth(model, cameras[camera], sensor=sensor, seed=seed)


def f1(labels, frame):
    return score_labels(labels.flatten(), frame.labels.flatten()).f1


def corner(height=120, width=160):
    """Return depth and truth of a floor and two walls that meet, seen by the small camera."""
    u = (torch.arange(width).double() - 79.5) / 100
    v = (torch.arange(height).double()[:, None] - 59.5) / 100
    faces = torch.stack(
        [
            1.2 / v.clamp(min=1e-9).expand(height, width),
            3 / (1 + u).clamp(min=1e-9).expand(height, width),
            3 / (1 - u).clamp(min=1e-9).expand(height, width),
        ]
    )
    depth, truth = faces.min(dim=0)
    return depth, truth


@pytest.mark.parametrize(("seed", "camera"), [(0, 2), (2, 3)])
def test_faces_of_rendered_rooms_are_found(seed, camera):
    small = {"width": 320, "height": 240}
    exact = rendered(seed, camera, sensor="exact", **small)
    intrinsics = exact.camera.intrinsics
    seg = segment_depth(exact.depth, intrinsics)
    assert f1(seg.labels, exact) >= 95
    angles = unsigned_angle_deg(seg.normals[seg.valid], exact.normals[seg.valid])
    assert float((angles < 1).double().mean()) > 0.99
    noisy = rendered(seed, camera, sensor="kinect", **small)
    assert f1(segment_depth(noisy.depth, intrinsics).labels, noisy) >= 85
    millimeters = (exact.depth * 1000).round() / 1000
    assert f1(segment_depth(millimeters, intrinsics).labels, exact) >= 95


def test_faces_of_a_real_frame_are_regions(scan):
    cloud = read_cloud(scan("kinect_capture0001.pcd"))
    points = cloud.points.view(480, 640, 3)
    intrinsics = find_intrinsics(points)
    expected = make_intrinsics(525.0, 525.0, 319.5, 239.5)
    torch.testing.assert_close(intrinsics, expected, atol=0.05, rtol=0)
    depth = torch.nan_to_num(points[..., 2])
    seg = segment_depth(depth, intrinsics)
    # Row and column of places on one face each: wall, floor, box, front of the sideboard.
    faces = {
        "wall": [(60, 300), (60, 550), (150, 400), (180, 560)],
        "floor": [(450, 60), (450, 200), (460, 400)],
        "box": [(300, 320), (300, 420), (420, 320), (420, 425)],
        "left door": [(240, 310), (270, 360)],
        "right door": [(350, 490), (410, 550)],
    }
    labels = {name: {int(seg.labels[place]) for place in faces[name]} for name in faces}
    assert all(len(found) == 1 for found in labels.values()), labels
    first = [labels[name].pop() for name in ("wall", "floor", "box")]
    assert len({UNLABELED, *first, *labels["left door"]}) == 5
    assert float((seg.labels[depth > 0] >= 0).double().mean()) > 0.9
    wall, floor = seg.planes.normal[first[0]], seg.planes.normal[first[1]]
    assert float(unsigned_angle_deg(wall, floor)) > 80
    # The sensor bends the wall, and its depth has steps, of 2.85 mm times the square of meters.
    farthest = torch.stack([depth[seg.labels == label].max() for label in first])
    assert bool((seg.planes.rms[first] < 0.00285 * farthest**2).all())


def test_planes_are_those_of_the_scene():
    depth, truth = corner()
    seg = segment_depth(depth, SMALL)
    assert score_labels(seg.labels.flatten(), truth.flatten()).f1 > 99
    for label in range(3):
        face = int(truth[seg.labels == label].mode().values)
        offset, half = (1.2, 3.0, 3.0)[face], math.sqrt(0.5)
        normal = torch.tensor([[0, 1, 0], [half, 0, half], [-half, 0, half]])[face].double()
        distance = offset if face == 0 else offset * half
        torch.testing.assert_close(seg.planes.normal[label], normal, atol=1e-6, rtol=0)
        assert float(seg.planes.offset[label]) == pytest.approx(distance)
    assert not seg.planes.curved.any()
    assert float(seg.curvature[seg.labels >= 0].median()) < 1e-9


def test_normals_point_towards_the_camera():
    depth, _ = corner()
    seg = segment_depth(depth, SMALL)
    u = (torch.arange(160).double() - 79.5) / 100
    v = (torch.arange(120).double()[:, None] - 59.5) / 100
    rays = torch.stack([u.expand(120, 160), v.expand(120, 160), torch.ones(120, 160)], dim=-1)
    assert bool(((seg.normals * rays).sum(dim=-1)[seg.valid] < 0).all())
    assert float((seg.normals[seg.valid].norm(dim=-1) - 1).abs().max()) < 1e-9


def test_a_step_is_never_bridged(rng):
    depth = torch.full((120, 160), 2.0)
    depth[:, 80:] = 2.03
    depth += 0.003 * torch.randn(120, 160, generator=rng)
    seg = segment_depth(depth, SMALL)
    left, right = seg.labels[:, :78].unique(), seg.labels[:, 82:].unique()
    assert not set(left.tolist()) & set(right.tolist()) - {UNLABELED}
    assert len(seg.planes) == 2


def test_pixels_without_depth_belong_to_nothing():
    depth, _ = corner()
    depth[40:60, 50:70] = 0
    depth[10, 10:13] = torch.tensor([torch.nan, torch.inf, -1.0]).double()
    seg = segment_depth(depth, SMALL)
    bad = ~(depth.isfinite() & (depth > 0))
    assert bool((seg.labels[bad] == UNLABELED).all())
    assert not seg.valid[bad].any()
    assert not seg.sharp[bad].any()
    assert not seg.normals[bad].any()
    assert not seg.curvature[bad].any()
    assert float((seg.labels[~bad] >= 0).double().mean()) > 0.97


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 3), (40, 2), (48, 64)])
def test_images_without_depth_and_tiny_ones_have_no_planes(shape, dtype):
    height, width = shape
    camera = make_intrinsics(0.6 * max(shape), 0.6 * max(shape), (width - 1) / 2, (height - 1) / 2)
    for depth in (torch.zeros(shape, dtype=dtype), torch.full(shape, torch.nan, dtype=dtype)):
        seg = segment_depth(depth, camera)
        assert not seg.valid.any()
        assert seg.labels.shape == shape
        assert len(seg.planes) == 0
    if min(shape) < 40:
        assert len(segment_depth(torch.ones(shape, dtype=dtype), camera).planes) == 0


def test_random_depth_is_no_plane(rng):
    depth = 1 + 3 * torch.rand(120, 160, generator=rng)
    config = DepthConfig(noise=(0.0, 0.001))
    assert float((segment_depth(depth, SMALL, config).labels >= 0).double().mean()) < 0.05


@pytest.mark.filterwarnings("ignore:.*expected a median depth")
def test_unit_origin_and_dtype_do_not_matter():
    frame = rendered(2, 3, sensor="kinect", width=320, height=240)
    intrinsics = frame.camera.intrinsics
    seg = segment_depth(frame.depth, intrinsics)
    for unit in (2.0**-12, 2.0**10):
        other = segment_depth(frame.depth * unit, intrinsics)
        assert torch.equal(other.labels, seg.labels)
        torch.testing.assert_close(other.normals, seg.normals)
        torch.testing.assert_close(other.curvature, seg.curvature)
        torch.testing.assert_close(other.planes.offset, seg.planes.offset * unit)
    double = segment_depth(frame.depth.double(), intrinsics)
    assert double.normals.dtype == torch.float64
    assert torch.equal(double.labels, seg.labels)
    far = torch.eye(4, dtype=torch.float64)
    far[:3, 3] = torch.tensor([5e6, 4e5, 100.0])
    moved = segment_depth(frame.depth, intrinsics, pose=far)
    assert torch.equal(moved.labels, seg.labels)
    shift = moved.planes.offset - (moved.planes.normal.double() @ far[:3, 3])
    torch.testing.assert_close(shift, seg.planes.offset, atol=1e-3, rtol=0)


def test_threads_do_not_matter(set_threads):
    frame = rendered(2, 3, sensor="kinect", width=320, height=240)
    found = []
    for threads in (1, 3):
        set_threads(threads)
        found.append(segment_depth(frame.depth, frame.camera.intrinsics))
    assert torch.equal(found[0].labels, found[1].labels)
    assert torch.equal(found[0].normals, found[1].normals)


def test_a_pose_turns_normals_and_planes_into_the_world():
    frame = rendered(0, 2, sensor="exact", width=160, height=120)
    own = segment_depth(frame.depth, frame.camera.intrinsics)
    world = segment_depth(frame.depth, frame.camera.intrinsics, pose=frame.camera.pose)
    assert torch.equal(world.labels, own.labels)
    turn = frame.camera.pose[:3, :3].float()
    torch.testing.assert_close(world.normals, own.normals @ turn.T, atol=1e-5, rtol=0)
    upright = world.planes.normal[:, 2].abs()
    assert bool(((upright < 1e-3) | (upright > 0.999)).all())


def test_a_negative_focal_length_turns_the_axis_over():
    depth, _ = corner()
    over = make_intrinsics(100.0, -100.0, 79.5, 59.5)
    seg, turned = segment_depth(depth, SMALL), segment_depth(depth, over)
    assert torch.equal(seg.labels, turned.labels)
    torch.testing.assert_close(seg.normals * torch.tensor([1, -1, 1]), turned.normals)


def test_the_plane_table_is_measured_later_from_the_image_as_it_was():
    depth, intrinsics = corner()[0], make_intrinsics(100, 100, 79.5, 59.5)
    expected = segment_depth(depth, intrinsics, up="-y").planes
    assert len(expected.normal) == 3
    seg = segment_depth(depth, intrinsics, up="-y")
    depth.zero_()
    seg.labels.zero_()
    moved, copied = seg.to("cpu").planes, pickle.loads(pickle.dumps(seg)).planes
    for name in (*PLANE_COLUMNS, "kind"):
        for planes in (moved, copied, seg.planes):
            assert torch.equal(getattr(planes, name), getattr(expected, name)), name
    assert seg.planes is seg.planes


def test_depth_beyond_the_limit_is_left_out():
    depth = torch.full((60, 80), 2.0)
    depth[:, 40:] = 5.0
    camera = make_intrinsics(50.0, 50.0, 39.5, 29.5)
    seg = segment_depth(depth, camera, DepthConfig(max_depth=4.0))
    assert not seg.valid[:, 40:].any()
    assert seg.planes.count.tolist() == [2400]


def test_wrong_input_is_refused():
    with pytest.raises(ShapeError, match=r"segment_depth: expected depth of shape \(H, W\)"):
        segment_depth(torch.ones(2, 4, 4), SMALL)
    with pytest.raises(ShapeError, match="expected depth of float32 or float64, got float16"):
        segment_depth(torch.ones(120, 160, dtype=torch.float16), SMALL)
    with pytest.raises(ShapeError, match="intrinsics"):
        segment_depth(torch.ones(4, 4), torch.eye(5))
