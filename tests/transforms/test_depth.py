"""Depth images as clouds, one by one, in batches, and fused."""

from pathlib import Path

import pytest
import torch

from tests.made import build_scanned_room, cameras_around, render_depth
from torchrg.datasets import RGBDFrame
from torchrg.depth import segment_depth
from torchrg.depth.camera import depth_to_points, find_intrinsics, make_intrinsics
from torchrg.errors import CloudWarning, ConfigError, ShapeError
from torchrg.structures import UNLABELED, Planes
from torchrg.transforms import DepthToCloud, SegmentDepth, fuse_depth


@pytest.fixture(scope="module")
def frames():
    """Three small frames of one room, the last without depth in a corner."""
    model = build_scanned_room(1)
    cameras = cameras_around(model, 3, seed=1, width=96, height=72)
    frames = [render_depth(model, camera) for camera in cameras]
    frames[2].depth[:20, :30] = 0
    return frames


def sample_of(frame, **more):
    camera = frame.camera
    return {
        "depth": frame.depth[None],
        "intrinsics": camera.intrinsics,
        "pose": camera.pose,
        **more,
    }


def batch_of(frames):
    return torch.utils.data.default_collate([sample_of(frame) for frame in frames])


def test_points_are_depth_times_ray(frames, dtype):
    depth = frames[2].depth.to(dtype)
    points = depth_to_points(depth[None], frames[2].camera.intrinsics[None])[0]
    expected = depth[..., None] * torch.from_numpy(frames[2].camera.rays()).to(dtype)
    seen = depth > 0
    torch.testing.assert_close(points[seen], expected[seen])
    assert points[~seen].isnan().all()
    assert points.dtype == dtype


def test_points_carry_gradients_to_the_depth():
    depth = torch.tensor([[[1.0, 0.0], [2.0, 3.0]]], requires_grad=True)
    torch.nansum(depth_to_points(depth, torch.eye(3)[None])[..., 2]).backward()
    assert depth.grad.tolist() == [[[1, 0], [1, 1]]]


def test_the_camera_of_an_organised_cloud_is_found(frames):
    camera = frames[2].camera.intrinsics
    points = depth_to_points(frames[2].depth[None], camera[None])[0]
    torch.testing.assert_close(find_intrinsics(points), camera, atol=1e-3, rtol=0)
    turned = points @ frames[2].camera.pose[:3, :3].float().T
    assert find_intrinsics(turned) is None
    assert find_intrinsics(torch.full((3, 4, 3), torch.nan)) is None
    behind = points * torch.tensor([1, 1, -1])
    assert find_intrinsics(behind) is None
    angle = torch.linspace(-1.0, 1.0, 50)
    ring = torch.stack([angle.sin(), torch.zeros(50), angle.cos()], dim=-1)
    assert find_intrinsics(ring.expand(6, 50, 3) * torch.arange(1, 7)[:, None, None]) is None


@pytest.mark.parametrize(
    ("every", "pixels", "found"),
    [(1, 0.09, True), (1, 0.15, False), (60, 1, False), (120, 1, True)],
)
def test_a_camera_puts_nearly_all_points_within_a_tenth_of_a_pixel(every, pixels, found):
    camera = make_intrinsics(50.0, 50.0, 29.5, 19.5)
    points = depth_to_points(torch.full((1, 40, 60), 2.0).double(), camera[None])[0]
    moved = points.view(-1, 3)[::every]
    moved[:, 0] += 2 / 50 * pixels * (1 - 2 * (torch.arange(len(moved)) % 2))
    assert (find_intrinsics(points) is not None) == found


def test_a_cloud_takes_values_back_into_its_image(frames):
    sample = sample_of(frames[2], color=torch.arange(3 * 144 * 192).view(3, 144, 192) % 251)
    cloud = DepthToCloud()(sample)
    seen = frames[2].depth > 0
    assert torch.equal(cloud["pixel"], seen.flatten().nonzero().squeeze(1))
    assert cloud["coord"].dtype == torch.float64
    image = torch.zeros(seen.numel(), 3, dtype=torch.float64)
    image[cloud["pixel"]] = cloud["coord"]
    without_pose = {key: value for key, value in sample.items() if key != "pose"}
    camera = DepthToCloud()(without_pose)["coord"]
    turn = frames[2].camera.pose
    torch.testing.assert_close(
        image.view(72, 96, 3)[seen], camera.double() @ turn[:3, :3].T + turn[:3, 3]
    )
    assert torch.equal(cloud["color"], sample["color"][:, ::2, ::2].permute(1, 2, 0)[seen])
    assert "offset" not in cloud


