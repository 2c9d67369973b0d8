"""Clouds, segmentations and planes as objects."""

import numpy as np
import pytest
import torch

import torchrg
from tests.regions.test_table import columns_of
from torchrg.depth import segment_depth
from torchrg.pipeline import segment_planes
from torchrg.scenes import make_room
from torchrg.structures import PLANE_KINDS
from torchrg.structures.planes import PLANE_COLUMNS


@pytest.fixture(scope="module")
def seg():
    floor = torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.zeros(1))
    far = torch.tensor([[0.0, 0.0, 99.0], [torch.nan, 0, 0]])
    return torchrg.segment_planes(torch.cat([floor, far]), "classic", **{"planes.up": "z"})


def test_results_are_shown_in_one_line(seg):
    assert repr(seg) == "Segmentation(1,602 points, 1 plane, 99.9 % labeled)"
    assert repr(seg.planes) == "Planes(1 plane: 1 floor)"
    parts = torchrg.make_superpoints(seg.points, seg, counts=(10, 2))
    assert repr(parts).startswith("Superpoints(1,602 points, ")
    assert "\n" not in repr(parts)
    plane = "Plane(0, floor, 1,600 points, area 1521, normal (0.000, 0.000, 1.000), offset 0)"
    assert repr(seg.planes[0]) == plane
    cloud = torchrg.Cloud(np.zeros((3, 3)), {"intensity": np.zeros(3)})
    assert repr(cloud) == "Cloud(3 points, intensity)"


def test_images_are_shown_by_their_size():
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    seg = segment_depth(torch.full((30, 40), 2.0), camera)
    assert repr(seg) == "Segmentation(30 x 40 pixels, 1 plane, 100.0 % labeled)"


def test_a_segmentation_is_no_tuple(seg):
    assert seg == seg
    assert seg != torchrg.segment_planes(seg.points, "classic")
    for name in ("count", "index", "__len__", "__iter__"):
        assert not hasattr(seg, name)


def test_a_table_is_gone_through_plane_by_plane():
    pytest.importorskip("shapely", reason="needs torchrg[outline]")
    points = make_room(3000, noise=0.003, seed=0).points
    seg = segment_planes(points, "classic", **{"planes.up": "z", "planes.outline": True})
    planes = seg.planes
    assert len(planes) == len(planes.normal) == len(list(planes)) > 5
    for row, plane in enumerate(planes):
        assert plane.id == row
        assert plane.count == int((seg.labels == row).sum())
        assert plane.kind == PLANE_KINDS[planes.kind[row]]
        assert plane.outline is planes.outline[row]
        for name in PLANE_COLUMNS:
            one, column = getattr(plane, name), getattr(planes, name)[row]
            assert type(one) in (torch.Tensor, float, int, bool)
            assert torch.equal(torch.as_tensor(one, dtype=column.dtype), column)
    assert planes[-1].id == len(planes) - 1
    assert planes[torch.tensor(2)].id == 2
    with pytest.raises(
        IndexError, match=rf"expected a row in \[-{len(planes)}, {len(planes)}\), got 99"
    ):
        planes[99]
    assert [plane.id for plane in planes[:3]] == [0, 1, 2]
    assert [plane.id for plane in planes[-2:]] == [len(planes) - 2, len(planes) - 1]
    with pytest.raises(TypeError, match="got Tensor; index columns with masks"):
        planes[planes.area > 1]
    with pytest.raises(TypeError, match=r"got Plane; .* a plane has an id"):
        seg.inliers(planes[0])


def test_missing_attributes_name_what_to_use(seg):
    cloud = torchrg.Cloud(np.zeros((3, 3)), {"intensity": np.zeros(3)})
    for owner, name, use in [
        (seg, "save", r"torchrg.write_cloud\(path, cloud, seg\)"),
        (seg, "label", "seg.labels"),
        (seg.planes, "kinds", "seg.planes"),
        (seg.planes[0], "plane_model", "plane.equation"),
        (seg.planes[0], "points", r"points\[seg.inliers\(plane.id\)\]"),
        (cloud, "voxel_down_sample", "voxel, as in"),
        (cloud, "intensities", r"fields\['intensity'\]"),
    ]:
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; use {use}"):
            getattr(owner, name)
    with pytest.raises(AttributeError, match=r"'hue'; it has .*finite.* fields.'intensity'"):
        _ = cloud.hue


def test_equations_and_inliers_are_those_of_open3d(seg):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 4
    points[:, 2] = 5 + points[:, 0] / 2
    seg = segment_planes(points, "classic")
    a, b, c, d = seg.planes[0].equation
    assert (c, -a / c, b, -d / c) == pytest.approx((2 / 5**0.5, 0.5, 0, 5), abs=1e-5)
    assert torch.equal(seg.planes.equation[0], seg.planes[0].equation)
    assert seg.inliers(0).tolist() == [*range(500)]
    image = segment_depth(
        torch.full((30, 40), 2.0), torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    )
    assert len(image.inliers(0)) == 1200
    with pytest.raises(IndexError, match=r"inliers: expected a row in \[0, 1\), got 3\."):
        seg.inliers(3)
    with pytest.raises(IndexError, match=r"got -1; for points of no plane use seg.labels =="):
        seg.inliers(-1)


def test_items_of_results_are_attributes(seg):
    for owner, name in [(seg, "labels"), (seg.planes[0], "normal")]:
        with pytest.raises(TypeError, match=rf"not items, got \['{name}'\]; use {name}\."):
            owner[name]
    cloud = torchrg.Cloud(np.zeros((3, 3)), {"intensity": np.zeros(3)})
    with pytest.raises(TypeError, match=r"use fields\['intensity'\]\."):
        cloud["intensity"]
    with pytest.raises(TypeError, match=r"got \[Tensor of shape \(3,\)\]; use its attributes\."):
        cloud[torch.ones(3).bool()]


def test_a_segmentation_goes_to_a_device_whole():
    seg = segment_planes(make_room(2000, seed=0).points, "classic", keep_neighbors=True)
    away = seg.to("meta")
    tensors = [
        away.labels,
        away.normals,
        away.points,
        away.neighbors.indices,
        *columns_of(away.planes),
    ]
    assert {part.device.type for part in (*tensors, *away.planes.adjacency)} == {"meta"}
    back = seg.cpu()
    assert torch.equal(back.labels, seg.labels)
    assert torch.equal(back.planes.normal, seg.planes.normal)
    assert back.sampling == seg.sampling
