"""``torch.set_default_device`` is for the caller's own tensors: it changes no result."""

from functools import cache

import pytest
import torch

import torchrg
from tests.test_inputs import CALLS, argument
from torchrg import depth, metrics, neighbors, nn, transforms
from torchrg.config import preset_names
from torchrg.io.result import Result
from torchrg.neighbors.knn import search_nearest
from torchrg.normals import find_sharp_points
from torchrg.regions import summarize_planes
from torchrg.structures import Cloud

CAMERA = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
POINTS = torchrg.scenes.make_room(num_points=1000, noise=0.003, seed=0).points
IMAGE = torch.full((1, 30, 40), 2.0)
IMAGE[..., 20:] = 3.0
VIEWPOINT = torch.ones(3)
SAMPLE = {"coord": POINTS, "color": (POINTS * 10 % 255).to(torch.uint8)}
FOUND = {"normal": POINTS / POINTS.norm(dim=1, keepdim=True), "plane": torch.arange(1000) // 200}
FRAME = {"depth": IMAGE, "intrinsics": CAMERA, "pose": torch.eye(4)}


@cache
def plain():
    """Return a segmentation of the room, and labels that differ from its own."""
    seg = torchrg.segment_planes(POINTS, "classic")
    return seg, torch.where(POINTS[:, 0] > 2, seg.labels, -1)


@cache
def walls():
    """Return the planes of a room of which walls are found, too."""
    room = torchrg.scenes.make_room(num_points=4000, seed=0)
    return torchrg.segment_planes(room.points, "classic").planes


def table():
    return metrics.contingency_table(plain()[0].labels, plain()[1])


ARGUMENTS = {name: argument(name) for name in CALLS}
EVERYTHING = {name: lambda name=name: CALLS[name](ARGUMENTS[name]) for name in CALLS}
EVERYTHING |= {
    f"preset {name}": lambda name=name: torchrg.segment_planes(POINTS, name)
    for name in preset_names()
}
EVERYTHING |= {
    "make_room": lambda: torchrg.scenes.make_room(num_points=500, noise=0.01, seed=3),
    "make_superpoints": lambda: torchrg.make_superpoints(
        POINTS, plain()[0], colors=SAMPLE["color"]
    ),
    "superpoints by count": lambda: torchrg.make_superpoints(
        POINTS, plain()[0], torchrg.config.SuperpointsConfig(counts=(30, 10))
    ),
    "segment_mesh": lambda: torchrg.segment_mesh(POINTS),
    "align_axes": lambda: torchrg.align_axes(walls()),
    "align_axes, up": lambda: torchrg.align_axes(walls(), up=(0.1, 0, 1)),
    "orient_normals": lambda: [
        torchrg.normals.orient_normals(POINTS, plain()[0].normals, orient=way, viewpoint=place)
        for way, place in (("consistent", None), ("interior", None), ("viewpoint", VIEWPOINT))
    ],
    "find_sharp_points": lambda: find_sharp_points(
        plain()[0].normals, torchrg.search_knn(POINTS, 10)
    ),
    "summarize_planes": lambda: summarize_planes(
        POINTS,
        plain()[0].normals,
        plain()[0].labels,
        up=(0, 0, 1),
        neighbors=torchrg.search_knn(POINTS, 10),
    ),
    "voxel": lambda: torchrg.segment_planes(POINTS, "classic", voxel=0.2),
    "sample_voxels": lambda: neighbors.sample_voxels(POINTS, 0.5),
    "search_nearest": lambda: search_nearest(POINTS.numpy(), POINTS[::3].numpy(), 0.5),
    "segment_depth": lambda: depth.segment_depth(IMAGE[0], CAMERA, pose=FRAME["pose"]),
    "make_intrinsics": lambda: depth.make_intrinsics(50, 50, 20, 15),
    "depth_to_points": lambda: depth.depth_to_points(IMAGE, CAMERA[None]),
    "find_intrinsics": lambda: depth.find_intrinsics(depth.depth_to_points(IMAGE, CAMERA[None])[0]),
    "fuse_depth": lambda: transforms.fuse_depth([FRAME, FRAME], voxel_size=0.1),
    "score_labels": lambda: metrics.score_labels(plain()[0].labels, plain()[1]),
    "score_partition": lambda: metrics.score_partition(
        plain()[0].labels, plain()[1], POINTS, boundary_distance=0.2
    ),
    "score_clusters": lambda: metrics.score_clusters(plain()[0].normals, plain()[0].labels),
    "score_clusters of few": lambda: metrics.score_clusters(
        plain()[0].normals, plain()[0].labels, sample_size=50
    ),
    "score_normals": lambda: metrics.score_normals(plain()[0].normals, POINTS),
    "indices": lambda: [
        index(table()) for index in (metrics.adjusted_rand_index, metrics.segmentation_covering)
    ],
    "matching": lambda: metrics.match_points(
        Cloud(POINTS.numpy()), Cloud(POINTS[::2].numpy()), 0.1
    ),
    "result": lambda: Result.from_segmentation(Cloud(POINTS.numpy()), plain()[0]).fields,
}
EVERYTHING |= {
    f"transforms.{make.__name__}": lambda make=make, values=values: make(**values)(
        {**SAMPLE, **FOUND}
    )
    for make, values in (
        (transforms.EstimateNormals, {}),
        (transforms.SegmentPlanes, {}),
        (transforms.MakeSuperpoints, {}),
        (transforms.CenterCloud, {}),
        (transforms.KeepFinite, {}),
        (transforms.SampleVoxels, {"size": 0.3}),
    )
}
EVERYTHING |= {
    f"transforms.{kind.__name__}": lambda kind=kind: kind()(FRAME)
    for kind in (transforms.SegmentDepth, transforms.DepthToCloud)
}
EVERYTHING |= {
    "grown and aligned": lambda: transforms.AlignAxes()(
        transforms.GrowRegions()(transforms.EstimateNormals(method="pca")(dict(SAMPLE)))
    )
}
EVERYTHING |= {
    f"nn.{kind.__name__}": lambda kind=kind: kind()(ARGUMENTS["qn"])
    for kind in (
        nn.Covariance,
        nn.Qn,
        nn.DetMCD,
        nn.FastMCD,
        nn.MVE,
        nn.DetS,
        nn.DetMM,
        nn.PatchNormals,
    )
}


def parts_of(found):
    """Return the numbers and tensors of a result, in order."""
    if isinstance(found, dict):
        found = tuple(found[key] for key in sorted(found))
    if isinstance(found, list | tuple):
        return [leaf for part in found for leaf in parts_of(part)]
    if hasattr(found, "__dict__") and not isinstance(found, torch.Tensor):
        return parts_of(vars(found))
    return [found]


@pytest.mark.parametrize("name", EVERYTHING)
def test_the_default_device_changes_no_result(name):
    plain(), walls()
    with torch.device("meta"):
        found = parts_of(EVERYTHING[name]())
    expected = parts_of(EVERYTHING[name]())
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert type(one) is type(other)
        if isinstance(one, torch.Tensor):
            assert one.device == other.device
            assert one.dtype == other.dtype
            one, other = one.numpy(), other.numpy()
        if hasattr(one, "tobytes"):
            assert one.tobytes() == other.tobytes()
        else:
            assert one == other or one != one
