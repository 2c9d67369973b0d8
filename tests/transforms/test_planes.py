"""Transforms call the functions, rename keys, and never change what they are given."""

import inspect

import pytest
import torch
from torch import nn

from torchrg import transforms
from torchrg.config import (
    GrowingConfig,
    NormalsConfig,
    SuperpointsConfig,
    load_config,
)
from torchrg.errors import ConfigError
from torchrg.neighbors import search_knn
from torchrg.normals import estimate_normals
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.regions import grow_regions
from torchrg.scenes import make_room
from torchrg.transforms import (
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    SegmentDepth,
    SegmentPlanes,
)


@pytest.fixture(scope="module")
def coord():
    return make_room(4000, 0.003, 0).points


def test_segment_planes_is_the_function(coord):
    sample = SegmentPlanes("classic")({"coord": coord, "name": "room"})
    seg = segment_planes(coord, load_config("classic"))
    assert torch.equal(sample["plane"], seg.labels)
    assert torch.equal(sample["normal"], seg.normals)
    assert torch.equal(sample["curvature"], seg.curvature)
    assert sample["name"] == "room"


def test_the_given_sample_is_not_changed(coord):
    sample = {"coord": coord.clone()}
    SegmentPlanes("classic")(sample)
    assert list(sample) == ["coord"]
    assert torch.equal(sample["coord"], coord)


def test_keys_can_be_renamed(coord):
    keys = {"coord": "pos", "plane": "superpoint"}
    sample = SegmentPlanes("classic", keys=keys)({"pos": coord})
    assert set(sample) == {"pos", "superpoint", "normal", "curvature"}


def test_points_that_are_not_finite_are_left_out(coord):
    spoiled = coord.clone()
    spoiled[7] = torch.nan
    config = load_config("classic")
    steps = torch.nn.Sequential(EstimateNormals(config.normals), GrowRegions(config.growing))
    expected = segment_planes(spoiled, config).labels
    assert torch.equal(steps({"coord": spoiled})["plane"], expected)
    assert expected[7] == -1


@pytest.mark.parametrize("transform", [EstimateNormals(), GrowRegions("paper"), SegmentPlanes()])
def test_empty_clouds_pass(transform):
    empty = torch.empty(0, 3)
    sample = {"coord": empty, "normal": empty, "curvature": torch.empty(0)}
    result = transform(sample)
    assert all(len(value) == 0 for value in result.values())


def test_a_missing_key_is_named(coord):
    with pytest.raises(ConfigError, match="expected a sample with 'coord', got pos"):
        EstimateNormals()({"pos": coord})


def test_an_unknown_key_is_refused():
    with pytest.raises(ConfigError, match="expected keys to rename coord, normal"):
        SegmentPlanes("classic", keys={"points": "pos"})


def test_who_says_nothing_gets_the_same_everywhere():
    points = make_room(4000, 0.003, 5).points
    seg = segment_planes(points, orient="none")
    fit = estimate_normals(points)
    neighbors = search_knn(points, load_config().normals.k)
    labels = grow_regions(*(points, fit.normals, fit.curvature, neighbors), residual_rms=fit[3])
    assert torch.equal(seg.labels, labels)
    assert torch.equal(seg.normals, fit.normals)
    for transform in (SegmentPlanes(), nn.Sequential(EstimateNormals(), GrowRegions())):
        assert torch.equal(transform({"coord": points})["plane"], seg.labels)
    with pytest.raises(ConfigError, match="residual"):
        GrowRegions()(EstimateNormals(residual=False)({"coord": points}))


@pytest.mark.parametrize("preset", ["consensus", "paper", "detmm"])
def test_presets_are_taken_by_name_wherever_a_configuration_is(preset):
    points, config = make_room(800, 0.003, 5).points, load_config(preset)
    seg = segment_planes(points, config, orient="none")
    assert torch.equal(segment_planes(points, preset).labels, seg.labels)
    assert torch.equal(SegmentPlanes(preset)({"coord": points})["plane"], seg.labels)
    fit = estimate_normals(points, preset)
    assert torch.equal(fit.normals, seg.normals)
    bare = EstimateNormals(config, orient="none")
    assert torch.equal(bare({"coord": points})["normal"], seg.normals)
    steps = nn.Sequential(EstimateNormals(preset), GrowRegions(preset, k=config.normals.k))
    assert torch.equal(steps({"coord": points})["plane"], seg.labels)
    neighbors = search_knn(points, config.normals.k)
    grown = grow_regions(points, *fit[:2], neighbors, preset, residual_rms=fit.residual_rms)
    assert torch.equal(grown, seg.labels)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: EstimateNormals(method="svd"),
            "EstimateNormals: expected method to be one of pca",
        ),
        (lambda: EstimateNormals(methd="pca"), "unknown setting 'methd'; the nearest is method"),
        (lambda: EstimateNormals(k=2.5), "EstimateNormals: expected k to be an integer, got 2.5"),
        (lambda: EstimateNormals("clasic"), "a preset, one of .*classic, .* got 'clasic'"),
        (lambda: EstimateNormals(GrowingConfig()), "EstimateNormals: expected config to be"),
        (
            lambda: GrowRegions(max_angle=5),
            "GrowRegions: unknown setting 'max_angle'; the nearest is max_angle_deg",
        ),
        (lambda: GrowRegions(min_size=0), "GrowRegions: expected min_size >= 1 or auto, got 0"),
        (
            lambda: SegmentPlanes(7),
            "expected config to be a PipelineConfig or a dict.*, or a preset, .* got int",
        ),
        (
            lambda: segment_planes(torch.rand(9, 3), config=[]),
            "segment_planes: expected config .* got list",
        ),
        (lambda: NormalsConfig(method="svd"), "expected method to be one of pca, .* got 'svd'"),
        (lambda: GrowingConfig(seed_rule="x"), "expected seed_rule to be one of curvature, incre"),
    ],
)
def test_wrong_settings_are_refused_at_once_and_in_one_line(make, message):
    with pytest.raises(ConfigError, match=message) as info:
        make()
    assert "\n" not in str(info.value)


