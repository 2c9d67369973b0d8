"""Kinds of tensors: each gives the right result, or one line that says what to do."""

import inspect
import pickle
import re

import numpy as np
import pytest
import torch

import torchrg
from tests.test_opaque import FUNCTIONS
from torchrg.config import NormalsConfig
from torchrg.errors import ConfigError, ShapeError
from torchrg.normals import ESTIMATORS, orient_normals
from torchrg.transforms import SegmentDepth, SegmentPlanes

PATCHES = {
    name: lambda x, function=function: function(x)[-1] for name, function in FUNCTIONS.items()
}
FEW_STEPS = NormalsConfig(irls_decay=9.0)
CLOUDS = {
    f"cloud, {method}": lambda x, method=method: (
        torchrg.estimate_normals(x, method=method, k=10, config=FEW_STEPS).normals
    )
    for method in ESTIMATORS
}
CLOUDS |= {
    "planes": lambda x: torchrg.segment_planes(x).normals,
    "table": lambda x: torchrg.segment_planes(x).planes.offset,
    "superpoints": lambda x: torchrg.make_superpoints(x).labels,
    "orient": lambda x: orient_normals(x, torch.ones(x.shape, dtype=x.dtype, device=x.device)),
    "regions": lambda x: torchrg.grow_regions(
        x,
        torch.ones(x.shape, dtype=x.dtype, device=x.device),
        torch.zeros(len(x), dtype=x.dtype, device=x.device),
        torchrg.search_knn(x, 5),
        "classic",
    ),
    "neighbors": lambda x: torchrg.search_knn(x, 5).indices,
}
CALLS = PATCHES | CLOUDS
calls = pytest.mark.parametrize("name", CALLS)


def argument(name):
    rng = torch.Generator().manual_seed(0)
    if name in PATCHES:
        return torch.randn(3, 15, 3, generator=rng) * torch.tensor([1.0, 0.7, 0.05])
    cloud = torch.rand(60, 3, generator=rng) * torch.tensor([1.0, 1.0, 0.02])
    return torch.cat([cloud[:30], cloud[30:, [2, 0, 1]]])


class OfSomebody(torch.Tensor):
    """A subclass."""


def under_autocast(call, x):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return call(x)


def under_double(call, x):
    torch.set_default_dtype(torch.float64)
    try:
        return call(x)
    finally:
        torch.set_default_dtype(torch.float32)


def under_inference(call, x):
    with torch.inference_mode():
        return call(x)


SURROUNDINGS = {
    "autocast": under_autocast,
    "default dtype float64": under_double,
    "inference": under_inference,
    "not contiguous": lambda call, x: call(x.mT.contiguous().mT),
    "every second": lambda call, x: call(x.repeat_interleave(2, dim=0)[::2]),
    "subclass": lambda call, x: call(x.as_subclass(OfSomebody)),
    "parameter": lambda call, x: call(torch.nn.Parameter(x, requires_grad=False)),
}


@calls
def test_surroundings_change_nothing(name):
    expected = CALLS[name](argument(name))
    for kind, run in SURROUNDINGS.items():
        found = run(CALLS[name], argument(name))
        if name in CLOUDS:
            assert type(found) is torch.Tensor, kind
        assert found.dtype == expected.dtype, kind
        assert torch.equal(found.nan_to_num(), expected.nan_to_num()), kind


@calls
@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused_with_the_repair(name, half):
    if name == "irls":
        name = "pca"
    with pytest.raises(ShapeError, match=r"of float32 or float64, got b?float16; pass \w+.float"):
        CALLS[name](argument(name).to(half))


@calls
def test_sparse_tensors_are_refused_with_the_repair(name):
    if name == "irls":
        name = "pca"
    with pytest.raises(ShapeError, match=r"dense \w+, got a sparse tensor; pass \w+.to_dense"):
        CALLS[name](argument(name).to_sparse())


def test_jagged_patches_are_refused_with_the_repair():
    jagged = torch.nested.nested_tensor([torch.rand(9, 3), torch.rand(7, 3)], layout=torch.jagged)
    with pytest.raises(ShapeError, match=r"got a nested tensor; pass torch.nested.to_padded_tens"):
        torchrg.nn.Covariance()(jagged)


@pytest.mark.parametrize(
    ("transform", "example"),
    [
        (torchrg.transforms.SegmentPlanes(), "{'coord': points}"),
        (torchrg.transforms.CenterCloud(), "{'coord': points}"),
        (torchrg.transforms.SampleVoxels(0.1), "{'coord': points}"),
        (torchrg.transforms.SegmentDepth(), "{'depth': depth, 'intrinsics': matrix}"),
        (torchrg.transforms.DepthToCloud(), "{'depth': depth, 'intrinsics': matrix}"),
    ],
)
def test_a_bare_tensor_says_how_a_sample_is_made(transform, example):
    name = type(transform).__name__
    with pytest.raises(ConfigError, match=f"^{name}: .* got Tensor; pass {re.escape(example)}"):
        transform(torch.rand(50, 3))


