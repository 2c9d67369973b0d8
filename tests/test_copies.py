"""Points with equal coordinates: all that is estimated is that of the distinct points."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

import torchrg
from tests.kernels.clouds import definitions
from torchrg import make_superpoints, segment_planes
from torchrg.config import preset_names
from torchrg.datasets import collate_offset
from torchrg.io.result import Result
from torchrg.metrics import score_labels, score_partition
from torchrg.normals import ESTIMATORS, estimate_normals, orient_normals
from torchrg.regions import summarize_planes
from torchrg.structures import UNLABELED, Cloud
from torchrg.structures.planes import PLANE_COLUMNS
from torchrg.transforms import EstimateNormals, GrowRegions, MakeSuperpoints, OrientNormals

COUNT = 1500
ROWS = torch.arange(COUNT)
SHUFFLED = torch.cat([ROWS, ROWS[: COUNT // 2], ROWS[:3].repeat(100)])
COPIES = {
    "twice": ROWS.repeat(2),
    "four times": ROWS.repeat_interleave(4),
    "some": SHUFFLED[torch.randperm(len(SHUFFLED), generator=torch.Generator().manual_seed(0))],
}
"""Rows of the single points, by how often they are there."""
MADE = [name for name in PLANE_COLUMNS if name != "count"]
"""Columns of the table that are of distinct points."""
VOXEL = 0.2


@pytest.fixture(scope="module")
def points(room):
    cloud = room(COUNT, 0.003, 1).points.float()
    cloud[:40, 0] = 0.0
    return cloud


@pytest.fixture(scope="module")
def objects(points):
    cells = (points / 2.5).floor().long()
    return cells[:, 0] * 100 + cells[:, 1] * 10 + cells[:, 2]


@pytest.fixture(params=COPIES)
def rows(request):
    return COPIES[request.param]


def copied(points, rows):
    """Return copies of points, every other zero negative, after three rows without a point."""
    cloud = points[rows].clone()
    cloud[::2] = torch.where(cloud[::2] == 0, -0.0, cloud[::2])
    return torch.cat([torch.full((3, 3), torch.nan), cloud])


def assert_same_partition(labels, expected):
    """Check that labels are equal but for the numbers of regions."""
    pairs = {*zip(labels.tolist(), expected.tolist(), strict=True)}
    assert len(pairs) == len(labels.unique()) == len(expected.unique())
    assert all((label < 0) == (other < 0) for label, other in pairs)


def assert_same_labels(labels, expected, rows):
    """Check labels of copies against those of single points; equal counts keep the numbers."""
    if len(rows) % COUNT == 0:
        assert torch.equal(labels, expected[rows])
    assert_same_partition(labels, expected[rows])


def assert_same_table(planes, expected, numbers):
    """Check that the table of copies is that of the single points, whose planes are renumbered."""
    for name in MADE:
        assert torch.equal(getattr(planes, name)[numbers], getattr(expected, name)), name
    pairs, lengths, angles = expected.adjacency
    renumbered = numbers[pairs].sort(dim=1).values
    order = (renumbered[:, 0] * len(numbers) + renumbered[:, 1]).argsort()
    met = renumbered[order], lengths[order], angles[order]
    assert all(map(torch.equal, planes.adjacency, met))


def assert_same(seg, single, rows):
    """Check a segmentation of ``copied`` points against that of the single ones."""
    assert (seg.labels[:3] == UNLABELED).all()
    assert not seg.valid[:3].any()
    for name in ("normals", "curvature", "sharp", "valid"):
        assert torch.equal(getattr(seg, name)[3:], getattr(single, name)[rows]), name
    labels = seg.labels[3:]
    assert_same_labels(labels, single.labels, rows)
    assert torch.equal(torch.bincount(labels + 1)[1:], seg.planes.count)
    assert (seg.planes.count.diff() <= 0).all()
    numbers = torch.empty(len(single.planes), dtype=torch.int64)
    numbers[single.labels[rows][labels >= 0]] = labels[labels >= 0]
    assert_same_table(seg.planes, single.planes, numbers)
    assert seg.sampling == single.sampling
    assert seg.num_copies == len(rows) - COUNT
    assert single.num_copies == 0


@pytest.mark.parametrize("preset", preset_names())
def test_planes_are_those_of_the_distinct_points(points, preset):
    single = segment_planes(points, preset)
    assert len(single.planes) > 3
    for name in ["some"] if preset == "detmm" else COPIES:  # That is slow.
        rows = COPIES[name]
        assert_same(segment_planes(copied(points, rows), preset), single, rows)


def test_definitions_and_kernels_agree_on_copies(points):
    rows = COPIES["some"]
    for preset in ("consensus", "paper"):
        single = segment_planes(points, preset)
        with definitions():
            assert_same(segment_planes(copied(points, rows), preset), single, rows)


@pytest.mark.parametrize("voxel", [None, VOXEL])
@pytest.mark.parametrize("is_within", [False, True])
def test_voxels_and_objects_take_copies_once(points, objects, rows, voxel, is_within):
    within = objects if is_within else None
    of_copies = torch.cat([objects[:3], objects[rows]]) if is_within else None
    single = segment_planes(points, "classic", voxel=voxel, within=within)
    seg = segment_planes(copied(points, rows), "classic", voxel=voxel, within=of_copies)
    assert_same(seg, single, rows)


@pytest.mark.parametrize("voxel", [None, VOXEL])
def test_objects_that_share_positions_have_planes_of_their_own(points, voxel, rng):
    single = segment_planes(points, voxel=voxel)
    cloud, within = points.repeat(2, 1), torch.tensor([-7, 4]).repeat_interleave(COUNT)
    seg = segment_planes(cloud, within=within, voxel=voxel)
    for half, own in ((slice(0, COUNT), -7), (slice(COUNT, None), 4)):
        assert_same_partition(seg.labels[half], single.labels)
        assert torch.equal(seg.normals[half], single.normals)
        assert set(seg.planes.object[seg.labels[half].unique()[1:]].tolist()) == {own}
    order = torch.randperm(len(cloud), generator=rng)
    other = segment_planes(cloud[order], within=within[order], voxel=voxel)
    assert torch.equal(other.labels, seg.labels[order])
    assert torch.equal(other.planes.object, seg.planes.object)
    assert all(map(torch.equal, other.planes.adjacency, seg.planes.adjacency))


@pytest.mark.parametrize("method", ESTIMATORS)
def test_every_estimator_takes_copies_once(points, method):
    few = points[:: COUNT // 100]
    rows = torch.cat([torch.arange(len(few)), torch.arange(30).repeat(20)])
    single = estimate_normals(few, method=method)
    fit = estimate_normals(copied(few, rows), method=method)
    for values, expected in zip(fit, single, strict=True):
        assert values is expected is None or torch.equal(values[3:], expected[rows])


def test_gradients_of_copies_go_to_the_first_of_them(points):
    single = points.double().requires_grad_()
    estimate_normals(single, method="pca").curvature.sum().backward()
    twice = points.double().repeat(2, 1).requires_grad_()
    estimate_normals(twice, method="pca").curvature.sum().backward()
    torch.testing.assert_close(twice.grad[:COUNT], 2 * single.grad)
    assert not twice.grad[COUNT:].any()


@pytest.mark.parametrize("keep", [False, True])
def test_transforms_take_copies_once_in_each_cloud_of_a_batch(points, keep):
    kept = {"keep_neighbors": keep}
    steps = nn.Sequential(
        EstimateNormals(**kept), OrientNormals(**kept), GrowRegions(**kept), MakeSuperpoints()
    )
    single, clouds = steps({"coord": points}), [points[rows] for rows in COPIES.values()]
    batch = steps(collate_offset([{"coord": cloud} for cloud in clouds]))
    starts = [0, *batch["offset"].tolist()]
    for rows, start, stop in zip(COPIES.values(), starts, starts[1:], strict=False):
        for name in ("normal", "curvature", "residual"):
            assert torch.equal(batch[name][start:stop], single[name][rows]), name
        for name in ("plane", "superpoint"):
            assert_same_labels(batch[name][start:stop], single[name], rows)


@pytest.mark.parametrize("voxel", [None, VOXEL])
def test_superpoints_take_copies_once(points, rows, voxel, rng):
    colors = torch.randint(0, 256, (COUNT, 3), generator=rng, dtype=torch.uint8)
    single = make_superpoints(points, colors=colors, voxel=voxel)
    of_copies = torch.cat([colors[:3], colors[rows]])
    found = make_superpoints(copied(points, rows), colors=of_copies, voxel=voxel)
    levels = zip((found.labels, *found.levels), (single.labels, *single.levels), strict=True)
    for level, expected in levels:
        assert (level[:3] == -1).all()
        assert_same_labels(level[3:], expected, rows)


@pytest.mark.parametrize("voxel", [None, VOXEL])
@pytest.mark.parametrize("kind", [torch.uint8, torch.float64])
def test_superpoints_do_not_depend_on_the_order_of_copies_of_other_colors(points, voxel, kind, rng):
    colors = torch.randint(0, 256, (2 * COUNT, 3), generator=rng, dtype=torch.uint8)
    colors = colors if kind == torch.uint8 else colors.to(kind) / 255
    cloud, order = points.repeat(2, 1), torch.randperm(2 * COUNT, generator=rng)
    # Labels of copies differ too, as where objects share positions.
    seg = segment_planes(cloud, within=torch.arange(2).repeat_interleave(COUNT))
    moved = replace(seg, labels=seg.labels[order], normals=seg.normals[order], points=None)
    one = make_superpoints(cloud, seg, colors=colors, voxel=voxel)
    other = make_superpoints(cloud[order], moved, colors=colors[order], voxel=voxel)
    assert torch.equal(other.labels, one.labels[order])
    assert torch.equal(other.levels[0], one.levels[0][order])


@pytest.mark.parametrize("orient", ["interior", "consistent"])
def test_copies_look_to_one_side(points, rows, orient):
    normals = estimate_normals(points, method="pca").normals
    expected = orient_normals(points, normals, orient=orient)
    signs = torch.ones(len(rows), 1)
    signs[1::3] = -1
    of_copies = torch.cat([torch.zeros(3, 3), normals[rows] * signs])
    turned = orient_normals(copied(points, rows), of_copies, orient=orient)
    assert torch.equal(turned[3:], expected[rows])


def test_fronts_of_copies_count_once(points):
    normals = estimate_normals(points, method="pca").normals
    front = torch.ones(COUNT, 3)
    # Just few enough to follow their neighbors, and too many if copies counted.
    lost = ROWS[:: COUNT // 14][:14]
    front[lost] = 0
    rows = torch.cat([ROWS, lost.repeat(3)])
    single, cloud = (
        orient_normals(Cloud(points[some].numpy(), front=front[some].numpy()), normals[some])
        for some in (ROWS, rows)
    )
    assert torch.equal(cloud, single[rows])


def test_tables_of_equal_labels_are_equal_to_the_bit(points, rows):
    seg = segment_planes(points, **{"planes.up": "z"})
    single = summarize_planes(points, seg.normals, seg.labels, up="z")
    planes = summarize_planes(points[rows], seg.normals[rows], seg.labels[rows], up="z")
    for name in (*MADE, "kind"):
        assert torch.equal(getattr(planes, name), getattr(single, name)), name
        assert torch.equal(getattr(planes, name), getattr(seg.planes, name)), name
    assert torch.equal(planes.count, torch.bincount(seg.labels[rows] + 1)[1:])


@pytest.mark.parametrize("has_normals", [False, True])
def test_tables_of_files_from_elsewhere_take_copies_once(points, rows, has_normals):
    seg = segment_planes(points)

    def table(some):
        fields = {"labels": seg.labels[some].numpy(), "normals": seg.normals[some].numpy()}
        names = ("labels", "normals")[: 1 + has_normals]
        return Result(Cloud(points[some].numpy(), {name: fields[name] for name in names})).planes

    planes, single = table(rows), table(ROWS)
    assert_same_table(planes, single, torch.arange(len(single)))
    assert torch.equal(planes.count, torch.bincount(seg.labels[rows] + 1)[1:])


def test_borders_of_superpoints_are_scored_once_for_copies(points, room, rows):
    truth = room(COUNT, 0.003, 1).labels
    parts = make_superpoints(points).labels
    single, found = (
        score_partition(parts[some], truth[some], points[some]) for some in (ROWS, rows)
    )
    assert found[2:5] == single[2:5]


def test_a_labeled_point_that_is_not_finite_is_refused(points):
    spoiled = copied(points, ROWS)
    labels = torch.zeros(len(spoiled), dtype=torch.int64)
    with pytest.raises(
        torchrg.errors.ShapeError, match="summarize_planes: expected finite labeled points"
    ):
        summarize_planes(spoiled, torch.ones_like(spoiled), labels)


def test_commands_say_how_many_copies_there_are(points, tmp_path, run):
    (tmp_path / "in").mkdir()
    torchrg.write_cloud(tmp_path / "in" / "a.ply", Cloud(points.repeat(2, 1).numpy()))
    torchrg.write_cloud(tmp_path / "in" / "b.ply", Cloud(points.numpy()))
    said = "1,500 of 3,000 points are duplicates"
    for command in ("segment", "normals"):
        for name, count in (("a", 1), ("b", 0)):
            source, out = tmp_path / "in" / f"{name}.ply", tmp_path / f"{command}_{name}.npz"
            assert run(command, source, "--out", out).out.count(said) == count
        one, two = (np.load(tmp_path / f"{command}_{name}.npz")["normals"] for name in "ba")
        assert np.array_equal(two, np.concatenate([one, one]))
    done = run("convert", "folder", tmp_path / "in", tmp_path / "out", "--workers", 1)
    assert (done.out + done.err).count(said) == 1
    one, two = (np.load(tmp_path / "out" / name / "plane.npy") for name in "ba")
    assert np.array_equal(two, np.concatenate([one, one]))
    assert "duplicates  1,500\n" in run("info", tmp_path / "in" / "a.ply").out


def test_a_scan_half_of_copies_has_the_planes_of_its_distinct_points(scan):
    cloud = torchrg.read_cloud(scan("room_scan1.pcd")).points
    distinct = torchrg.neighbors.distinct_points(cloud)
    assert distinct.num_copies > 50_000
    seg, single = segment_planes(cloud, "classic"), segment_planes(distinct.points, "classic")
    assert score_labels(seg.labels[distinct.rows], single.labels).ari == 1.0
    assert torch.equal(seg.normals, distinct.restore(single.normals))
    assert seg.planes.area.sort().values.tolist() == single.planes.area.sort().values.tolist()
