"""Settings: presets load, differences only, unknown keys and wrong values are refused."""

import dataclasses
import math
import types
from operator import attrgetter
from pathlib import Path

import pytest
import torch
import yaml

from torchrg.cli import segment
from torchrg.cli.arguments import list_flags, parse
from torchrg.config import (
    DepthConfig,
    GrowingConfig,
    NormalsConfig,
    PipelineConfig,
    PlanesConfig,
    SuperpointsConfig,
    load_config,
    preset_names,
    settings_of,
)
from torchrg.errors import ConfigError
from torchrg.normals import estimate_normals
from torchrg.pipeline import make_superpoints, segment_planes
from torchrg.structures import Sampling
from torchrg.transforms import (
    EstimateNormals,
    GrowRegions,
    MakeSuperpoints,
    SegmentDepth,
    SegmentPlanes,
)

CONFIGS = Path(__file__).parents[1] / "configs"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_preset_loads_by_name_and_by_path(path):
    assert path.stem in preset_names()
    assert load_config(path.stem) == load_config(path)


def test_a_preset_is_read_once_and_a_file_each_time(tmp_path, monkeypatch):
    path = tmp_path / "own.yaml"
    for angle in (3.0, 4.0):
        path.write_text(f"base: classic\ngrowing: {{max_angle_deg: {angle}}}\n")
        assert load_config(path).growing.max_angle_deg == angle
    classic = load_config("classic")
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("read again"))
    assert load_config("classic") == classic
    assert load_config({"base": "classic"}) == classic


def test_presets_are_those_of_the_contract():
    contract = {"classic", "classic_increment", "detmm", "paper", "algorithm2", "consensus"}
    assert contract <= set(preset_names())
    assert load_config() == load_config("consensus")
    assert load_config("classic").growing.connectivity is None
    assert load_config() == PipelineConfig()
    paper = load_config("paper").growing
    beyond = ("absorb", "cut_bridges", "merge_coplanar", "refine_borders")
    assert not any(getattr(paper, name) for name in beyond)
    assert (paper.max_angle_deg, paper.connectivity, paper.plane_reach) == (5.0, 0.75, None)


def angles_of(config):
    return config.normals.sharp_angle_deg, config.growing.max_angle_deg