def test_a_batch_is_its_frames_one_by_one(frames):
    batch = batch_of(frames)
    cloud, planes = DepthToCloud()(batch), SegmentDepth(planes=True)(batch)
    ends = cloud["offset"].tolist()
    for i, (frame, begin, end) in enumerate(zip(frames, [0, *ends], ends, strict=False)):
        single = DepthToCloud()(sample_of(frame))
        assert torch.equal(cloud["coord"][begin:end], single["coord"])
        assert torch.equal(cloud["pixel"][begin:end], single["pixel"])
        seg = segment_depth(frame.depth, frame.camera.intrinsics, pose=frame.camera.pose)
        assert torch.equal(planes["plane"][i], seg.labels)
        assert torch.equal(planes["normal"][i], seg.normals)
        assert torch.equal(planes["curvature"][i], seg.curvature)
        assert torch.equal(planes["planes"][i].offset, seg.planes.offset)
    assert planes["plane"].shape == (3, 72, 96)


def test_one_camera_serves_a_batch(frames):
    depth = torch.stack([frame.depth for frame in frames])[:, None]
    sample = {"depth": depth, "intrinsics": frames[0].camera.intrinsics}
    labels = SegmentDepth()(sample)["plane"]
    own = {"depth": frames[1].depth, "intrinsics": frames[0].camera.intrinsics.numpy()}
    assert torch.equal(labels[1], SegmentDepth()(own)["plane"])


def test_results_are_in_camera_coordinates_without_a_pose(frames):
    sample = sample_of(frames[0])
    del sample["pose"]
    found = SegmentDepth(planes=True)(sample)
    own = segment_depth(frames[0].depth, frames[0].camera.intrinsics)
    assert torch.equal(found["normal"], own.normals)
    assert isinstance(found["planes"], Planes)


def test_samples_are_not_changed_and_keys_can_be_renamed(frames):
    sample = sample_of(frames[0])
    before = {key: value.clone() for key, value in sample.items()}
    renamed = SegmentDepth(keys={"plane": "instance"})(sample)
    DepthToCloud()(sample)
    assert all(torch.equal(sample[key], value) for key, value in before.items())
    assert "instance" in renamed
    assert "plane" not in renamed


def test_wrong_samples_are_refused(frames):
    sample = sample_of(frames[0])
    with pytest.raises(ConfigError, match=r"expected keys to rename depth, .*, got image"):
        SegmentDepth(keys={"image": "depth"})
    with pytest.raises(ConfigError, match="expected a sample with 'intrinsics', got depth"):
        SegmentDepth()({"depth": sample["depth"]})
    with pytest.raises(ShapeError, match=r"expected depth of shape \(H, W\), .* got \(2, 72, 96\)"):
        SegmentDepth()({**sample, "depth": torch.ones(2, 72, 96)})
    with pytest.raises(ShapeError, match=r"expected pose of shape \(4, 4\) or \(1, 4, 4\)"):
        SegmentDepth()({**sample, "pose": torch.eye(3)})
    with pytest.raises(ShapeError, match="expected color of shape"):
        DepthToCloud()({**sample, "color": torch.ones(72, 96, 3)})
    with pytest.raises(ConfigError, match="make_intrinsics: expected intrinsics of rows"):
        make_intrinsics(0.0, 1.0, 0.0, 0.0)