def test_rows_of_a_data_set_of_lists_say_how_they_become_tensors():
    with pytest.raises(ShapeError, match=r"coord .* got list; .* with_format\('torch'\)"):
        torchrg.transforms.SegmentPlanes()({"coord": [[0.0, 0, 0]]})


def test_what_users_look_for_elsewhere_is_named():
    cloud = torchrg.Cloud(np.zeros((2, 3)), {"color": np.zeros((2, 3), np.uint8)})
    with pytest.raises(AttributeError, match=r"no attribute 'colors'; use fields\['color'\]"):
        _ = cloud.colors
    assert pickle.loads(pickle.dumps(cloud)).fields.keys() == {"color"}
    with pytest.raises(AttributeError, match=r"'show'; use seg.show\(\)"):
        _ = torchrg.show
    with pytest.raises(ShapeError, match=r"got \(9, 6\); pass points\[:, :3\]"):
        torchrg.segment_planes(torch.rand(9, 6))


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_on_meta_are_refused(name):
    with pytest.raises(ShapeError, match="expected points with values, got a tensor of vmap"):
        CALLS[name](argument(name).to("meta"))


@pytest.mark.parametrize(
    "call", [torchrg.estimate_normals, torchrg.segment_planes, torchrg.make_superpoints]
)
def test_an_organised_cloud_points_to_depth(call):
    loop = rf"got \(4, 5, 3\); .*\[{call.__name__}\(p\) for p in points\], or .*SegmentDepth"
    with pytest.raises(ShapeError, match=loop) as caught:
        call(torch.rand(4, 5, 3))
    assert "reshape" not in str(caught.value)


def test_a_batch_in_a_sample_points_to_offset():
    with pytest.raises(ShapeError, match=r"coord of shape \(N, 3\).*flatten\(0, 1\).*'offset'"):
        SegmentPlanes()({"coord": torch.rand(1, 5, 3)})


def test_depth_under_other_surroundings():
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])

    def segment(depth):
        return SegmentDepth()({"depth": depth, "intrinsics": camera})["normal"]

    depth = torch.full((1, 30, 40), 2.0)
    for run in (under_autocast, under_double, under_inference):
        assert torch.equal(run(segment, depth), segment(depth))


MASKED = [
    (module, name)
    for module in (torchrg.linalg, torchrg.normals, torchrg.robust)
    for name in module.__all__
    if inspect.isfunction(getattr(module, name))
    and "mask" in inspect.signature(getattr(module, name)).parameters
]


@pytest.mark.parametrize(("module", "name"), MASKED, ids=[name for _, name in MASKED])
def test_a_mask_of_numbers_is_refused_with_the_repair(module, name):
    patches, mask = torch.randn(2, 12, 3), torch.ones(2, 12, dtype=torch.uint8)
    settings = {"noise": torch.ones(2)} if name == "fit_normals_irls" else {}
    settings |= {"threshold": 1.0} if name == "qn_exceeds" else {}
    is_scale = "dim" in inspect.signature(getattr(module, name)).parameters
    with pytest.raises(ShapeError, match="mask to be a tensor of bool, got uint8; pass"):
        getattr(module, name)(patches[..., 0] if is_scale else patches, mask=mask, **settings)


def test_every_function_with_a_mask_was_called():
    assert len(MASKED) == 16


def taking_points():
    """Return calls of all functions that take the points of a cloud, by name."""
    points = argument("planes")
    seg = torchrg.segment_planes(points, "classic")
    fit, near = torchrg.estimate_normals(points, method="pca", k=9), torchrg.search_knn(points, 9)
    parts = torchrg.make_superpoints(points, seg, counts=2)
    render, white = torchrg.render, torch.full((60, 3), 255, dtype=torch.uint8)
    return {
        "segment_planes": lambda x: torchrg.segment_planes(x, "classic").labels,
        "estimate_normals": lambda x: torchrg.estimate_normals(x, method="pca", k=9).normals,
        "orient_normals": lambda x: orient_normals(x, fit.normals),
        "search_knn": lambda x: torchrg.search_knn(x, 5).indices,
        "grow_regions": lambda x: torchrg.grow_regions(x, *fit[:2], near, "classic"),
        "make_superpoints": lambda x: torchrg.make_superpoints(x, seg).labels,
        "segment_mesh": lambda x: torchrg.segment_mesh(x),
        "canonical_order": lambda x: torchrg.neighbors.canonical_order(x),
        "distinct_points": lambda x: torchrg.neighbors.distinct_points(x).rows,
        "sample_voxels": lambda x: torchrg.neighbors.sample_voxels(x, 0.2).rows,
        "measure_sampling": lambda x: torch.tensor(torchrg.neighbors.measure_sampling(x, near)),
        "summarize_planes": lambda x: (
            torchrg.regions.summarize_planes(x, fit.normals, seg.labels).area
        ),
        "score_partition": lambda x: torch.tensor(
            torchrg.metrics.score_partition(parts.labels, seg.labels, x)
        ),
        "color_planes": lambda x: render.color_planes(seg.labels, x),
        "render_cloud": lambda x: render.render_cloud(x, white, width=64),
        "make_nag": lambda x: torchrg.datasets.make_nag(x, parts, data=dict)[0]["pos"],
        "match_points": lambda x: torch.tensor(torchrg.metrics.match_points(x, x, 0.1)),
    }


