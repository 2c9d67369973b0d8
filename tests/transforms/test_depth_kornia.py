"""Depth images among kornia's modules: its cameras, and its augmentations on our results."""

import numpy as np
import pytest
import torch
from kornia.augmentation import AugmentationSequential, CenterCrop, RandomHorizontalFlip
from kornia.geometry.camera import PinholeCamera

from torchrg.depth import depth_to_points, segment_depth
from torchrg.errors import DepthWarning, ShapeError
from torchrg.transforms import DepthToCloud, SegmentDepth, fuse_depth

HEIGHT, WIDTH = 60, 80
CAMERA = torch.tensor([[75.0, 0, 39.5], [0, 75, 29.5], [0, 0, 1]])
MIRROR = torch.diag(torch.tensor([-1.0, 1, 1]))


def corner():
    """Return a depth image of a floor, a wall to the left and one in front."""
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    x, y = (columns - 39.5) / 75, (rows - 29.5) / 75
    floor, left = 0.7 / y.clamp(min=1e-3), 1.0 / (-x).clamp(min=1e-3)
    return torch.minimum(floor, left).clamp(max=3.0)


def of_four(matrix):
    whole = torch.eye(4)
    whole[:3, :3] = matrix
    return whole


def pinhole(count=1):
    sizes = torch.full((count,), float(HEIGHT)), torch.full((count,), float(WIDTH))
    return PinholeCamera(
        of_four(CAMERA).expand(count, 4, 4), torch.eye(4).expand(count, 4, 4), *sizes
    )


CAMERAS = {
    "3 x 3": CAMERA,
    "4 x 4": of_four(CAMERA),
    "a batch of one": of_four(CAMERA)[None],
    "an array": of_four(CAMERA).numpy().astype(np.float64),
    "PinholeCamera": pinhole(),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_every_kind_of_intrinsics_is_taken(kind):
    depth, camera = corner(), CAMERAS[kind]
    expected = segment_depth(depth, CAMERA)
    assert torch.equal(segment_depth(depth, camera).labels, expected.labels)
    found = SegmentDepth()({"depth": depth[None], "intrinsics": camera})
    assert torch.equal(found["plane"], expected.labels)
    assert found["intrinsics"] is camera
    sample = {"depth": depth[None], "intrinsics": camera, "pose": torch.eye(4)}
    plain = {**sample, "intrinsics": CAMERA}
    assert torch.equal(DepthToCloud()(sample)["coord"], DepthToCloud()(plain)["coord"])
    assert torch.equal(fuse_depth([sample]).coord, fuse_depth([plain]).coord)


def test_a_batch_of_cameras_is_taken():
    depth = corner().expand(2, -1, -1)
    points = depth_to_points(depth, pinhole(2))
    assert torch.equal(points, depth_to_points(depth, CAMERA.expand(2, 3, 3)))
    found = SegmentDepth()({"depth": depth[:, None], "intrinsics": pinhole(2)})
    assert found["plane"].shape == (2, HEIGHT, WIDTH)


@pytest.mark.filterwarnings("ignore:.*an optical axis off the center")
def test_a_camera_of_another_size_is_doubted():
    depth = torch.full((HEIGHT // 2, WIDTH // 2), 2.0)
    small = pinhole().scale(torch.tensor([0.5]))
    # Kornia leaves half a pixel out of its scaling, which no check may ask for.
    segment_depth(depth, small)
    for call in (
        lambda: segment_depth(depth.repeat(2, 3), pinhole()),
        lambda: SegmentDepth()({"depth": depth[None], "intrinsics": pinhole()}),
        lambda: DepthToCloud()({"depth": depth[None], "intrinsics": pinhole()}),
    ):
        with pytest.warns(DepthWarning, match="got a PinholeCamera of 80 x 60; scale it"):
            call()


def test_what_is_no_camera_is_refused():
    with pytest.raises(ShapeError, match="SegmentDepth: expected intrinsics to be a tensor or a"):
        SegmentDepth()({"depth": corner(), "intrinsics": "kinect"})
    with pytest.raises(ShapeError, match=r"expected intrinsics of shape \(3, 3\)"):
        segment_depth(corner(), torch.eye(2))


@pytest.mark.parametrize("mirrored", [True, False])
def test_a_flip_and_a_crop_keep_normals_planes_and_intrinsics_right(mirrored):
    found = SegmentDepth(planes=True)({"depth": corner()[None, None], "intrinsics": CAMERA})
    moves = AugmentationSequential(
        RandomHorizontalFlip(p=1.0), CenterCrop((40, 56)), data_keys=["input", "mask", "mask"]
    )
    masks = found["plane"][:, None].float(), found["normal"].movedim(-1, 1)
    depth, plane, normal = moves(found["depth"], *masks)
    plane, normal = plane[:, 0].long(), normal.movedim(1, -1)
    intrinsics, table = moves.transform_matrix @ CAMERA, found["planes"][0].normal.float()
    if mirrored:
        intrinsics, normal, table = intrinsics @ MIRROR, normal @ MIRROR, table @ MIRROR
    assert (float(intrinsics[0, 0, 0]) > 0) == mirrored

    # Every plane is where the camera sees it, with the normal of its pixels.
    points = depth_to_points(depth[:, 0], intrinsics)[0]
    assert len(plane.unique()) == 3
    for number, offset in enumerate(found["planes"][0].offset.tolist()):
        on_plane = plane[0] == number
        heights = points[on_plane] @ table[number]
        assert (heights - offset).abs().max() < 1e-3
        assert ((normal[0][on_plane] @ table[number]).abs() > 0.99).float().mean() > 0.95

    # And the frame is segmented the same way from the start: as many planes, of the same normals.
    again = SegmentDepth()({"depth": depth, "intrinsics": intrinsics})
    same = (again["plane"] == plane).float().mean()
    assert same > 0.97
    flat = (again["plane"] >= 0) & (plane >= 0)
    agree = (again["normal"][flat] * normal[flat]).sum(dim=-1)
    assert (agree > 0.99).float().mean() > 0.95
