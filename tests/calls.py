"""Every public function of tensors, with a call of it on a cloud and an image of any size."""

import inspect
from functools import cache, partial

import torch

import torchrg
from torchrg import depth, linalg, metrics, neighbors, nn, normals, regions, robust, scenes
from torchrg import transforms as steps
from torchrg.config import NormalsConfig, SuperpointsConfig
from torchrg.datasets import collate_offset
from torchrg.structures import Cloud

MODULES = (depth, linalg, metrics, neighbors, nn, normals, regions, robust, scenes, steps, torchrg)
WITHOUT_TENSORS = {
    *("load_config", "read_cloud", "read_result", "write_cloud"),
    *("build_room", "sample_scene", "make_intrinsics"),
}
"""Functions of files, settings, rooms and single numbers."""
CLASSIC = torchrg.load_config("classic", **{"normals.k": 10})
SETTINGS = {
    "EstimateNormals": [NormalsConfig(method="pca", k=10)],
    "GrowRegions": ["classic"],
    "SegmentPlanes": [CLASSIC],
    "AlignAxes": [CLASSIC],
    "SampleVoxels": [0.1],
}


def public_functions():
    """Return the names of all public functions and modules of tensors."""
    return {
        name
        for module in MODULES
        for name in module.__all__
        if is_function_of_tensors(getattr(module, name))
    } - WITHOUT_TENSORS


def is_function_of_tensors(value):
    return inspect.isfunction(value) or (
        inspect.isclass(value) and issubclass(value, torch.nn.Module)
    )


@cache
def segmented_room(num_points):
    """Return a room and its planes."""
    room = scenes.make_room(num_points, noise=0.003, seed=0)
    return room, torchrg.segment_planes(room.points, CLASSIC)


@cache
def sample_of(num_points):
    """Return a room with its planes as a sample of transforms."""
    room, seg = segmented_room(num_points)
    found = {"normal": seg.normals, "plane": seg.labels, "curvature": seg.curvature}
    return {"coord": room.points, "color": (room.points * 50).abs().to(torch.uint8), **found}


@cache
def frame_of(num_points):
    """Return a depth image of two walls with so many pixels at least, its camera and pose."""
    side = int(num_points**0.5) + 1
    image = torch.full((1, side, side), 2.0)
    image[..., side // 2 :] = 3.0
    camera = torch.tensor([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1]])
    return {"depth": image, "intrinsics": camera, "pose": torch.eye(4)}


@cache
def calls(num_points):
    """Return a call of each public function by its name; arguments exist before it is called."""
    (room, seg), sample, frame = (
        made(num_points) for made in (segmented_room, sample_of, frame_of)
    )
    points, labels, unit, cloud = room.points, seg.labels, seg.normals, Cloud(room.points.numpy())
    near, voxels = neighbors.search_knn(points, 9), neighbors.sample_voxels(points, 0.1)
    table = metrics.contingency_table(labels, room.labels)
    patches = points[: num_points // 15 * 15].view(-1, 15, 3)
    few, covariances = patches[:200], linalg.covariance(patches)[1]
    eigen, noise = nn.Eigh()(covariances), torch.full((len(few),), 0.02)
    image, camera = frame["depth"], frame["intrinsics"]
    images = depth.depth_to_points(image, camera[None])
    made = {
        "segment_planes": lambda: torchrg.segment_planes(points, CLASSIC),
        "segment_mesh": lambda: torchrg.segment_mesh(points[::4]),
        "make_superpoints": lambda: torchrg.make_superpoints(points, seg, colors=sample["color"]),
        "partition_points": lambda: regions.partition_points(
            points, unit, labels, SuperpointsConfig()
        ),
        "align_axes": lambda: torchrg.align_axes(seg),
        "select_planes": lambda: torchrg.select_planes(seg, min_area=1),
        "summarize_planes": lambda: regions.summarize_planes(
            points, unit, labels, up=(0, 0, 1), neighbors=near
        ),
        "grow_regions": lambda: torchrg.grow_regions(points, unit, seg.curvature, near, "classic"),
        "search_knn": lambda: torchrg.search_knn(points, 5),
        "measure_sampling": lambda: neighbors.measure_sampling(points, near),
        "expand_to_points": lambda: neighbors.expand_to_points(voxels.rows, voxels.inverse),
        "sample_voxels": lambda: neighbors.sample_voxels(points, 0.1),
        "estimate_normals": lambda: torchrg.estimate_normals(points, method="pca", k=10),
        "orient_normals": lambda: normals.orient_normals(points, unit),
        "find_sharp_points": lambda: normals.find_sharp_points(unit, near),
        "fit_normals_irls": lambda: normals.fit_normals_irls(few, noise=noise, mu_decay=3),
        "qn_exceeds": lambda: robust.qn_exceeds(patches.flatten(1), 1.0),
        "Eigh": lambda: nn.Eigh()(covariances),
        "Normal": lambda: nn.Normal()(eigen),
        "second_moments": lambda: linalg.second_moments(patches.unbind(dim=-1)),
        "covariance": lambda: linalg.covariance(patches),
        "eigh3": lambda: linalg.eigh3(covariances),
        "unsigned_angle_deg": lambda: linalg.unsigned_angle_deg(unit, unit),
        "contingency_table": lambda: metrics.contingency_table(labels, room.labels),
        "differing_rows": lambda: metrics.differing_rows(cloud, cloud),
        "match_points": lambda: metrics.match_points(cloud, cloud, 0.1),
        "score_labels": lambda: metrics.score_labels(labels, room.labels),
        "score_normals": lambda: metrics.score_normals(unit, room.normals),
        "score_clusters": lambda: metrics.score_clusters(unit[::9], labels[::9], sample_size=100),
        "score_partition": lambda: metrics.score_partition(
            labels, room.labels, points, boundary_distance=0.2
        ),
        "make_room": lambda: scenes.make_room(num_points, noise=0.003, seed=1),
        "segment_depth": lambda: depth.segment_depth(image[0], camera, pose=frame["pose"]),
        "depth_to_points": lambda: depth.depth_to_points(image, camera[None]),
        "find_intrinsics": lambda: depth.find_intrinsics(images[0]),
        "fuse_depth": lambda: steps.fuse_depth([frame, frame], voxel_size=0.05),
        "collate_offset": lambda: collate_offset([sample, sample]),
    }
    for module, names, argument in (
        (neighbors, ("canonical_order", "distinct_points"), points),
        (normals, ("fit_normals_pca", "fit_normals_jet", "fit_jet", "fit_normals_robust"), patches),
        (robust, ("fit_detmcd", "fit_fastmcd", "fit_mve", "fit_dets", "fit_detmm"), few),
        (robust, ("median", "mad", "qn", "tau"), patches.flatten(1)),
        (metrics, ("adjusted_rand_index", "match_regions", "segmentation_covering"), table),
    ):
        made |= {name: partial(getattr(module, name), argument) for name in names}
    for name in sorted({*nn.__all__} - {"Eigh", "Eigen", "Normal"}):
        made[name] = partial(getattr(nn, name)(), few)
    for name in steps.__all__:
        if name[0].isupper():
            given = frame if name in ("DepthToCloud", "SegmentDepth") else sample
            made[name] = partial(getattr(steps, name)(*SETTINGS.get(name, ())), given)
    return made
