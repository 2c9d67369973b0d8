"""Clouds in tiles: what comes out is what comes out in memory, to the last bit."""

import dataclasses
import errno
import itertools
import os
import re
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchrg import pipeline
from torchrg.config import NormalsConfig, load_config
from torchrg.errors import ConfigError, FormatError
from torchrg.neighbors import finite_rows, search_knn
from torchrg.neighbors.tiles import cut_part
from torchrg.normals import ESTIMATORS, STEPS
from torchrg.normals.consensus.constants import REGIONAL_STEPS
from torchrg.pipeline import segment_planes
from torchrg.regions.growth import checked_cloud, grow
from torchrg.scenes import make_room
from torchrg.structures import Cloud
from torchrg.tiles import TileStore, TileTask

STAGES = (
    *("points", "order", "neighbors", "normals", "curvature", "edges"),
    *("growth", "regions", "planes", "results"),
)
PRESETS = ("classic", "paper", "consensus", "s3dis", "scannet")
RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


def settings(preset, k=16):
    """A preset with few neighbours, so that a tile of a small cloud is not all of it."""
    config = load_config(preset)
    return dataclasses.replace(
        config,
        normals=dataclasses.replace(config.normals, k=k),
        growing=dataclasses.replace(config.growing, min_size=12),
        planes=dataclasses.replace(config.planes, up="z"),
    )


