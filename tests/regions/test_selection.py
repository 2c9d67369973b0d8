"""Planes selected by area and class: one result through every door."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import torchrg
from torchrg.batch.scans import Job, convert_scan, reason_to_convert
from torchrg.cli.arguments import parse
from torchrg.cli.convert import FolderArguments, RGBDArguments
from torchrg.config import DepthConfig, PipelineConfig, SelectionConfig
from torchrg.depth import segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.errors import ConfigError
from torchrg.io import write_cloud
from torchrg.io.result import read_result
from torchrg.regions.selection import keep_planes
from torchrg.structures import PLANE_KINDS, Cloud
from torchrg.structures.planes import PLANE_COLUMNS
from torchrg.transforms import SegmentDepth, SegmentPlanes

SHELL = ("wall", "floor", "ceiling")
ASKED = {"min_area": 1.0, "kinds": SHELL, "sort": "area"}
FLAGS = ("--min-area", "1", "--kinds", "wall,floor,ceiling", "--sort", "area")


@pytest.fixture(scope="module")
def points(room):
    return room(8000, 0.003, 1).points


@pytest.fixture(scope="module")
def whole(points):
    return torchrg.segment_planes(points, "classic", **{"planes.up": "z"})


@pytest.fixture(scope="module")
def chosen(whole):
    return torchrg.select_planes(whole, **ASKED)


def kinds_of(planes):
    return [PLANE_KINDS[kind] for kind in planes.kind]


def is_equal(first, second):
    """Whether two segmentations have the same labels and planes."""
    names = (*PLANE_COLUMNS, "kind")
    columns = all(
        torch.equal(getattr(first.planes, name), getattr(second.planes, name)) for name in names
    )
    return torch.equal(first.labels, second.labels) and columns


def test_selected_planes_have_the_area_and_the_class(whole, chosen):
    planes = chosen.planes
    expected = [
        (area, row)
        for row, (area, kind) in enumerate(
            zip(whole.planes.area, kinds_of(whole.planes), strict=True)
        )
        if kind in SHELL and area >= 1
    ]
    assert 3 < len(expected) < len(whole.planes)
    rows = [row for _, row in sorted(expected, key=lambda pair: (-pair[0], pair[1]))]
    assert set(kinds_of(planes)) <= set(SHELL)
    for name in (*PLANE_COLUMNS, "kind"):
        assert torch.equal(getattr(planes, name), getattr(whole.planes, name)[rows])
    for new, old in enumerate(rows):
        assert torch.equal(chosen.labels == new, whole.labels == old)
    assert torch.equal(chosen.labels < 0, ~torch.isin(whole.labels, torch.tensor(rows)))
    assert torch.equal(chosen.normals, whole.normals)


def test_adjacency_and_outlines_follow(whole, points):
    outlined = torchrg.segment_planes(
        points, "classic", **{"planes.up": "z", "planes.outline": True}
    )
    met = {
        tuple(pair): (float(length), float(angle))
        for pair, length, angle in zip(
            outlined.planes.adjacency.pairs.tolist(), *outlined.planes.adjacency[1:], strict=True
        )
    }
    # In reversed order the planes of every pair are exchanged.
    backwards = torch.arange(len(outlined.planes)).flip(0)
    for chosen in (torchrg.select_planes(outlined, **ASKED), keep_planes(outlined, backwards)):
        old = [int(outlined.labels[chosen.labels == row][0]) for row in range(len(chosen.planes))]
        pairs, *sizes = chosen.planes.adjacency
        for (a, b), *values in zip(pairs.tolist(), *sizes, strict=True):
            assert a < b
            assert met[tuple(sorted((old[a], old[b])))] == tuple(map(float, values))
        assert pairs.tolist() == sorted(pairs.tolist())
        assert len(pairs) == sum(set(pair) <= set(old) for pair in met)
        assert len(pairs) > 3
        for outline, row in zip(chosen.planes.outline, old, strict=True):
            assert outline is outlined.planes.outline[row]


def test_order_by_points_and_by_area(whole):
    by_area = torchrg.select_planes(whole, sort="area")
    assert bool((by_area.planes.area.diff() <= 0).all())
    assert len(by_area.planes) == len(whole.planes)
    assert is_equal(torchrg.select_planes(by_area), whole)
    assert is_equal(torchrg.select_planes(whole), whole)


def test_no_plane_may_be_left(whole):
    for kept in ({"min_area": 1e6}, {"kinds": "floor", "min_area": 1e6}):
        nothing = torchrg.select_planes(whole, **kept)
        assert len(nothing.planes) == len(nothing.planes.adjacency.pairs) == 0
        assert nothing.labels.unique().tolist() == [-1]
        assert len(torchrg.select_planes(nothing, sort="area").planes) == 0


def test_an_area_in_another_unit_is_said(whole):
    smallest = float(whole.planes.area.min())
    with pytest.warns(UserWarning, match=r"min_area .* keeps all planes, the smallest has"):
        kept = torchrg.select_planes(whole, min_area=0.99e-4 * smallest)
    assert len(kept.planes) == len(whole.planes)
    torchrg.select_planes(whole, min_area=1.01e-4 * smallest)


def test_classes_are_those_of_the_table_or_of_the_direction(points, whole, chosen):
    without = replace(whole, planes=replace(whole.planes, kind=None))
    assert is_equal(torchrg.select_planes(without, **ASKED), chosen)
    assert is_equal(torchrg.select_planes(without, **ASKED, up=(0, 0, 2)), chosen)
    turned = torchrg.select_planes(whole, kinds="floor", up="-z")
    ceiling = torchrg.select_planes(whole, kinds="ceiling")
    assert torch.equal(turned.labels, ceiling.labels)
    with pytest.raises(ConfigError, match="Pass up to segment_depth"):
        torchrg.select_planes(replace(without, points=None), kinds="wall")


def test_segment_planes_and_its_transform_select_alike(points, chosen):
    for config in ("classic", {"base": "classic", **ASKED}):
        changes = ASKED if config == "classic" else {}
        assert is_equal(torchrg.segment_planes(points, config, **changes), chosen)
        sample = SegmentPlanes(config, **changes)({"coord": points})
        assert torch.equal(sample["plane"], chosen.labels)
    voxels = torchrg.segment_planes(points, "classic", voxel=0.2, **ASKED).planes
    assert 3 < len(voxels) < 8
    assert bool((voxels.area >= 1).all())


def test_commands_select_alike(points, chosen, run, tmp_path):
    write_cloud(tmp_path / "room.npz", Cloud(points.numpy()))
    source, out, table = tmp_path / "room.npz", tmp_path / "out.npz", tmp_path / "planes.csv"
    run("segment", source, "--out", out, "--table", table, "--preset", "classic", *FLAGS)
    result = read_result(out)
    assert is_equal(result.segmentation, chosen)
    lines = table.read_text().splitlines()
    assert [line.split(",")[1] for line in lines[1:]] == kinds_of(chosen.planes)
    assert result.provenance["config"]["kinds"] == [*SHELL]


def test_conversions_select_alike(points, chosen, tmp_path):
    (tmp_path / "in").mkdir()
    write_cloud(tmp_path / "in" / "room.npz", Cloud(points.numpy()))
    flags = (str(tmp_path / "in"), str(tmp_path / "out"), *FLAGS)
    command = (*flags, "--preset", "classic")
    arguments = parse(FolderArguments, command, prog="torchrg convert folder")
    source = arguments.source(tmp_path / "in")
    job = Job(source, source.list_scans(tmp_path / "out")[0], tmp_path / "out")
    assert convert_scan(job).status == "converted"
    assert np.array_equal(np.load(job.folder / "plane.npy"), chosen.labels)
    described = json.loads((job.folder / "planes.json").read_text())["planes"]
    assert [plane["kind"] for plane in described] == kinds_of(chosen.planes)
    # Another selection is another result.
    assert not reason_to_convert(job)
    other = replace(source.settings, min_area=2.0)
    assert reason_to_convert(replace(job, source=replace(source, settings=other)))
    flags = (*flags, "--up", "-y")
    arguments = parse(RGBDArguments, flags, prog="torchrg convert rgbd")
    assert arguments.depth == DepthConfig(up="-y", **ASKED)


def test_superpoints_keep_to_the_borders_of_all_planes(points, run, tmp_path):
    write_cloud(tmp_path / "room.npz", Cloud(points.numpy()))
    found = []
    for name, flags in (("whole", ()), ("chosen", FLAGS)):
        out = tmp_path / f"{name}.npz"
        flags = ("--preset", "classic", "--superpoints", "200", *flags)
        assert run("segment", tmp_path / "room.npz", "--out", out, *flags).code == 0
        found.append(read_result(out))
    whole, chosen = found
    assert torch.equal(chosen.superpoints.labels, whole.superpoints.labels)
    plane = chosen.superpoints.plane
    assert int(plane.max()) == len(chosen.planes) - 1
    for new, old in zip(plane.tolist(), whole.superpoints.plane.tolist(), strict=True):
        is_kept = old >= 0 and bool((chosen.labels[whole.labels == old] >= 0).all())
        assert new == (int(chosen.labels[whole.labels == old][0]) if is_kept else -1)


def test_depth_images_select_alike(run, tmp_path):
    """The image of a floor 1.2 m below a level camera, and of two walls in front of it."""
    u = (torch.arange(160).double() - 79.5) / 100
    v = (torch.arange(120).double()[:, None] - 59.5) / 100
    floor = (1.2 / v.clamp(min=1e-9)).expand(120, 160)
    depth = torch.minimum(floor, torch.minimum(3 / (1 + u), 3 / (1 - u))).float()
    camera = make_intrinsics(100.0, 100.0, 79.5, 59.5)
    whole = segment_depth(depth, camera, up="-y")
    assert kinds_of(whole.planes) == ["wall", "wall", "floor"]
    asked = {"kinds": "floor,wall", "sort": "area", "min_area": float(whole.planes.area.median())}
    chosen = segment_depth(depth, camera, up="-y", **asked)
    assert len(chosen.planes) == 2
    assert chosen.planes.area[0] >= chosen.planes.area[1] >= asked["min_area"]
    assert is_equal(torchrg.select_planes(whole, **asked), chosen)
    sample = {"depth": depth, "intrinsics": camera}
    assert torch.equal(SegmentDepth(up="-y", **asked)(sample)["plane"], chosen.labels)
    np.save(tmp_path / "frame.npy", depth.numpy())
    flags = ("--intrinsics", "100,100,79.5,59.5", "--depth-scale", "1", "--up", "-y")
    flags = (*flags, "--kinds", "floor,wall", "--sort", "area", "--min-area", asked["min_area"])
    out, table = tmp_path / "out.npz", tmp_path / "planes.json"
    run("depth", tmp_path / "frame.npy", "--out", out, "--table", table, *flags)
    assert torch.equal(read_result(out).labels.view(120, 160), chosen.labels)
    kinds = [plane["kind"] for plane in json.loads(table.read_text())["planes"]]
    assert kinds == kinds_of(chosen.planes)


def test_selections_that_cannot_be_are_refused(whole, run, tmp_path):
    for wrong, message in (
        ({"min_area": -1.0}, "expected min_area >= 0, got -1.0"),
        ({"kinds": "wal"}, "expected kinds to be some of other, floor"),
        ({"kinds": ()}, "expected kinds to be some of other, floor"),
        ({"sort": "size"}, "expected sort to be one of points, area"),
    ):
        with pytest.raises(ConfigError, match=f"^select_planes: .*{message}"):
            torchrg.select_planes(whole, **wrong)
        with pytest.raises(ConfigError, match=f"^segment_planes: .*{message}"):
            torchrg.segment_planes(whole.points, **wrong)
    with pytest.raises(ConfigError, match="expected up to be a direction"):
        torchrg.select_planes(whole, up="north")
    with pytest.raises(ConfigError, match="expected up with kinds, as -y for a level camera"):
        DepthConfig(kinds=("wall",))
    out = ("in.npz", "--out", tmp_path / "out.npz")
    for flags, message in (
        (("--kinds", "wall,wal"), "expected --kinds to be some of other, floor"),
        (("--min-area", "-1"), "expected --min-area >= 0, got -1.0."),
        (("--sort", "size"), "expected --sort to be one of points, area, got 'size'."),
    ):
        assert message in run("segment", *out, *flags).error
    assert "expected --up with kinds" in run("depth", *out, "--kinds", "wall").error


def test_a_selection_that_leaves_nothing_is_named(points, run, tmp_path):
    write_cloud(tmp_path / "room.npz", Cloud(points.numpy()))
    flags = ("--out", tmp_path / "out.npz", "--preset", "classic", "--min-area", "1e6")
    done = run("segment", tmp_path / "room.npz", *flags)
    assert "no plane found: no plane passes --min-area and --kinds." in done.err


def test_both_configurations_have_the_same_selection():
    names = {field.name for field in fields(SelectionConfig)}
    for kind in (PipelineConfig, DepthConfig):
        for name in names:
            assert getattr(kind(), name) == getattr(SelectionConfig(), name)