def test_fused_frames_remember_frame_and_pixel(frames):
    fused = fuse_depth([sample_of(frame) for frame in frames])
    for i, frame in enumerate(frames):
        mine = fused.frame == i
        row, column = fused.pixel[mine] // 96, fused.pixel[mine] % 96
        rays = torch.from_numpy(frame.camera.rays())[row, column]
        local = frame.depth[row, column].double()[:, None] * rays
        pose = frame.camera.pose
        torch.testing.assert_close(
            fused.coord[mine], local @ pose[:3, :3].T + pose[:3, 3], atol=1e-6, rtol=0
        )
    labels = torch.cat([frame.labels[frame.depth > 0] for frame in frames])
    for frame, image in zip(frames, fused.to_frames(labels), strict=True):
        expected = torch.where(frame.depth > 0, frame.labels, UNLABELED)
        assert torch.equal(image, expected)


def test_a_voxel_size_in_another_unit_is_told(frames):
    with pytest.warns(CloudWarning, match=r"fuse_depth: voxel 20 leaves 1 of [\d,]+ points; check"):
        fuse_depth(map(sample_of, frames), voxel_size=20)


def test_labels_of_voxels_go_back_into_every_frame(frames):
    color = torch.randint(0, 255, (3, 72, 96), dtype=torch.uint8)
    samples = [sample_of(frame, color=color) for frame in frames]
    every, fused = fuse_depth(samples), fuse_depth(samples, voxel_size=0.05)
    assert len(fused.coord) < 0.7 * len(every.coord)
    assert fused.color.shape == fused.coord.shape
    assert torch.equal(fused.color, color.permute(1, 2, 0).reshape(-1, 3)[fused.pixel])
    back = fused.to_frames(fused.coord, fill=0)
    own = every.to_frames(every.coord, fill=0)
    for frame, near, exact in zip(frames, back, own, strict=True):
        # Both points are in one cell.
        assert float((near - exact).abs().max()) <= 0.05
        assert not near[frame.depth == 0].any()


def test_what_cannot_be_fused_is_refused(frames):
    sample = sample_of(frames[0])
    with pytest.raises(ConfigError, match="expected at least one sample"):
        fuse_depth([])
    with pytest.raises(ConfigError, match="expected a pose in sample 1"):
        fuse_depth([sample, {key: sample[key] for key in ("depth", "intrinsics")}])
    with pytest.raises(ShapeError, match="one by one"):
        fuse_depth([batch_of(frames)])
    with pytest.raises(ShapeError, match="expected 6912 values, got 3"):
        fuse_depth([sample]).to_frames(torch.zeros(3))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *(((0, 0), 0.0), ((1, 1), 0.0), ((0, 2), torch.nan), ((1, 1), torch.inf)),
        *(((0, 0), 1e-320), ((0, 1), 3.0), ((2, 0), 20.0), ((2, 2), 0.0)),
    ],
)
def test_a_matrix_that_is_no_camera_is_refused(place, value):
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]], dtype=torch.float64)
    depth = torch.full((1, 30, 40), 2.0)
    camera[place] = value
    sample = {"depth": depth, "intrinsics": camera}
    calls = {
        "segment_depth": lambda: segment_depth(depth[0], camera),
        "depth_to_points": lambda: depth_to_points(depth, camera[None]),
        "SegmentDepth": lambda: SegmentDepth()(sample),
        "DepthToCloud": lambda: DepthToCloud()(sample),
        "RGBDFrame": lambda: RGBDFrame(Path("0.png"), camera, 1000.0, "0"),
    }
    for name, call in calls.items():
        with pytest.raises(ConfigError, match=rf"^{name}: expected intrinsics of rows \(fx, 0, cx"):
            call()


def test_negative_focal_lengths_turn_the_image_over():
    depth = torch.rand(1, 3, 4, generator=torch.Generator().manual_seed(0)) + 1
    camera, mirrored = ([[5.0, 0, 2], [0, fy, 1], [0, 0, 1]] for fy in (5.0, -5.0))
    expected = depth_to_points(depth, torch.tensor([camera])) * torch.tensor([1.0, -1, 1])
    torch.testing.assert_close(depth_to_points(depth, torch.tensor([mirrored])), expected)


def test_tables_are_collated_into_a_list(frames):
    single = SegmentDepth(planes=True)
    batch = torch.utils.data.default_collate([single(sample_of(frame)) for frame in frames])
    expected = single(batch_of(frames))["planes"]
    assert len(batch["planes"]) == len(frames)
    for table, other in zip(batch["planes"], expected, strict=True):
        assert torch.equal(table.normal, other.normal)
