"""Stored values of depth images: what is missing, units, rays, and their memory."""

import numpy as np
import pytest
import torch

from torchrg.depth import depth_to_points, segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.depth.values import convert_depth, drop_channel, has_depth
from torchrg.errors import ConfigError, DepthWarning, ShapeError
from torchrg.transforms import DepthToCloud, SegmentDepth

CAMERA = make_intrinsics(50.0, 52.0, 19.5, 14.5)
UNSIGNED = (torch.uint8, torch.uint16, torch.uint32, torch.uint64)


def wall(height=30, width=40):
    """A plane that leaves the camera to the right, in meters, float64."""
    return (2 + 0.01 * torch.arange(width).double()).expand(height, width).clone()


@pytest.mark.parametrize("kind", [*UNSIGNED, torch.int16, torch.int32, torch.int64])
def test_the_largest_value_of_an_integer_type_is_no_depth(kind):
    largest = torch.iinfo(kind).max
    depth = torch.tensor([0, 1, 99, largest - 1, largest], dtype=kind)
    # Doubles cannot tell the largest two values of 64 bits apart.
    before = largest < 2**53
    assert has_depth(depth).tolist() == [False, True, True, before, False]


@pytest.mark.parametrize("kind", [torch.int32, torch.uint32, torch.float32, torch.float64])
def test_the_code_of_16_bits_stays_no_depth_in_wider_types(kind):
    depth = torch.tensor([65534, 65535, 65536, -1 if kind.is_signed else 0])
    assert has_depth(depth.to(kind)).tolist() == [True, False, True, False]


def test_floating_point_without_meaning_is_no_depth(dtype):
    depth = torch.tensor([[torch.nan, torch.inf, -torch.inf], [-1.0, 0.0, 2.5]], dtype=dtype)
    converted = convert_depth("f", depth, None)
    assert converted.tolist() == [[0, 0, 0], [0, 0, 2.5]]
    assert converted.dtype == dtype


def test_integers_become_meters_of_float32():
    stored = torch.from_numpy(np.array([[1500, 0, 65535, 2001]], dtype=np.uint16))
    converted = convert_depth("f", stored, None, 1000)
    assert converted.dtype == torch.float32
    assert torch.equal(converted, torch.tensor([[1.5, 0, 0, 2.001]]))


def test_distances_along_the_ray_become_depth():
    rows, columns = torch.meshgrid(
        torch.arange(30.0).double(), torch.arange(40.0).double(), indexing="ij"
    )
    rays = torch.stack(
        [(columns - 19.5) / 50, (rows - 14.5) / 52, torch.ones(30, 40).double()], dim=-1
    )
    distance = wall() * rays.double().norm(dim=-1)
    distance[0, 0] = 65535.0
    expected = wall()
    expected[0, 0] = 0
    found = convert_depth("f", distance, CAMERA, 1.0, "ray")
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    batch = convert_depth("f", torch.stack([distance] * 2), CAMERA.expand(2, 3, 3), 1.0, "ray")
    assert torch.equal(batch, torch.stack([found] * 2))
    flipped = convert_depth("f", distance, make_intrinsics(50.0, -52.0, 19.5, 14.5), 1.0, "ray")
    torch.testing.assert_close(flipped, expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("shape", [(30, 40), (1, 30, 40), (30, 40, 1)])
def test_images_of_one_channel_have_two_axes(shape):
    image = torch.rand(shape)
    assert torch.equal(drop_channel(image).flatten(), image.flatten())
    assert drop_channel(image).shape == (30, 40)
    assert drop_channel(image.numpy()).shape == (30, 40)
    assert drop_channel(torch.rand(2, 30, 40)).shape == (2, 30, 40)


def test_any_memory_gives_the_same_planes():
    depth = wall().float()
    wide = torch.stack([depth, depth], dim=-1)
    expected = segment_depth(depth, CAMERA)
    for image in (
        depth.T.contiguous().T,
        wide[..., 0],
        np.asfortranarray(depth.numpy()),
        depth.numpy()[::-1].copy()[::-1],
        depth[None],
        depth.numpy().astype(">f4"),
    ):
        found = segment_depth(image, CAMERA)
        assert torch.equal(found.labels, expected.labels)
        assert torch.equal(found.normals, expected.normals)
        assert found.normals.is_contiguous()


def doors(depth, scale=1.0, kind="z"):
    """Return functions that take a depth image in Python, by name."""
    sample = {"depth": depth, "intrinsics": CAMERA}
    options = {"depth_scale": scale, "depth_kind": kind}
    return {
        "segment_depth": lambda: segment_depth(depth, CAMERA, **options).labels,
        "SegmentDepth": lambda: SegmentDepth(**options)(sample)["plane"],
        "DepthToCloud": lambda: DepthToCloud(**options)(sample)["coord"],
    }


@pytest.mark.parametrize("door", ["segment_depth", "SegmentDepth", "DepthToCloud"])
def test_every_door_converts_units_and_rays(door):
    meters = wall()
    meters[:5] = 0
    points = depth_to_points(torch.ones(1, 30, 40).double(), CAMERA[None])[0]
    stored = (meters * 1000).round()
    stored[:5] = 65535
    expected = doors((stored * (stored < 65535)) / 1000)[door]()
    found = doors(stored.to(torch.uint16), 1000)[door]()
    torch.testing.assert_close(found, expected.to(found.dtype), rtol=1e-6, atol=1e-6)
    rays = doors(stored / 1000 * points.norm(dim=-1) * (meters > 0), 1.0, "ray")[door]()
    torch.testing.assert_close(rays, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("door", ["segment_depth", "SegmentDepth", "DepthToCloud"])
@pytest.mark.parametrize("factor", [20.1 / 2.195, 1000.0, 0.04 / 2.195])
def test_every_door_doubts_a_median_that_no_camera_measures(door, factor):
    with pytest.warns(
        DepthWarning, match=r"expected a median depth of 0.05 to 20 m, got .*depth_s"
    ):
        doors(wall() * factor)[door]()
    doors(wall() * factor, factor)[door]()


@pytest.mark.parametrize(
    ("scale", "kind"), [(0.0, "z"), (-1, "z"), (torch.inf, "z"), (1, "euclid")]
)
def test_wrong_options_are_refused(scale, kind):
    with pytest.raises(
        ConfigError, match=r"segment_depth: expected depth_(scale > 0|kind to be one)"
    ):
        segment_depth(wall(), CAMERA, depth_scale=scale, depth_kind=kind)
    with pytest.raises(
        ConfigError, match=r"SegmentDepth: expected depth_(scale > 0|kind to be one)"
    ):
        SegmentDepth(depth_scale=scale, depth_kind=kind)


@pytest.mark.parametrize("kind", [torch.bool, torch.complex64, torch.float16])
def test_types_that_are_no_depth_are_refused(kind):
    with pytest.raises(
        ShapeError, match="segment_depth: expected depth of float32 or float64, got"
    ):
        segment_depth(wall().to(kind), CAMERA)