@pytest.mark.parametrize(
    ("module", "line"),
    [
        (SegmentPlanes(), "SegmentPlanes(load_config('consensus'))"),
        (
            SegmentPlanes({"base": "paper", "normals.k": 30}, orient="none"),
            "SegmentPlanes(load_config({'base': 'paper', 'normals.k': 30}), orient='none')",
        ),
        (EstimateNormals(k=9), "EstimateNormals(NormalsConfig(k=9))"),
        (GrowRegions(max_angle_deg=7.0), "GrowRegions(GrowingConfig(max_angle_deg=7.0))"),
        (GrowRegions(k=30), "GrowRegions(GrowingConfig(), k=30)"),
        (MakeSuperpoints(), "MakeSuperpoints(SuperpointsConfig())"),
        (MakeSuperpoints(white=1.0), "MakeSuperpoints(SuperpointsConfig(), white=1.0)"),
        (
            SegmentDepth(min_size=7, orient="up"),
            "SegmentDepth(DepthConfig(min_size=7), orient='up')",
        ),
    ],
)
def test_transforms_are_shown_in_one_line(module, line):
    assert repr(module) == line


def test_superpoints_are_those_of_the_function(coord):
    sample = SegmentPlanes("classic")({"coord": coord, "color": coord * 0})
    found = MakeSuperpoints(strengths=(0.2,), min_size=5)(sample)
    config = SuperpointsConfig(strengths=(0.2,), min_size=5)
    seg = segment_planes(coord, load_config("classic"))
    expected = make_superpoints(coord, seg, config).labels
    assert torch.equal(found["superpoint"], expected)
    assert set(found) == {*sample, "superpoint"}


def test_superpoints_read_colours_where_they_are_asked_to(coord):
    color = torch.where(coord[:, :1] < coord[:, 0].mean(), 255.0, 0.0).expand(-1, 3)
    sample = {**SegmentPlanes("classic")({"coord": coord}), "color": color}
    plain, colored = MakeSuperpoints()(sample), MakeSuperpoints(white=255)(sample)
    assert len(plain["superpoint"].unique()) < len(colored["superpoint"].unique())
    with pytest.raises(ConfigError, match=r"color in 0\.\.1, got 0\.\.255; pass white=255\."):
        MakeSuperpoints(white=1)(sample)
    with pytest.raises(ConfigError, match="white > 0"):
        MakeSuperpoints(white=0)
    with pytest.raises(ConfigError, match="expected a sample with 'plane'"):
        MakeSuperpoints()({"coord": coord, "normal": coord})


ARGUMENTS = {
    "keys": {"coord": "pos"},
    "keep_neighbors": True,
    "orient": "up",
    "residual": False,
    "chunk_size": 100,
    "k": 11,
    "white": 1.0,
    "up": (0.0, 1.0, 0.0),
    "size": 0.25,
    "planes": True,
    "depth_scale": 1000.0,
    "depth_kind": "ray",
}
"""A value of each argument that is not its default."""


@pytest.mark.parametrize("name", [name for name in transforms.__all__ if name[0].isupper()])
def test_every_argument_is_shown(name):
    """PyG compares the text with that of processed data."""
    kind = getattr(transforms, name)
    required = {"size": 0.1} if name == "SampleVoxels" else {}
    names = set(inspect.signature(kind).parameters) - {"config", "changes", "viewpoint"}
    for argument in names & {*ARGUMENTS}:
        changed = kind(**{**required, argument: ARGUMENTS[argument]})
        assert f"{argument}={ARGUMENTS[argument]!r}" in repr(changed)
    if "viewpoint" in inspect.signature(kind).parameters:
        shown = repr(kind(orient="viewpoint", viewpoint=(1, 2, 3)))
        assert "orient='viewpoint', viewpoint=(1.0, 2.0, 3.0)" in shown
    assert names <= {*ARGUMENTS}


@pytest.mark.parametrize("name", [name for name in transforms.__all__ if name[0].isupper()])
def test_checkpoints_of_transforms_load(name, tmp_path):
    """As Lightning's do, with ``weights_only``."""
    kind = getattr(transforms, name)
    module = kind(0.1) if name == "SampleVoxels" else kind()
    torch.save({"transform": module}, tmp_path / "a.ckpt")
    again = torch.load(tmp_path / "a.ckpt", weights_only=True)["transform"]
    assert repr(again) == repr(module)


def test_samples_and_results_load(coord, tmp_path):
    sample = SegmentPlanes("classic", keep_neighbors=True)({"coord": coord})
    seg = segment_planes(coord, "classic")
    torch.save([sample, seg, make_superpoints(coord, seg)], tmp_path / "a.pt")
    again, planes, superpoints = torch.load(tmp_path / "a.pt", weights_only=True)
    assert torch.equal(again["plane"], planes.labels)
    assert torch.equal(planes.planes.offset, seg.planes.offset)
    assert len(superpoints.labels) == len(coord)
