"""Every public function of tensors works in a forked child of a process that has used it.

The parent has OpenMP threads, which a child does not inherit: an operation of the child that waits
for them never returns.
"""

import inspect
import multiprocessing
import os
from functools import cache, partial

import pytest
import torch

import torchrg
from torchrg import depth, linalg, metrics, neighbors, nn, normals, regions, robust, scenes
from torchrg import transforms as steps
from torchrg.config import NormalsConfig, SuperpointsConfig
from torchrg.datasets import collate_offset
from torchrg.structures import Cloud

NUM_POINTS = 60_000
"""Above 32,768 values, an operation of torch uses several threads."""
SECONDS_UNTIL_HUNG = 120
MODULES = (depth, linalg, metrics, neighbors, nn, normals, regions, robust, scenes, steps, torchrg)
WITHOUT_TENSORS = {
    *("load_config", "read_cloud", "read_result", "write_cloud"),
    *("build_room", "sample_scene", "make_intrinsics"),
}
"""Functions of files, settings, rooms and single numbers."""
GRID = torch.cartesian_prod(torch.arange(300.0), torch.arange(200.0), torch.zeros(1)) / 100
CAMERA = torch.tensor([[300.0, 0, 150], [0, 300, 100], [0, 0, 1]])
IMAGE = torch.full((1, 200, 300), 2.0)
FRAME = {"depth": IMAGE, "intrinsics": CAMERA, "pose": torch.eye(4)}
CLASSIC = torchrg.load_config("classic", **{"normals.k": 10})
SETTINGS = {
    "EstimateNormals": [NormalsConfig(method="pca", k=10)],
    "GrowRegions": ["classic"],
    "SegmentPlanes": [CLASSIC],
    "AlignAxes": [CLASSIC],
    "SampleVoxels": [0.1],
}


@cache
def made():
    """Return a cloud, its neighbors, normals, segmentation and patches."""
    room = scenes.make_room(NUM_POINTS, noise=0.003, seed=0)
    near = neighbors.search_knn(room.points, 9)
    seg = torchrg.segment_planes(room.points, CLASSIC)
    patches = room.points[:24_000].reshape(-1, 15, 3)
    return room, near, seg, patches


def sample():
    room, _, seg, _ = made()
    color = (room.points * 50).abs().to(torch.uint8)
    found = {"normal": seg.normals, "plane": seg.labels, "curvature": seg.curvature}
    return {"coord": room.points, "color": color, **found}