@pytest.mark.parametrize(
    ("text", "angles"),
    [
        ("angle_deg: 8", (8, 8)),
        ("angle_deg: 8\nbase: consensus", (8, 8)),
        ("angle_deg: 8\ngrowing: {max_angle_deg: 3}", (8, 3)),
        ("normals: {sharp_angle_deg: 2}\nangle_deg: 8", (2, 8)),
        ("growing: {max_angle_deg: 3}", (5, 3)),
    ],
)
def test_one_angle_moves_sharp_points_and_growth_unless_they_are_named(tmp_path, text, angles):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    assert angles_of(load_config(path)) == angles
    assert angles_of(load_config(path).with_angle(4)) == (4, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "growing: {max_angle: 5}",
            "unknown setting 'growing.max_angle'; the nearest is growing.max_angle_deg, as in ",
        ),
        ("k: 5", "unknown setting 'k'; the nearest is normals.k, as in {'normals.k': 5}"),
        ("normals: {k: 2}", "yaml: expected normals.k >= 3, got 2"),
        ("normals: {k: 3.5}", "expected normals.k to be an integer, got 3.5"),
        ("normals: {k: true}", "expected normals.k to be an integer, got True"),
        ("normals: {method: ransac}", "expected normals.method to be one of pca, jet"),
        (
            "growing: {connectivity: yes}",
            "expected growing.connectivity to be a number or none, got True",
        ),
        ("planes: {up: w}", "planes.up to be one of x, y, z, -x, -y, -z or none, got 'w'"),
        ("growing: 5", "expected growing to be a GrowingConfig or a mapping, got 5"),
        ("angle_deg: [5]", r"expected angle_deg to be a number, got \[5\]"),
        ("angle_deg: 91", r"expected angle_deg in \[0, 90\], got 91"),
        ("angle: 5", "unknown setting 'angle'; the nearest is angle_deg, as in {'angle_deg': 5}"),
        ("angles: 5", "unknown setting 'angles'; PipelineConfig has"),
        ("shade: 5", "unknown setting 'shade'; PipelineConfig has .*, angle_deg"),
        ("growing: [", "expected YAML"),
        pytest.param("[" * 900, "expected YAML, got maximum recursion", id="brackets"),
        pytest.param("chunk_size: " + "9" * 5000, "expected YAML, got Exceeds", id="digits"),
        ("- 1", "expected settings to be a mapping"),
        ("base: clasic", r"expected base to be one of .*classic, .* got 'clasic'"),
        ("base: 3", "got 3"),
        ("base: [consensus]", "got "),
        ("base: ../mine", "expected base"),
        ("base: consensus\ngrowing: 3", "expected growing to be a GrowingConfig or a mapping"),
        ("base: consensus\ngrow: {}", "unknown setting 'grow'; PipelineConfig has"),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as info:
        load_config(path)
    assert str(info.value).startswith(str(path))


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (NormalsConfig, {"support_fraction": 0.4}, r"support_fraction in \[0.5, 1\], got 0.4"),
        (NormalsConfig, {"sharp_angle_deg": -1.0}, r"sharp_angle_deg in \[0, 90\]"),
        (NormalsConfig, {"irls_decay": 1.0}, "irls_decay > 1"),
        (NormalsConfig, {"inlier_quantile": 1.0}, r"inlier_quantile in \(0, 1\)"),
        (GrowingConfig, {"max_angle_deg": 91.0}, r"max_angle_deg in \[0, 90\]"),
        (GrowingConfig, {"curvature_quantile": 1.1}, "curvature_quantile in"),
        (GrowingConfig, {"connectivity": 2.0}, "connectivity in"),
        (GrowingConfig, {"min_size": 0}, "GrowingConfig: expected min_size >= 1"),
        (GrowingConfig, {"coplanarity_floor": -1.0}, "coplanarity_floor "),
        (GrowingConfig, {"max_plane_residual": 0.0}, "max_plane_residual > 0 or none"),
        (GrowingConfig, {"absorb_reach": -1.0}, "absorb_reach "),
        (GrowingConfig, {"absorb_angle_deg": 91.0}, "absorb_angle_deg "),
        (GrowingConfig, {"merge_tolerance": 0.9}, "merge_tolerance "),
        (GrowingConfig, {"facet_tolerance": 0.0}, "facet_tolerance "),
        (GrowingConfig, {"max_distance": -1.0}, "max_distance "),
        (PipelineConfig, {"chunk_size": 0}, "chunk_size >= 1"),
        (DepthConfig, {"noise": (0.0, 0.0)}, "DepthConfig: expected noise two numbers >= 0"),
        (DepthConfig, {"noise": (-1.0, 0.1)}, "noise two numbers >= 0, not both 0, or none"),
        (DepthConfig, {"noise": (math.inf, 0.1)}, "noise in "),
        (DepthConfig, {"noise": (0.1,)}, "expected noise to be 2 numbers or none, got \\(0.1,\\)"),
        (DepthConfig, {"max_depth": 0.0}, "DepthConfig: expected max_depth > 0 or none"),
        (DepthConfig, {"max_angle_deg": 91.0}, r"DepthConfig: expected max_angle_deg in \[0, 90\]"),
        (DepthConfig, {"max_step": -1.0}, "max_step >= 0"),
        (DepthConfig, {"min_size": 0}, "DepthConfig: expected min_size >= 1"),
    ],
)
def test_values_out_of_range_are_refused(kind, values, message):
    with pytest.raises(ConfigError, match=message):
        kind(**values)


SETTINGS = [
    (kind, name)
    for kind in (NormalsConfig, GrowingConfig, PlanesConfig, PipelineConfig, DepthConfig)
    for name in vars(kind())
]
"""Every setting of planes, by its class and name."""


