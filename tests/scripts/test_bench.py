"""Each benchmark runs on little, and the harness keeps what it has measured."""

import ast
import contextlib
import json
import platform
import stat
import sys
from dataclasses import dataclass
from pathlib import Path

import bench
import numpy as np
import pytest
import torch
from benchmarks import (
    accuracy,
    breakdown,
    convert,
    harness,
    peers,
    robust,
    steady,
    superpoints,
)

from torchrg.scenes import make_room

pytestmark = pytest.mark.usefixtures("set_threads")
"""Benchmarks set their own."""


@dataclass(frozen=True)
class Counting(harness.Benchmark):
    """Two clouds, and two contenders of which one is meant for the first cloud alone."""

    made: list = ()

    def clouds(self):
        return {"small": lambda: 1, "large": lambda: 10}

    def contenders(self):
        def run(name, cloud):
            self.made.append((name, cloud))
            return {"seconds": cloud * len(self.made), "by": name}

        return {
            "a": lambda cloud: run("a", cloud),
            "b": lambda cloud: run("b", cloud) if cloud == 1 else None,
        }


def test_contenders_take_turns_and_what_is_known_is_not_measured_again(tmp_path):
    out, made = tmp_path / "figures" / "found.json", []
    results, is_complete = harness.measure(Counting(rounds=2, out=out, made=made))
    assert is_complete
    assert made == [("a", 1), ("b", 1), ("a", 1), ("b", 1), ("a", 10), ("a", 10)]
    assert json.loads(out.read_text())["results"] == results
    more, _ = harness.measure(Counting(rounds=3, out=out, made=made))
    assert made[6:] == [("a", 1), ("b", 1), ("a", 10)]
    assert more["large"]["a"][:2] == results["large"]["a"]
    assert list(more["large"]) == ["a"]


def test_time_that_is_up_ends_between_two_runs(tmp_path):
    made = []
    results, is_complete = harness.measure(Counting(minutes=-1, made=made))
    assert not is_complete
    assert not made
    assert not any(results.values())


def test_unknown_contenders_are_refused():
    with pytest.raises(SystemExit, match="expected --only among a, b, got c"):
        harness.measure(Counting(only=("c", "a"), made=[]))


def test_figures_are_medians_and_ratios_are_those_within_a_round():
    mine = [{"s": 2.0, "by": {"x": 1}}, {"s": 30.0, "by": {"x": 5}}, {"s": 4.0, "by": {"x": 3}}]
    others = [{"s": 1.0}, {"s": 10.0}, {"s": 8.0}]
    assert harness.medians(mine) == {"s": 4.0, "by": {"x": 3}}
    assert harness.ratio(mine, others, "s") == 2.0
    assert harness.ratio(mine, [], "s") is None
    text = harness.table({"room": {"a": mine}})
    assert text.splitlines() == [
        "| cloud | by | s | by |",
        "|" + " --- |" * 4,
        "| room | a | 4 | x 3 |",
    ]


def test_every_benchmark_is_listed_by_its_title(capsys):
    assert bench.main([]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in shown] == bench.NAMES
    assert bench.main(["nothing"]) == 2
    for name in bench.NAMES:
        source = (bench.FOLDER / f"{name}.py").read_text()
        assert f"scripts/bench.py {name}" in ast.get_docstring(ast.parse(source))


def run(case):
    """Return the figures of a case, and its tables."""
    results, is_complete = harness.measure(case)
    assert is_complete
    return results, case.report(results)


def test_accuracy_scores_clouds_and_images():
    results, text = run(accuracy.Case(scale=0.004, only=("classic", "depth")))
    assert [len(by) for by in results.values()] == [1] * 7 + [2] * 2
    (room,) = results["room, 3 mm"]["classic"]
    scene = make_room(1200, noise=0.003, seed=0)
    assert room["faces"] == (scene.labels.bincount() >= 1).sum()
    assert results["4 frames, exact"]["depth"][0]["mean_best_iou"] > 0.2
    assert "| RSPD |" in text


OWN = """
import torchrg

def estimate(points):
    fit = torchrg.estimate_normals(points, "classic")
    return fit.normals, fit.curvature

def estimate_one(points):
    return points[0], points[:, 0]

def only_normals(points):
    return points
"""