def calls():
    """Yield each public name with a call of it on many values."""
    room, near, seg, patches = made()
    points, labels, unit = room.points, seg.labels, seg.normals
    table, voxels = (
        metrics.contingency_table(labels, room.labels),
        neighbors.sample_voxels(points, 0.1),
    )
    cloud, few, some, covariances = (
        Cloud(points.numpy()),
        patches[:200],
        patches[:1000],
        linalg.covariance(patches)[1],
    )
    wide = patches.flatten(1)
    noise, partition = torch.full((200,), 0.02), SuperpointsConfig()
    yield "segment_planes", lambda: torchrg.segment_planes(points, CLASSIC)
    yield "segment_mesh", lambda: torchrg.segment_mesh(GRID[::4])
    yield "make_superpoints", lambda: torchrg.make_superpoints(points, seg)
    yield (
        "partition_points",
        lambda: regions.partition_points(points, unit, labels, partition),
    )
    yield "align_axes", lambda: torchrg.align_axes(seg)
    yield "select_planes", lambda: torchrg.select_planes(seg, min_area=1)
    yield "summarize_planes", lambda: regions.summarize_planes(points, unit, labels)
    yield "grow_regions", lambda: torchrg.grow_regions(points, unit, seg.curvature, near, "classic")
    yield "search_knn", lambda: torchrg.search_knn(points, 5)
    yield "measure_sampling", lambda: neighbors.measure_sampling(points, near)
    yield "expand_to_points", lambda: neighbors.expand_to_points(voxels.rows, voxels.inverse)
    yield "sample_voxels", lambda: neighbors.sample_voxels(points, 0.1)
    for name in ("canonical_order", "distinct_points"):
        yield name, partial(getattr(neighbors, name), points)
    yield "estimate_normals", lambda: torchrg.estimate_normals(points, method="pca", k=10)
    yield "orient_normals", lambda: normals.orient_normals(points, unit)
    yield "find_sharp_points", lambda: normals.find_sharp_points(unit, near)
    for name in ("fit_normals_pca", "fit_normals_jet", "fit_jet", "fit_normals_robust"):
        yield name, partial(getattr(normals, name), patches)
    yield (
        "fit_normals_irls",
        lambda: normals.fit_normals_irls(few, noise=noise, mu_decay=3),
    )
    for name in ("fit_detmcd", "fit_fastmcd", "fit_mve", "fit_dets", "fit_detmm"):
        yield name, partial(getattr(robust, name), few)
    for name in ("median", "mad", "qn", "tau"):
        yield name, partial(getattr(robust, name), wide)
    yield "qn_exceeds", lambda: robust.qn_exceeds(wide, 1.0)
    for name in {*nn.__all__} - {"Eigh", "Eigen", "Normal"}:
        yield name, partial(getattr(nn, name)(), some)
    yield "Eigh", lambda: nn.Eigh()(covariances)
    yield "Normal", lambda: nn.Normal()(nn.Eigh()(covariances))
    yield "second_moments", lambda: linalg.second_moments(patches.unbind(dim=-1))
    yield "covariance", lambda: linalg.covariance(patches)
    yield "eigh3", lambda: linalg.eigh3(covariances)
    yield "unsigned_angle_deg", lambda: linalg.unsigned_angle_deg(unit, unit)
    yield "contingency_table", lambda: metrics.contingency_table(labels, room.labels)
    for name in ("adjusted_rand_index", "match_regions", "segmentation_covering"):
        yield name, partial(getattr(metrics, name), table)
    yield "differing_rows", lambda: metrics.differing_rows(cloud, cloud)
    yield "match_points", lambda: metrics.match_points(cloud, cloud, 0.1)
    yield "score_labels", lambda: metrics.score_labels(labels, room.labels)
    yield "score_normals", lambda: metrics.score_normals(unit, room.normals)
    yield "score_clusters", lambda: metrics.score_clusters(unit[::9], labels[::9], sample_size=100)
    yield "score_partition", lambda: metrics.score_partition(labels, room.labels)
    yield "make_room", lambda: scenes.make_room(NUM_POINTS, noise=0.003, seed=1)
    yield "segment_depth", lambda: depth.segment_depth(IMAGE[0], CAMERA)
    yield "depth_to_points", lambda: depth.depth_to_points(IMAGE, CAMERA[None])
    images = depth.depth_to_points(IMAGE, CAMERA[None])
    yield "find_intrinsics", lambda: depth.find_intrinsics(images[0])
    yield "fuse_depth", lambda: steps.fuse_depth([FRAME, FRAME], voxel_size=0.05)
    yield "collate_offset", lambda: collate_offset([sample(), sample()])
    for name in ("DepthToCloud", "SegmentDepth"):
        yield name, partial(getattr(steps, name)(), FRAME)
    for name in steps.__all__:
        if name[0].isupper() and name not in ("DepthToCloud", "SegmentDepth"):
            yield name, lambda name=name: getattr(steps, name)(*SETTINGS.get(name, ()))(sample())


def run_all(queue=None):
    """Call everything; put the names into a queue as they finish."""
    for name, call in calls():
        call()
        if queue is not None:
            queue.put(name)


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    # A new team of OpenMP threads, whatever the calls below use.
    torch.rand(NUM_POINTS * 10).sin_()
    yield
    torch.set_num_threads(before)


def is_function_of_tensors(value):
    return inspect.isfunction(value) or (
        inspect.isclass(value) and issubclass(value, torch.nn.Module)
    )


def test_every_public_function_is_called():
    public = {
        name
        for module in MODULES
        for name in module.__all__
        if is_function_of_tensors(getattr(module, name))
    }
    assert public - WITHOUT_TENSORS == {name for name, _ in calls()} - {"collate_offset"}


# The parent has threads on purpose: that is what a fork must survive.
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_every_public_function_returns_in_a_forked_child(two_threads):
    run_all()
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=run_all, args=(queue,))
    child.start()
    child.join(SECONDS_UNTIL_HUNG)
    is_hung = child.is_alive()
    child.kill()
    done = []
    while not queue.empty():
        done.append(queue.get())
    assert not is_hung, f"waits after {done[-1:]}"
    assert child.exitcode == 0
    assert len(done) == sum(1 for _ in calls())


def count_planes(seed):
    room = scenes.make_room(NUM_POINTS, noise=0.003, seed=seed)
    return int(steps.SegmentPlanes(CLASSIC)({"coord": room.points})["plane"].max()) + 1


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system that forks")
def test_a_forked_pool_returns_what_the_parent_does(two_threads):
    expected = [count_planes(seed) for seed in (0, 1)]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map_async(count_planes, (0, 1)).get(SECONDS_UNTIL_HUNG) == expected


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_hugging_face_maps_in_two_processes(two_threads):
    datasets = pytest.importorskip("datasets")
    rooms = datasets.Dataset.from_dict({"coord": [made()[0].points.numpy()] * 2})
    rooms = rooms.with_format("torch")
    expected = steps.SegmentPlanes(CLASSIC)(rooms[0])["plane"]
    mapped = rooms.map(steps.SegmentPlanes(CLASSIC), num_proc=2)
    assert all(torch.equal(room["plane"], expected) for room in mapped)