@pytest.mark.filterwarnings("ignore::torchrg.errors.CloudWarning")
def test_functions_take_points_clouds_and_paths_alike(tmp_path):
    points = argument("planes")
    torchrg.write_cloud(tmp_path / "cloud.ply", points)
    forms = (points.numpy(), torchrg.Cloud(points), str(tmp_path / "cloud.ply"))
    for name, call in taking_points().items():
        expected = call(points)
        for form in forms:
            found = call(form)
            assert torch.equal(found.nan_to_num(), expected.nan_to_num()), (name, type(form))
        for wrong, repair in [
            (points.tolist(), "use torch.tensor"),
            ([points, points], r"pass one at a time, as \["),
            (3.5, "a Cloud or a path, got float"),
        ]:
            with pytest.raises(ShapeError, match=repair):
                call(wrong)


def test_results_in_other_places_are_refused_with_the_repair(tmp_path):
    points = argument("planes")
    seg = torchrg.segment_planes(points, "classic")
    for call, message in [
        (lambda: torchrg.select_planes(points), "seg to be Segmentation, got Tensor; pass a res"),
        (lambda: torchrg.align_axes(points), "planes to be Planes, got Tensor; pass a result"),
        (lambda: torchrg.make_superpoints(points, "classic"), "seg to be Segmentation, got str"),
        (lambda: torchrg.write_cloud("a.ply", points, seg.planes), "to be Segmentation, got Pla"),
        (lambda: torchrg.write_cloud(points, "a.ply"), "path to be a path, got Tensor; pass path"),
        (lambda: torchrg.nn.Normal()(points), r"eigen to be Eigen, got Tensor; use Normal"),
        (lambda: torchrg.nn.Qn(points), r"expected settings, got a tensor; use Qn\(\)\(tensor\)"),
        (lambda: torchrg.nn.DetMCD(points), r"use DetMCD\(\)\(tensor\)"),
        (lambda: torchrg.segment_planes(points, voxel="2cm"), "expected size > 0, got '2cm'"),
        (lambda: torchrg.estimate_normals(points, "pca"), "an estimator is a method, as method='p"),
        (lambda: torchrg.segment_planes(points, normals=points), "torchrg.grow_regions takes nor"),
    ]:
        with pytest.raises(ConfigError, match=message):
            call()
    with pytest.raises(ShapeError, match=r"got int32; pass points.float"):
        torchrg.segment_planes(points.int())
    with pytest.raises(ShapeError, match=r"got tuple; use torchrg.depth.make_intrinsics\(fx"):
        torchrg.depth.segment_depth(torch.ones(4, 5), (5, 5, 2, 2))
    neighbors = torchrg.search_knn(points, 10)
    with pytest.raises(ShapeError, match=r"got Neighbors; pass curvature in its place, or name"):
        torchrg.grow_regions(points, seg.normals, neighbors, "classic")
    with pytest.raises(ShapeError, match=r"pass the cloud .*torchrg.write_cloud\(path, cloud, seg"):
        torchrg.write_cloud(tmp_path / "a.ply", seg)
    with pytest.raises(ShapeError, match="got Segmentation; pass its labels"):
        torchrg.metrics.score_labels(seg, seg.labels)
    with pytest.raises(ShapeError, match="got str; pass its values, not a name or path"):
        torchrg.segment_planes(points, within="instance")


@pytest.mark.parametrize("make", [torch.asarray, np.asarray], ids=["tensor", "array"])
def test_no_message_lists_the_values_of_a_tensor(make):
    points = argument("planes")
    wrong = make(points.numpy())
    for name in ("config", "orient", "voxel", "min_area", "normals", "kinds", "up", "normals.k"):
        with pytest.raises(ConfigError, match=f"{type(wrong).__name__}") as refused:
            torchrg.segment_planes(points, **{name: wrong})
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 250


@pytest.mark.parametrize(
    "call",
    [
        torchrg.nn.DetMCD,
        lambda **settings: torchrg.robust.fit_detmcd(argument("planes"), **settings),
    ],
    ids=["module", "function"],
)
def test_unknown_keywords_of_estimators_lead_to_those_here(call):
    with pytest.raises(
        TypeError, match="unexpected keyword argument 'alpha'; use support_fraction"
    ):
        call(alpha=0.75)
    with pytest.raises(TypeError, match=r"'wild'; it has .*support_fraction, quantile"):
        call(wild=1)