def test_an_estimator_of_ones_own_is_scored_as_ours(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_estimator.py").write_text(OWN)
    only = {"scale": 0.004, "only": ("classic", "own")}
    results, _ = run(accuracy.Case(**only, estimator="own_estimator:estimate"))
    assert all(by["own"] == by["classic"] for by in results.values())
    case = accuracy.Case(**only, estimator="own_estimator:estimate_one")
    with pytest.raises(SystemExit, match=r"expected normals \(1200, 3\) .* got \(3,\) and"):
        harness.measure(case)
    case = accuracy.Case(**only, estimator="own_estimator:only_normals")
    with pytest.raises(
        SystemExit, match=r"from own_estimator:only_normals, got \(1200, 3\); return"
    ):
        harness.measure(case)
    with pytest.raises(SystemExit, match="got own_estimator; add the function, as in own_esti"):
        accuracy.Case(estimator="own_estimator").contenders()
    with pytest.raises(SystemExit, match="expected module:function, got own_estimator:nothing"):
        accuracy.Case(estimator="own_estimator:nothing").contenders()


def test_breakdown_is_that_of_contaminated_neighborhoods():
    results, text = run(breakdown.Case(patches=20, only=("PCA", "planes")))
    assert results["cluster 30%"]["PCA"][0]["median"] > 10
    assert results["cluster 30%"]["planes"][0]["p90"] < 3
    assert text.splitlines()[2] == "| outliers | PCA | planes |"


def test_robust_estimators_are_timed_on_shares_of_the_neighborhoods():
    names = ("Qn, a row of 50", "DetS", "MVE, 500 starts")
    results, _ = run(robust.Case(patches=100, rounds=1, only=names))
    counts = [by[name][0]["of"] for by in results.values() for name in names]
    assert counts == [300, 10, 1, 75, 2, 1, 75, 2, 1]


def test_superpoints_are_scored_at_the_numbers_of_others(tmp_path):
    peer = tmp_path / "halves.py"
    peer.write_text(
        "import numpy as np\n"
        "def partition(points, strength):\n"
        "    return (np.arange(len(points)) % round(1 / strength)), strength\n"
    )
    case = superpoints.Case(points=2000, made=("pieces",), peer=peer, peer_python=sys.executable)
    results, text = run(case)
    (by,) = results.values()
    assert list(by) == ["torchrg", "torchrg, voxels first", "cut pursuit"]
    assert [row["count"] for row in by["cut pursuit"][0]["levels"]] == [200, 100, 50, 20, 10, 5]
    assert by["cut pursuit"][0]["seconds"] == list(superpoints.PEER_STRENGTHS)
    assert len(by["torchrg"][0]["levels"]) == len(superpoints.STRENGTHS)
    assert "(cut pursuit 0." in text


@pytest.fixture
def programs(tmp_path):
    """Stand-ins for the programs, which print what these do."""
    folder = tmp_path / "programs"
    folder.mkdir()
    for name, text in {
        "pclrg": "n=5 normals 1.500 s, region growing 2.250 s, clusters 3, sigma_th 0.1",
        "cgaln": "pca 0.250 s\\njet 0.500 s",
    }.items():
        (folder / name).write_text(f"#!/bin/sh\nprintf '{text}\\n'\n")
        (folder / name).chmod((folder / name).stat().st_mode | stat.S_IXUSR)
    return folder


def test_programs_are_read_and_compared_like_to_like(programs):
    case = peers.Case(programs=programs, sizes=(10,), only=("pclrg", "cgaln"))
    clouds = {"room": lambda: contextlib.nullcontext(programs)}
    object.__setattr__(case, "clouds", lambda: clouds)
    results, text = run(case)
    by = results["room"]
    assert by["pclrg"][0]["seconds"] == {"normals": 1.5, "regions": 2.25}
    assert by["cgaln"][0]["total"] == 0.75
    results["room"]["torchrg-classic"] = [{**row, "total": 7.5} for row in by["pclrg"]]
    last = case.report(results).splitlines()[-1]
    assert last.startswith("| room | torchrg-classic | 7.5 |")
    assert last.endswith("| 2 |  |")
    assert text.count("\n") == 3


def test_libraries_are_timed_by_stage(tmp_path):
    peers.write_cloud("room 1500 sorted", str(tmp_path))
    points = np.load(tmp_path / "cloud.npy")
    assert np.array_equal(np.fromfile(tmp_path / "cloud.f32", np.float32).reshape(-1, 3), points)
    assert len(points) == 1500
    file = str(tmp_path / "cloud.npy")
    stages = peers.prepare("preset classic", file)()["stages"]
    assert list(stages) == ["neighbors", "normals", "regions", "planes", "orientation"]
    assert list(peers.prepare("normals", file)()["stages"]) == ["normals"]


def test_frames_and_rooms_are_prepared():
    assert steady.prepare("classic", 1500)() is None
    assert set(steady.Case().clouds()) >= {"depth", "depth-large", "consensus, 200,000 points"}


def test_runs_that_wrote_other_bytes_are_an_error():
    results = {"rooms": {"1": [{"sha256": "a"}], "2": [{"sha256": "b"}]}}
    with pytest.raises(SystemExit, match="DIFFERENT BYTES"):
        convert.Case().report(results)


def test_surroundings_name_the_commit():
    import surroundings

    found = surroundings.describe(3)
    assert found["threads"] == 3
    assert torch.__version__.startswith(found["torch"])  # Without the build, as in 2.4.0+cpu.
    assert Path(surroundings.__file__).name == "surroundings.py"
    assert f"| {platform.python_version()} |" in surroundings.oldest_and_here().splitlines()[2]