def doors(kind, name, folder):
    """Return functions that make settings from one value, and return that of the settings."""
    own = attrgetter(name)
    yield lambda given: own(kind(**{name: given}))
    yield lambda given: own(settings_of("f", kind, {name: given}))
    if kind is DepthConfig:
        return
    sections = {NormalsConfig: "normals.", GrowingConfig: "growing.", PlanesConfig: "planes."}
    dotted = f"{sections.get(kind, '')}{name}"
    whole = attrgetter(dotted)
    yield lambda given: whole(load_config(**{dotted: given}))
    yield lambda given: whole(SegmentPlanes({dotted: given}).config)

    def from_file(given):
        path = folder / "mine.yaml"
        path.write_text(yaml.safe_dump({dotted: given}))
        return whole(load_config(path))

    def from_command(given):
        flags = {flag.path: flag.name for flag in list_flags(segment.Arguments)}
        flag = flags.get(f"settings.{dotted}", f"--{dotted}")
        line = ["a.ply", "--out", "b.npz", f"{flag}={given}"]
        return whole(parse(segment.Arguments, line, prog="torchrg segment").settings)

    if not dataclasses.is_dataclass(own(kind())):
        yield from_file
        yield from_command


@pytest.mark.parametrize(("kind", "name"), SETTINGS)
def test_every_setting_takes_its_value_in_words_and_refuses_others_at_every_door(
    kind, name, tmp_path
):
    value = getattr(kind(), name)
    for ask in doors(kind, name, tmp_path):
        if not dataclasses.is_dataclass(value):
            assert ask(str(value)) == value
            assert type(ask(str(value))) is type(value)
        for wrong in ("no such value", math.nan, [[value], [value]], b"no"):
            shown = name.replace("_", "[_-]")
            with pytest.raises(ConfigError, match=f"expected .*{shown} to be"):
                ask(wrong)


@pytest.mark.parametrize("name", ["s3dis", "scannet", "laser", "rgbd"])
def test_presets_for_a_kind_of_data_say_what_took_their_place(name, tmp_path):
    for ask in (load_config, lambda name: load_config(base_file(tmp_path, name))):
        with pytest.raises(ConfigError, match=f"got '{name}'; leave it out: the default adapts"):
            ask(name)


def base_file(folder, name):
    path = folder / "mine.yaml"
    path.write_text(f"base: {name}\n")
    return path


FACETS = Sampling(whiteness=0.1, variation=0.5, exactness=0.5, density=4000.0, height=2.7)
VERTICES = Sampling(whiteness=0.8, variation=0.28, density=700.0, height=2.7)
RAYS = Sampling(whiteness=0.9, variation=0.6, density=7000.0, height=2.7)
DESK = Sampling(0.7, variation=0.25, exactness=0.1, density=3e5, height=0.25, deviation=8e-4)