def difficult_room(num_points):
    """A room with duplicates, a dense cluster in sparse surroundings, far points, and NaN."""
    rng = np.random.default_rng(3)
    room = make_room(num_points=num_points, noise=0.003, seed=1).points.double().numpy()
    cluster = rng.uniform(0, 0.05, (num_points // 4, 3)) * [1, 1, 0] + [1.0, 1.0, 0.5]
    sparse = rng.uniform(-20, 20, (num_points // 20, 3)) * [1, 1, 0]
    far = np.array([[4e3, 0, 0], [-3e3, 5, 5], [-3e3, 5, 5]])
    parts = [room, room[: num_points // 5], np.repeat(room[:2], 150, axis=0), cluster, sparse, far]
    points = np.concatenate(parts)
    rng.shuffle(points)
    points[::97] = np.nan
    points[5, 1] = np.inf
    return points.astype(np.float32)


def wall(num_points):
    """One noisy wall in a national grid, far from the origin, in double precision."""
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1, (num_points, 3)) * [10, 0, 3] + [5e6, 4e5, 100]
    points[:, 1] += 0.003 * rng.normal(size=num_points)
    return points


def assert_same(found, expected):
    """Check that two segmentations are equal to the last bit."""
    for name in RESULTS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    for name, values in expected.planes._asdict().items():
        same = getattr(found.planes, name)
        if name == "adjacency":
            assert all(torch.equal(a, b) for a, b in zip(same, values, strict=True))
        elif isinstance(values, torch.Tensor):
            assert torch.equal(same, values), name


def segment(points, folder, config, size, *, on_stage=None, identity=None, **options):
    """Segment points that come in three chunks, in tiles."""
    chunks = (Cloud(part) for part in np.array_split(points, 3))
    store = TileStore(folder, identity, tile_size=size, on_progress=on_stage)
    return segment_planes(chunks, config, store=store, **options)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("make", [difficult_room, wall])
def test_tiles_give_the_result_of_the_whole(make, preset, tmp_path):
    points, config = make(2500), settings(preset)
    whole = segment_planes(Cloud(points).points, config)
    assert len(whole.planes.count) > 0
    assert_same(segment(points, tmp_path, config, 900), whole)


@pytest.mark.slow
@pytest.mark.parametrize("size", [2_000, 10_000, 50_000])
@pytest.mark.parametrize("preset", PRESETS)
def test_tiles_of_all_sizes_give_the_result_of_a_large_room(preset, size, tmp_path):
    points, config = difficult_room(80_000), load_config(preset)
    whole = segment_planes(Cloud(points).points, config)
    assert_same(segment(points, tmp_path, config, size), whole)


@pytest.mark.slow
@pytest.mark.parametrize("method", STEPS)
def test_every_estimator_is_told_how_far_it_looks(method, tmp_path):
    config = settings("classic")
    config = dataclasses.replace(config, normals=dataclasses.replace(config.normals, method=method))
    points = difficult_room(2500)
    assert_same(
        segment(points, tmp_path, config, 700), segment_planes(Cloud(points).points, config)
    )


@pytest.mark.parametrize("num_points", [0, 1, 2, 7])
def test_few_points_are_a_cloud_too(num_points, tmp_path):
    points = np.full((num_points + 1, 3), np.nan, dtype=np.float32)
    points[1:] = np.arange(3 * num_points).reshape(-1, 3) ** 2
    found = segment(points, tmp_path, settings("consensus"), 3)
    assert_same(found, segment_planes(Cloud(points).points, settings("consensus")))


def test_a_run_that_ended_early_goes_on_where_it_was(tmp_path, monkeypatch):
    points, config = wall(1500), settings("classic")
    whole = segment_planes(Cloud(points).points, config)
    done = []
    run = TileTask.run
    monkeypatch.setattr(TileTask, "run", lambda task: (done.append(task.name), run(task))[1])
    for name in ("sort_points", "sort_by_curvature", "grow_regions", "finish_regions"):
        step = getattr(pipeline, name)
        counted = lambda *given, step=step: (step(*given), done.append(step.__name__))  # noqa: E731
        monkeypatch.setattr(f"torchrg.pipeline.{name}", counted)
    save = TileStore.save_points
    monkeypatch.setattr(
        TileStore, "save_points", lambda *given: (save(*given), done.append("points"))
    )
    ends = ((stage, count) for stage in STAGES for count in (0, 1))
    # Every second stage begins, and ends the run with its first tile or with none.
    for stage, count in itertools.islice(ends, 0, None, 3):

        def stop(begun, number, of, *, stage=stage, count=count):
            if (begun, number) == (stage, count):
                raise KeyboardInterrupt

        try:
            segment(points, tmp_path, config, 500, on_stage=stop)
        except KeyboardInterrupt:
            continue
    assert_same(segment(points, tmp_path, config, 500), whole)
    assert len(done) == len(set(done)) > 12
    assert_same(segment_planes([], config, store=TileStore(tmp_path)), whole)
    TileStore(tmp_path).remove_all()
    assert not tmp_path.exists()


def begun(points, folder, config, stage):
    """Segment until a stage begins."""

    def stop(begun, number, of):
        if begun == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        segment(points, folder, config, 300, on_stage=stop)


def zero_rows(path):
    content = path.read_bytes()
    path.write_bytes(content[:128].ljust(len(content), b"\0"))


def cut_off(path):
    os.truncate(path, path.stat().st_size // 2)


def damage_header(path):
    content = path.read_bytes()
    path.write_bytes(bytes(128) + content[128:])


@pytest.mark.parametrize("damage", [zero_rows, cut_off, damage_header, Path.unlink])
def test_what_the_disk_has_lost_is_made_again(damage, tmp_path):
    points, config = wall(700), settings("classic")
    whole = segment_planes(Cloud(points).points, config)
    for name in ("points", "rows", "boxes_low", "neighbors", "normals", "edges_1"):
        begun(points, tmp_path / name, config, "growth")
        damage(TileStore(tmp_path / name).path(name))
        assert_same(segment(points, tmp_path / name, config, 500), whole)
    segment(points, tmp_path / "all", config, 300)
    for path in (tmp_path / "all").glob("[!t]*"):
        damage(path)
    assert_same(segment(points, tmp_path / "all", config, 300), whole)


def test_points_that_are_lost_are_not_taken_from_another_cloud(tmp_path):
    config = settings("classic")
    segment(wall(400), tmp_path, config, 300)
    zero_rows(tmp_path / "points.npy")
    with pytest.raises(FormatError, match=r"points\.npy: is damaged, and the points .* are others"):
        segment_planes([], config, store=TileStore(tmp_path))
    segment(wall(400), tmp_path, config, 300)
    segment_planes([], config, store=TileStore(tmp_path))


def test_a_record_that_is_damaged_is_one_line_or_made_again(tmp_path):
    points, config = wall(600), settings("classic")
    whole = segment_planes(Cloud(points).points, config)
    rng, ends = np.random.default_rng(1), Counter()
    segment(points, tmp_path, config, 300)
    record = (tmp_path / "tiles.json").read_bytes()
    for place in rng.integers(0, len(record), 40):
        for damaged in (
            record[:place] + bytes([record[place] ^ 1]) + record[place + 1 :],
            record[:place],
            record[:place] + bytes(len(record) - place),
        ):
            (tmp_path / "tiles.json").write_bytes(damaged)
            try:
                assert_same(segment(points, tmp_path, config, 300), whole)
            except FormatError as error:
                ends[re.sub(r".*: (is in the way|line).*", r"\1", str(error), flags=re.DOTALL)] += 1
    assert set(ends) == {"is in the way", "line"}


def test_an_array_that_is_lost_during_the_work_is_one_line(tmp_path):
    points, config = wall(600), settings("classic")
    for stage, at, name in (
        ("normals", 0, "neighbors"),
        ("normals", 1, "normals"),
        ("edges", 0, "cloud"),
        ("regions", 0, "roots"),
    ):

        def lose(begun, number, of, *, stage=stage, at=at, name=name):
            if (begun, number) == (stage, at):
                os.truncate(tmp_path / stage / f"{name}.npy", 100)

        message = rf"{name}\.npy: is damaged: .*; run the same again, or remove .*{stage} and begin"
        with pytest.raises(FormatError, match=message):
            segment(points, tmp_path / stage, config, 300, on_stage=lose)
        TileStore(tmp_path / stage).remove_all()


def test_what_others_have_put_among_the_arrays_stays(tmp_path):
    points, config = wall(600), settings("classic")
    begun(points, tmp_path, config, "growth")
    (tmp_path / "theirs.npy").write_text("theirs")
    (tmp_path / "labels.npy").symlink_to(tmp_path / "theirs.npy")
    with pytest.raises(FormatError, match=r"labels\.npy: is in the way, this work has not made it"):
        segment(points, tmp_path, config, 300)
    (tmp_path / "labels.npy").unlink()
    segment(points, tmp_path, config, 300)
    (tmp_path / "normals.npy").unlink()
    (tmp_path / "normals.npy").symlink_to(tmp_path / "theirs.npy")
    TileStore(tmp_path).remove_all()
    assert {path.name for path in tmp_path.iterdir()} == {"theirs.npy", "normals.npy"}
    assert (tmp_path / "theirs.npy").read_text() == "theirs"


def test_a_folder_that_holds_something_else_is_refused(tmp_path):
    points, config = wall(300), settings("classic")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match=r"link: expected a directory, got a symbolic link"):
        segment(points, tmp_path / "link", config, 100)
    with pytest.raises(FormatError, match="file: cannot be made: File exists"):
        segment(points, tmp_path / "file", config, 100)
    (tmp_path / "folder" / "notes.txt").write_text("theirs")
    with pytest.raises(FormatError, match=r"expected an empty directory .* with notes\.txt"):
        segment(points, tmp_path / "folder", config, 100)
    (tmp_path / "folder" / "tiles.json").write_text("theirs")
    with pytest.raises(FormatError, match=r"tiles\.json: is in the way, it is no record"):
        segment(points, tmp_path / "folder", config, 100)
    assert len(list((tmp_path / "folder").iterdir())) == 2


def test_work_of_other_settings_or_files_is_refused(tmp_path):
    points = wall(300)
    segment(points, tmp_path, settings("classic"), 100, identity={"file": "a"})
    for preset, file in (("classic", "b"), ("paper", "a")):
        with pytest.raises(FormatError, match="holds the work of another cloud"):
            segment(points, tmp_path, settings(preset), 100, identity={"file": file})


def test_a_full_disk_is_an_error_that_says_what_to_do(tmp_path, monkeypatch):
    files = TileStore(tmp_path / "a")
    files.begin()
    files.reserve("a.npy")
    with (
        pytest.raises(FormatError, match=r"a\.npy: cannot be written: No space left.*goes on"),
        files.opened("a.npy"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(FormatError, match=r"expected 0\.\d MB of free disk for the work, got 0\.0"):
        segment(wall(300), tmp_path / "b", settings("classic"), 100)


@pytest.mark.parametrize(
    ("noise", "most", "expected"), [(0.15, 20, 20), (0.1, 60, 23), (0.0, 60, 16)]
)
def test_noise_of_the_whole_cloud_decides_the_number_of_neighbors(noise, most, expected, tmp_path):
    points, config = difficult_room(2500), settings("consensus")
    points += noise * np.random.default_rng(5).normal(size=points.shape).astype(np.float32)
    normals = dataclasses.replace(config.normals, adaptive_k=most)
    config = dataclasses.replace(config, normals=normals)
    whole = segment_planes(Cloud(points).points, config)
    assert_same(segment(points, tmp_path, config, 900), whole)
    assert TileStore(tmp_path).known("width")["k"] == expected


def test_a_tile_has_points(tmp_path):
    with pytest.raises(ConfigError, match="expected tile_size >= 1, got 0"):
        segment(wall(300), tmp_path, settings("classic"), 0)


def noisy_cube(num_points):
    """Three faces of a cube in canonical order: exact in one half, where reach is not known."""
    rng = np.random.default_rng(6)
    points = rng.uniform(0, 1, (num_points, 3))
    points[np.arange(num_points), rng.integers(0, 3, num_points)] = 0
    points += 0.02 * rng.normal(size=points.shape) * (points[:, :1] > 0.5)
    cloud = torch.from_numpy(points.astype(np.float32))
    return cloud[finite_rows(cloud)]


@pytest.mark.parametrize(
    ("method", "scope"),
    [("pca", "local"), ("paper", "local"), ("consensus", "local"), ("consensus", "regional")],
)
def test_the_points_around_a_tile_decide_its_normals(method, scope):
    points, config = noisy_cube(4000), NormalsConfig(method=method, k=12, noise_scope=scope)
    neighbors = search_knn(points, 12)
    whole = ESTIMATORS[method](points, neighbors, config, 4000)
    steps = STEPS[method] + REGIONAL_STEPS * (scope == "regional")
    for start in range(0, 4000, 250):
        part = cut_part(neighbors.indices, slice(start, start + 10), steps)
        found = ESTIMATORS[method](points[part.rows], part.neighbors, config, 4000)
        for one, other in zip(found[:4], whole[:4], strict=True):
            assert torch.equal(one[part.own], other[start : start + 10])


@pytest.mark.parametrize("preset", ["paper", "consensus"])
def test_the_points_around_a_tile_decide_its_edges(preset, tmp_path):
    points, config = noisy_cube(700), settings(preset, k=12)

    def stop(stage, done, of):
        if stage == "regions":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        segment(points.numpy(), tmp_path, config, 30, on_stage=stop)
    neighbors = search_knn(points, 12)
    fit = ESTIMATORS[config.normals.method](points, neighbors, config.normals, 4000)
    cloud = checked_cloud(config.growing, points, *fit[:2], neighbors, fit.valid, fit.residual_rms)
    roots = grow(cloud, config.growing, 4000)
    assert len(np.unique(roots)) > 20
    np.testing.assert_array_equal(TileStore(tmp_path).get("roots"), roots)
    if cloud.reach is not None:
        assert bool(cloud.reach.isinf().any() and cloud.reach.isfinite().any())
