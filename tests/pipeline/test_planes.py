"""The whole method: right planes, and the same answer however the cloud is given."""

import dataclasses

import numpy as np
import pytest
import torch

from torchrg.config import PipelineConfig, PlanesConfig, load_config
from torchrg.errors import ConfigError, ShapeError
from torchrg.io import read_cloud
from torchrg.metrics import score_labels
from torchrg.pipeline import segment_planes
from torchrg.structures import PLANE_KINDS, UNLABELED
from torchrg.structures.planes import PLANE_COLUMNS

PRESETS = ["classic", "paper", "consensus"]


def small(config):
    """Return settings that suit a cloud of a few thousand points."""
    return PipelineConfig(
        dataclasses.replace(config.normals, k=20),
        dataclasses.replace(config.growing, min_size=20),
        config.chunk_size,
    )


@pytest.fixture(scope="module")
def scene(room):
    return room(5000, 0.003, 1)


@pytest.fixture(scope="module", params=PRESETS)
def config(request):
    return small(load_config(request.param))


def assert_same_planes(ours, theirs):
    """Check that two tables without outlines are equal."""
    for name in (*PLANE_COLUMNS, "kind"):
        one, other = getattr(ours, name), getattr(theirs, name)
        assert one is other is None or torch.equal(one, other)
    for one, other in zip(ours.adjacency, theirs.adjacency, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("preset", PRESETS)
def test_box_faces_are_found(preset):
    generator = np.random.default_rng(0)
    points = generator.random((12000, 3)) * [4, 3, 2.5]
    face = generator.integers(0, 6, len(points))
    points[np.arange(len(points)), face // 2] = (face % 2) * np.array([4, 3, 2.5])[face // 2]
    seg = segment_planes(points, load_config(preset))
    scores = score_labels(seg.labels, torch.from_numpy(face))
    assert scores.recall_iou50 == 1.0
    assert len(seg.planes) == 6
    axis, offset = seg.planes.normal[:6].abs().argmax(dim=1), seg.planes.offset[:6].round().long()
    assert torch.stack([axis, offset]).unique(dim=1).shape[1] == 6


def test_table_says_what_meets_and_what_is_asked_for(room):
    scene = room(8000, 0.003, 1)
    plain = load_config("consensus")
    planes = segment_planes(scene.points, plain).planes
    assert planes.adjacency is not None
    assert [0, 2] in planes.adjacency.pairs.tolist()
    assert planes.outline is None
    without = planes.kind
    asked = dataclasses.replace(plain, planes=PlanesConfig(up="z", outline=True))
    planes = segment_planes(scene.points, asked).planes
    kinds = sorted(PLANE_KINDS[kind] for kind in planes.kind[:6])
    assert kinds == ["ceiling", "floor"] + ["wall"] * 4
    assert torch.equal(without, planes.kind)
    assert len(planes.outline) == len(planes)
    turned = dataclasses.replace(plain, planes=PlanesConfig(up="-y"))
    points = scene.points[:, [0, 2, 1]] * torch.tensor([1.0, -1, 1])
    assert segment_planes(points, turned).planes.kind.tolist() == planes.kind.tolist()


def test_order_changes_nothing(scene, config):
    shuffled = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(3))
    plain = segment_planes(scene.points, config)
    other = segment_planes(scene.points[shuffled], config)
    assert torch.equal(other.labels, plain.labels[shuffled])
    assert torch.equal(other.normals, plain.normals[shuffled])
    assert torch.equal(other.curvature, plain.curvature[shuffled])
    assert torch.equal(other.sharp, plain.sharp[shuffled])
    assert_same_planes(other.planes, plain.planes)
    counts = torch.bincount(plain.labels[plain.labels >= 0])
    assert torch.equal(counts, plain.planes.count)
    assert bool((counts.diff() <= 0).all())


def test_chunks_and_threads_change_nothing(scene, config, set_threads):
    points = scene.points[:2000]
    plain = segment_planes(points, config)
    for chunk_size, num_threads in ((397, 1), (100_000, 2)):
        set_threads(num_threads)
        other = segment_planes(points, dataclasses.replace(config, chunk_size=chunk_size))
        assert torch.equal(other.labels, plain.labels)
        assert torch.equal(other.normals, plain.normals)
        assert torch.equal(other.curvature, plain.curvature)
        assert_same_planes(other.planes, plain.planes)


def test_unit_and_origin_change_nothing_in_double_precision(scene, config):
    # Coordinates on a grid of 2^-20 m are moved without rounding.
    points = (scene.points[::2].double() * 2**20).round() / 2**20
    plain = segment_planes(points.numpy(), config)
    for other, unit in ((points * 1000, 1000), (points + torch.tensor([5e5, 4e6, 100.0]), 1)):
        moved = segment_planes(other, config)
        assert score_labels(moved.labels, plain.labels).ari > 0.999
        area = plain.planes.area.sum() * unit**2
        assert torch.allclose(moved.planes.area.sum(), area, rtol=1e-2)


def test_points_that_are_not_finite_stay_in_place(scene, config):
    spoiled = scene.points.clone()
    spoiled[5] = torch.nan
    spoiled[100, 2] = torch.inf
    seg = segment_planes(spoiled, config)
    kept = torch.ones(len(spoiled), dtype=torch.bool)
    kept[[5, 100]] = False
    assert seg.labels[~kept].tolist() == [UNLABELED] * 2
    assert not seg.valid[~kept].any()
    assert not seg.normals[~kept].any()
    assert torch.equal(seg.labels[kept], segment_planes(scene.points[kept], config).labels)


@pytest.mark.parametrize("size", [0, 1, 2])
def test_clouds_too_small_for_a_plane_have_none(config, size):
    seg = segment_planes(torch.rand(size, 3), config)
    assert seg.labels.tolist() == [UNLABELED] * size
    assert not seg.valid.any()
    assert len(seg.planes) == 0


def test_clouds_smaller_than_k_use_what_they_have(config):
    triangle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    seg = segment_planes(triangle, config)
    assert bool(seg.valid.all())
    assert torch.equal(seg.normals.abs(), torch.tensor([[0.0, 0, 1]] * 3))


def test_equal_points_give_no_region(config):
    seg = segment_planes(torch.ones(500, 3), config)
    assert not seg.valid.any()
    assert bool((seg.labels == UNLABELED).all())


def test_stages_are_announced_in_order(scene, config):
    stages = []
    segment_planes(scene.points, config, on_stage=stages.append)
    assert stages == ["neighbors", "normals", "regions", "planes", "orientation", "done"]


@pytest.mark.parametrize(
    ("voxel", "message"),
    [
        (1e-9, "voxel 1e-09 leaves all 600 points; check that it is in units of the cloud"),
        (1e4, "voxel 10000 leaves 1 of 600 points; check"),
    ],
)
def test_a_voxel_size_in_another_unit_is_said(config, voxel, message):
    points = torch.rand(600, 3, generator=torch.Generator().manual_seed(0)) + 1
    with pytest.warns(UserWarning, match=message) as caught:
        segment_planes(points, config, voxel=voxel)
    assert caught[0].filename == __file__


def test_wrong_shapes_are_refused():
    with pytest.raises(ShapeError, match=r"expected points of shape \(N, 3\), got \(5, 2\)"):
        segment_planes(torch.rand(5, 2))
    with pytest.raises(ShapeError, match="expected points of float32 or float64, got int64"):
        segment_planes(torch.ones(5, 3, dtype=torch.int64))


@pytest.mark.parametrize("given", [[[0.0, 0.0, 1.0]], None, 3])
def test_what_is_no_points_is_refused_with_the_repair(given):
    expected = r"got list; use torch.tensor|array, a Cloud or a path, got (NoneType|int)"
    with pytest.raises(ShapeError, match=expected):
        segment_planes(given)


def test_tutorial_scan_gives_the_regions_of_pcl(scan):
    # PCL 1.13: NormalEstimationOMP and RegionGrowing, k = 50, 5 degrees, 95th percentile.
    cloud = read_cloud(scan("region_growing_tutorial.pcd"))
    seg = segment_planes(cloud.points, load_config("classic"))
    assert len(seg.planes) == 53
    assert int(seg.planes.count[0]) == 58031


@pytest.mark.parametrize("seed", [0, 1])
def test_quantized_boards_are_two_planes_and_no_terraces(seed):
    # A slanted board and one 20 mm in front, in steps of 3 mm that bumps make ragged.
    side = 0.0018 * np.arange(110)
    x, y = np.meshgrid(side, side, indexing="ij")
    rng = np.random.default_rng(seed)
    # A normal curve with a deviation of two pixels.
    spectrum = np.exp(-2 * (2 * np.pi * np.fft.fftfreq(110)) ** 2)
    bumps = np.fft.ifft2(np.fft.fft2(rng.standard_normal(x.shape)) * np.outer(spectrum, spectrum))
    z = 0.7 * x + 0.2 * y + 0.0006 * bumps.real / bumps.real.std()
    z += 0.0003 * rng.standard_normal(x.shape)
    front = (abs(x - x.mean()) < 0.05) & (abs(y - y.mean()) < 0.05)
    z = 0.003 * np.rint((z - 0.02 * front) / 0.003)
    seg = segment_planes(np.stack([x, y, z], axis=-1).reshape(-1, 3), orient="none")
    assert len(seg.planes) == 2
    assert score_labels(seg.labels, front.ravel().astype(int)).mean_best_iou > 0.99


@pytest.mark.parametrize("exponent", [-60, 0, 38, 44])
def test_scaling_by_a_power_of_two_keeps_planes(scene, exponent):
    points = scene.points.double()[::4]
    seg = segment_planes(points * 2.0**exponent, "classic", orient="none")
    assert torch.equal(seg.labels, segment_planes(points, "classic", orient="none").labels)


def test_a_unit_that_is_too_small_names_the_coordinates(scene):
    with pytest.raises(ConfigError, match=r"expected coordinates within 1e\+12, got a cloud"):
        segment_planes(scene.points.double()[::4] * 2.0**60)


def test_a_cloud_of_few_neighborhoods_is_told():
    points = torch.rand(99, 3, generator=torch.Generator().manual_seed(0))
    message = "expected at least 100 distinct points for neighborhoods of 50, got 99; add points"
    with pytest.warns(UserWarning, match=message) as caught:
        segment_planes(points)
    assert caught[0].filename == __file__
    segment_planes(points, **{"normals.k": 49})


def test_neighbors_of_voxels_are_not_those_of_points(room):
    points = room(2000).points
    assert segment_planes(points, "classic", keep_neighbors=True).neighbors is not None
    assert segment_planes(points, "classic", voxel=0.2, keep_neighbors=True).neighbors is None