@pytest.mark.parametrize(
    ("sampling", "scope", "tolerance", "faceted", "least"),
    [
        # A square of a 13th of 2.7 m has 173 of 4,000 points, of a 27th 7 of 700 and 70 of 7,000.
        (FACETS, "local", 0.0113, True, 173),
        # Warp is no mesh: neither exact nor evenly spaced.
        (FACETS._replace(exactness=0.0), "local", 0.0281, True, 40),
        (FACETS._replace(exactness=0.15), "local", 0.0197, True, 95),
        (FACETS._replace(exactness=0.0, variation=0.3), "local", 0.0113, True, 40),
        (FACETS._replace(height=27.0, exactness=0.0), "local", 0.0473, True, 50),
        (VERTICES, "regional", 0.00506, True, 20),
        (VERTICES._replace(whiteness=0.55), "regional", 0.00506, True, 20),
        (VERTICES._replace(exactness=0.04), "regional", 0.00506, False, 20),
        (VERTICES._replace(whiteness=0.48), "local", 0.00675, True, 20),
        (RAYS, "local", 0.00506, False, 50),
        # Steps of sqrt(12) 0.8 mm; 50 points of a desk are within 7.3 mm, those of a wall 28 mm.
        (DESK, "regional", 0.00277, True, 26),
        (DESK._replace(exactness=0.06), "regional", 0.00139, True, 26),
        (DESK._replace(exactness=0.04), "regional", 0.000469, False, 26),
        (DESK._replace(variation=1.0), "local", 0.000469, False, 26),
        (DESK._replace(deviation=1e-4), "regional", 0.000469, False, 26),
        (DESK._replace(whiteness=0.4, exactness=0.2), "local", 0.00104, True, 111),
        (DESK._replace(density=2e4, deviation=0.01, height=1.5), "regional", 0.0113, True, 50),
        (Sampling(), "local", None, False, 20),
    ],
)
def test_settings_follow_from_how_a_cloud_samples_surfaces(
    sampling, scope, tolerance, faceted, least
):
    config = load_config().with_sampling(sampling)
    assert config.normals.noise_scope == scope
    assert config.growing.facet_tolerance == tolerance
    assert config.growing.min_size == least
    assert config.growing.faceted in (faceted, "auto")
    chosen = load_config().measured(sampling)["settings"]
    expected = [scope, tolerance, *([] if tolerance is None else [faceted]), least]
    assert [*chosen.values()] == expected


def test_settings_that_are_numbers_stay():
    fixed = dataclasses.replace(load_config().growing, min_size=7, facet_tolerance=None)
    config = dataclasses.replace(load_config("classic"), growing=fixed)
    assert config.with_sampling(FACETS).growing == fixed
    assert "growing.min_size" not in config.measured(FACETS)["settings"]


@pytest.mark.parametrize("base", ["consensus", "paper", ""])
def test_a_file_holds_differences_to_its_base(tmp_path, base):
    path, line = tmp_path / "mine.yaml", f"base: {base}\n" if base else ""
    path.write_text(line)
    plain = load_config(path)
    assert plain == load_config(base or None)
    path.write_text(f"{line}growing: {{min_size: 7}}\nchunk_size: 99\n")
    growing = dataclasses.replace(plain.growing, min_size=7)
    assert load_config(path) == dataclasses.replace(plain, growing=growing, chunk_size=99)


@pytest.mark.parametrize(
    ("config", "keywords"),
    [
        ("classic", {"normals.k": 30, "growing.min_size": 7}),
        ("classic", {"normals": {"k": 30}, "growing.min_size": 7}),
        (load_config("classic"), {"normals.k": 30, "growing": {"min_size": 7}}),
        ({"base": "classic", "normals": {"k": 30}, "growing": {"min_size": 7}}, {}),
        ({"base": "classic", "normals.k": 30}, {"growing.min_size": 7}),
        (types.MappingProxyType({"base": "classic", "growing.min_size": 7}), {"normals.k": 30}),
    ],
)
def test_settings_come_by_dictionary_and_keyword(config, keywords):
    classic = load_config("classic")
    expected = dataclasses.replace(
        classic,
        normals=dataclasses.replace(classic.normals, k=30),
        growing=dataclasses.replace(classic.growing, min_size=7),
    )
    assert load_config(config, **keywords) == expected
    assert segment_config(config, **keywords) == expected


def segment_config(config, **keywords):
    return SegmentPlanes(config, **keywords).config


def test_sections_and_other_settings_come_by_dictionary_too():
    assert EstimateNormals({"method": "pca", "k": 9}).config.k == 9
    assert EstimateNormals({"base": "classic", "normals.k": 9}).config.method == "pca"
    assert GrowRegions({"growing": {"min_size": 9}}).config.min_size == 9
    assert MakeSuperpoints({"counts": [100, 10]}).config.counts == (100, 10)
    assert MakeSuperpoints(counts=100).config.counts == (100,)
    assert SegmentDepth({"noise": [0, 0.003]}, min_size=9).config == DepthConfig(
        (0.0, 0.003), min_size=9
    )
    assert load_config(growing=GrowingConfig(min_size=9)).growing.min_size == 9
    assert PipelineConfig(normals={"k": 30}).normals == NormalsConfig(k=30)
    assert angles_of(load_config("paper", angle_deg=8)) == (8, 8)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda: load_config(k=3),
            r"^load_config: unknown .* normals.k, as in {'normals.k': 3}\.$",
        ),
        (lambda: SegmentPlanes("classic", min_size=3), "the nearest is growing.min_size, as in"),
        (
            lambda: SegmentPlanes(**{"normal.k": 3}),
            "unknown setting 'normal.k'; the nearest is normals.k",
        ),
        (
            lambda: SegmentPlanes({"normals.k": "3.5"}),
            "SegmentPlanes: expected normals.k to be an integer, got '3.5'",
        ),
        (lambda: segment_planes(torch.zeros(3, 3), preset="classic"), "as the first argument"),
        (lambda: estimate_normals(torch.zeros(3, 3), radius=0.1), "radius.*max_distance bounds"),
        (lambda: make_superpoints(torch.zeros(3, 3), n=10), "numbers of superpoints are counts"),
        (lambda: MakeSuperpoints("classic"), "a SuperpointsConfig or a dictionary, got str"),
        (
            lambda: MakeSuperpoints(counts="1;2"),
            "expected counts to be integers or none, got '1;2'",
        ),
        (lambda: SegmentDepth(noise=[0.1]), "expected noise to be 2 numbers or none, got"),
        (lambda: load_config(["classic"]), "a dictionary, or a preset, one of .*, got list"),
    ],
)
def test_wrong_keywords_name_the_repair(ask, message):
    with pytest.raises(ConfigError, match=message):
        ask()


@pytest.mark.parametrize("config", [load_config().normals, DepthConfig(), load_config()])
def test_settings_that_are_assigned_say_how_others_are_made(config):
    with pytest.raises(AttributeError, match=r"is immutable; use .*min_size.*7"):
        config.min_size = 7


def test_checkpoints_hold_settings_without_trust(tmp_path):
    torch.save({"config": load_config("paper")}, tmp_path / "a.ckpt")
    assert torch.load(tmp_path / "a.ckpt", weights_only=True)["config"] == load_config("paper")


@pytest.mark.parametrize(
    "config",
    [
        load_config(),
        load_config("classic", **{"growing.min_size": 7}),
        NormalsConfig(method="pca", k=9),
        SuperpointsConfig(counts=(30,)),
        DepthConfig(max_depth=4.0),
    ],
)
def test_settings_are_shown_as_the_call_that_makes_them(config):
    names = (load_config, NormalsConfig, SuperpointsConfig, DepthConfig)
    assert eval(repr(config), {name.__name__: name for name in names}) == config
    assert len(repr(config)) < 100


def test_settings_of_by_example():
    assert settings_of("f", NormalsConfig, "classic", {"k": 30}).method == "pca"


def test_settings_that_keep_all_planes_have_the_up_axis_of_classes():
    assert load_config(kinds="wall").without_selection().planes.up == "z"
    assert load_config().without_selection().planes.up is None
    assert load_config("classic").measured(None) == {}


@pytest.mark.parametrize(
    "make",
    [
        lambda: load_config(angle_deg=0.0872),
        lambda: load_config({"growing.max_angle_deg": "0.0872"}),
        lambda: GrowingConfig(absorb_angle_deg=0.0872),
        lambda: DepthConfig(max_angle_deg=0.0872),
    ],
)
def test_an_angle_in_radians_is_told(make, recwarn):
    make()
    message = "expected degrees, not radians, got 0.0872; pass 5."
    assert {str(warning.message) for warning in recwarn} == {message}
    recwarn.clear()
    load_config({"growing.max_angle_deg": 0.5, "normals.sharp_angle_deg": 0})
    assert not recwarn
