"""The script that makes the paper's tables and figures again: small, resumed, complete."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrg.scenes import make_room

SCRIPTS = Path(__file__).parents[1] / "scripts"
VARIANTS = ("pca", "irls", "jet", "detmm", "paper", "consensus")

pytest.importorskip("matplotlib").use("agg")


@pytest.fixture(autouse=True)
def _scripts_on_the_path(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)


@pytest.fixture
def normals(monkeypatch):
    """The part ``normals`` with a grid that takes seconds."""
    from reproduction import normal_figures, normals

    small = (normals.Grid(60, ("cuboid", "dodecahedron"), (0.25,), VARIANTS),)
    monkeypatch.setattr(normals, "QUICK", small)
    monkeypatch.setattr(normals, "_DRAWN_POINTS", 500)
    monkeypatch.setattr(normals, "_warm_up", lambda variant: None)
    monkeypatch.setattr(normal_figures, "_WIDTH", 60)
    return normals


@pytest.fixture
def small(monkeypatch, normals):
    """Everything small: clouds of a thousand points, pictures of some pixels."""
    from reproduction import clouds, pictures, runs, study

    room = make_room(600)
    made = {key: (lambda: room, "a small room") for key in clouds.TITLES}
    monkeypatch.setattr(clouds, "_QUICK", made)
    monkeypatch.setattr(pictures, "_WIDTH", 60)
    monkeypatch.setattr(runs, "_WARM_UP", 50)
    monkeypatch.setattr(study, "ANGLES_DEG", (2.0, 5.0, 8.0))
    return clouds


@pytest.fixture
def run(small, tmp_path):
    from reproduction.cells import Folder
    from reproduction.runs import Run

    return Run(Folder(tmp_path), quick=True)


def call_script(monkeypatch, *arguments):
    import reproduce_paper

    monkeypatch.setattr(sys, "argv", ["reproduce_paper.py", *map(str, arguments)])
    reproduce_paper.main()


def test_one_call_makes_the_whole_report(small, tmp_path, monkeypatch, capsys):
    from reproduction import readme

    call_script(monkeypatch, "--out", tmp_path, "--quick")
    folder = tmp_path / "quick"
    report = json.loads((folder / "report.json").read_text())
    names = ["normals", "criteria", "study", "segmentation", "large", "times"]
    assert list(report["parts"]) == names
    page, text = (folder / "report.html").read_text(), (folder / "report.md").read_text()
    for number in ("Table 1", "Table 2", "Table 3", *(f"Figure {n}" for n in (3, 4, 5, 7, 8, 9))):
        assert number in page
        assert number in text
    files = set(re.findall(r"src='([^']*)'", page))
    assert len(files) >= 14
    assert files == set(re.findall(r"!\[[^]]*\]\(([^)]*)\)", text))
    for file in files:
        assert (folder / file).read_bytes().startswith(b"\x89PNG"), file
    assert "printed: proposed" in page
    assert "9.84 min" in page
    assert page.count("<b>another</b>") == 4
    assert {"commit", "torch", "processor", "threads"} <= {
        word.split()[0] for word in report["made_with"].split("; ")
    }
    # The README's section can be made from it.
    section = readme.to_section(readme.take_results(report))
    assert "small clouds" in section
    assert section.count("\n| ---") == 1
    full = readme.take_results({**report, "quick": False})
    assert "times faster than published" in readme.to_section(full)
    shown = capsys.readouterr().out
    assert all(f"== {name}: " in shown for name in names)

    # A second call computes nothing again.
    def refuse(*arguments, **settings):
        raise AssertionError("computed twice")

    from reproduction import normals, segmentations

    monkeypatch.setattr(normals, "_measure", refuse)
    for name in ("segment_planes", "score_labels", "score_clusters", "score_normals"):
        monkeypatch.setattr(segmentations, name, refuse)
    call_script(monkeypatch, "--out", tmp_path, "--quick", "normals", "segmentation", "times")
    assert json.loads((folder / "report.json").read_text()) == report


def test_part_alone_makes_a_report_of_itself(small, tmp_path, monkeypatch):
    call_script(monkeypatch, "--out", tmp_path, "--quick", "criteria")
    report = json.loads((tmp_path / "quick" / "report.json").read_text())
    assert list(report["parts"]) == ["criteria"]
    assert "Figure 5" in (tmp_path / "quick" / "report.html").read_text()


def test_interrupted_run_goes_on_where_it_stopped(normals, run, monkeypatch):
    grid = normals.Grid(60, ("cuboid", "dodecahedron"), (0.0, 0.25), ("pca", "paper"))
    monkeypatch.setattr(normals, "QUICK", (grid,))
    monkeypatch.setattr(normals, "_blocks", lambda run, records: [])
    measured = []
    measure = normals._measure

    def interrupted(*cell):
        if len(measured) == 5:
            raise KeyboardInterrupt
        measured.append(cell)
        return measure(*cell)

    monkeypatch.setattr(normals, "_measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        normals.reproduce(run)
    assert len(list((run.folder.path / "cells").iterdir())) == 5
    monkeypatch.setattr(normals, "_measure", lambda *cell: measured.append(cell) or measure(*cell))
    normals.reproduce(run)
    assert len(measured) == len(set(measured)) == 2 * 2 * 2


def test_record_without_its_file_is_made_again(run):
    made = []
    target = run.folder.place("picture.png")

    def work():
        made.append(1)
        target.write_text("x")
        return {"value": 1}

    for _ in range(2):
        run.folder.cell("a", work, needs=target)
    assert len(made) == 1
    target.unlink()
    run.folder.cell("a", work, needs=target)
    assert len(made) == 2


def test_points_at_edges_are_those_whose_neighbors_lie_on_another_face(normals):
    scene = normals.make_shape("cuboid", 4000)
    at_edges = normals._near_edges(scene)
    near = normals.search_knn(scene.points, normals.K).indices.long()
    other = (scene.labels[near] != scene.labels[:, None]).any(dim=1)
    assert torch.equal(at_edges, other)


@pytest.mark.parametrize("preset", ["classic", "paper", "consensus"])
def test_growth_from_kept_normals_gives_the_labels_of_the_pipeline(run, preset):
    from reproduction.segmentations import read_segmented, regrow

    from torchrg import load_config

    limits = load_config(preset).growing
    angle, quantile = limits.max_angle_deg, limits.curvature_quantile
    kept = read_segmented(run, "hallway", preset).labels
    # Another angle by less than rounding: grown again instead of read.
    assert torch.equal(regrow(run, "hallway", preset, angle + 1e-12, quantile), kept)
    assert not torch.equal(regrow(run, "hallway", preset, 0.01, quantile), kept)


def test_outcome_of_each_point():
    from torchrg.render.outcomes import outcomes_of

    truth = torch.tensor([7, 7, 7, 7, 7, 7, 7, 3, 3, 5, 5, -1])
    labels = torch.tensor([0, 0, 0, 0, 2, 2, -1, 0, 0, 4, 4, 4])
    right, part, other, none = range(4)
    expected = [right] * 4 + [part] * 2 + [none] + [other] * 2 + [right] * 2 + [other]
    assert outcomes_of(labels, truth).tolist() == expected
    assert outcomes_of(torch.full((4,), -1), truth[:4]).tolist() == [none] * 4


def test_file_of_the_paper_is_used_where_it_is_given(small, tmp_path):
    from reproduction.clouds import load_cloud

    points = np.random.default_rng(0).normal(size=(500, 3))
    points[3] = np.nan
    colors = np.full((500, 3), 7, dtype=np.uint8)
    np.savez(tmp_path / "hall.npz", points=points, labels=np.arange(500), color=colors)
    cloud = load_cloud("hallway", tmp_path / "hall.npz", quick=False)
    assert (len(cloud.points), cloud.is_papers) == (499, True)
    assert cloud.labels.tolist() == [*range(3), *range(4, 500)]
    assert torch.equal(cloud.colors, torch.full((499, 3), 7, dtype=torch.uint8))
    assert load_cloud("hallway", None, quick=True).name != cloud.name


def test_quick_run_takes_the_middle_of_a_file(small, tmp_path, monkeypatch):
    from reproduction.clouds import load_cloud

    monkeypatch.setattr(small, "QUICK_POINTS", 100)
    points = np.random.default_rng(0).normal(size=(500, 3))
    np.savez(tmp_path / "hall.npz", points=points)
    cloud = load_cloud("hallway", tmp_path / "hall.npz", quick=True)
    middle = np.median(points, axis=0)
    reached = np.linalg.norm(cloud.points.numpy() - middle, axis=1).max()
    assert len(cloud.points) == 100
    # torch's median of an even number is the lower of two, hence not exactly the hundredth.
    assert reached <= np.sort(np.linalg.norm(points - middle, axis=1))[105]


def scored(f1, recall):
    """Records of the five methods with such scores."""
    rest = {"pairs": 6, "faces": 26, "recall_iou50": 0.2}
    names = ("classic", "detmm", "paper", "paper@0.5", "consensus")
    return {
        name: {"labels": {"f1": a, "recall": b, **rest}}
        for name, a, b in zip(names, f1, recall, strict=True)
    }


def test_trends_hold_only_where_the_numbers_say_so():
    from reproduction.trends import trend_claims

    classic = {"faces": {"0": [80.0, 5000], "1": [60.0, 100], "2": [10.0, 2000]}}
    others = {"faces": {"0": [90.0, 5000], "1": [20.0, 100], "3": [10.0, 2000]}}
    faces = {"classic": classic, "paper": others, "paper@0.5": others, "consensus": others}
    good = trend_claims(scored((60, 80, 95, 70, 97), (80, 85, 90, 81, 95)), faces, "a hall")
    assert [claim["holds"] for claim in good] == [True, True, True, True]
    bad = trend_claims(scored((60, 97, 95, 98, 97), (90, 85, 90, 91, 95)), faces, "a hall")
    assert [claim["holds"] for claim in bad] == [False, False, True, True]
    assert "It does where half" in bad[0]["why"]
    assert "Nor does it where half" in good[0]["why"]
    assert "classic RG 60.0, DetMM 97.0, paper 95.0" in bad[0]["numbers"]
    assert "of 26 faces" in bad[0]["why"]
    assert "90.0 against 80.0 on 1 faces of 1,000 points and more" in bad[1]["why"]
    assert "20.0 against 60.0 on 1 faces of fewer" in bad[1]["why"]


def test_ratio_is_the_papers_time_over_ours_per_point():
    from reproduction.times import ratio, speed_claim

    record = {"cloud": "cory", "preset": "paper", "points": 1_097_901, "total": 9.84}
    assert ratio(record) == pytest.approx(60)
    assert speed_claim([record])["holds"]
    half = {**record, "points": 1_097_901 / 2}
    assert ratio(half) == pytest.approx(30)
    assert not speed_claim([{**half, "points": 548_950}])["holds"]
    assert ratio({**record, "preset": "consensus"}) is None


def test_best_numbers_are_bold():
    from reproduction.sections import mark_best

    assert mark_best([3.0, 1.0, None, 3.0], ".1f", higher=True) == [
        "**3.0**",
        "1.0",
        "-",
        "**3.0**",
    ]
    assert mark_best([3.0, 1.0], ".1f", higher=False) == ["3.0", "**1.0**"]
    assert mark_best([3.0, 1.0], ".1f", higher=None) == ["3.0", "1.0"]
    assert mark_best([3.0, None], ".1f", higher=True) == ["3.0", "-"]
    assert mark_best([3.0, 3.0], ".1f", higher=True) == ["3.0", "3.0"]


def test_page_escapes_words_and_shows_failed_claims():
    from reproduction import sections
    from reproduction.rendering import to_html, to_markdown

    blocks = [
        sections.claim("F1 < 5", False, "F1: 6."),
        sections.table("", ["a", "b"], [["x & y", "**1**"]]),
    ]
    part = sections.section("Part", blocks, None)
    report = {"title": "T", "intro": "I", "made_with": "M", "parts": {"part": part}}
    page = to_html(report)
    assert "<td>x &amp; y</td><td><b>1</b></td>" in page
    assert "class='claim fails'><b>Does not come out:</b> F1 &lt; 5 F1: 6." in page
    assert "> **Does not come out:** F1 < 5 F1: 6." in to_markdown(report)


def test_results_in_the_readme_are_what_the_script_makes():
    from reproduction import readme

    text = readme.README.read_text(encoding="utf-8")
    results = json.loads(readme.RESULTS.read_text(encoding="utf-8"))
    assert readme.insert(text, results) == text
    assert f"{readme.BEGIN}\n{readme.to_section(results)}\n{readme.END}" in text


def test_results_are_those_of_clouds_with_truth():
    from reproduction import readme

    labels = {"faces": 3, "f1": 1.0, "recall_iou50": 1.0, "mean_best_iou": 1.0}
    with_truth = {"cloud": "cory", "preset": "paper", "labels": labels}
    time = {"cloud": "cory", "preset": "paper", "points": 9, "total": 2.0}
    parts = {
        "segmentation": {"records": [{"cloud": "tutorial", "preset": "paper"}], "blocks": []},
        "large": {"records": [with_truth, {"angles": {}}], "blocks": []},
        "times": {"records": [{**time, "stages": {}}], "blocks": []},
    }
    found = readme.take_results({"quick": False, "made_with": "", "parts": parts})
    assert [(record["cloud"], record["f1"]) for record in found["scores"]] == [("cory", 1.0)]
    assert found["times"] == [time]


def test_readme_is_updated_between_the_markers_only(tmp_path, monkeypatch):
    from reproduction import readme

    results = json.loads(readme.RESULTS.read_text(encoding="utf-8"))
    text = f"before\n{readme.BEGIN}\nold\n{readme.END}\nafter\n"
    made = readme.insert(text, results)
    assert made.startswith(f"before\n{readme.BEGIN}\nClouds with known truth")
    assert made.endswith(f"\n{readme.END}\nafter\n")
    assert "old" not in made
    with pytest.raises(ValueError, match="expected a README with"):
        readme.insert("no markers", results)
    with pytest.raises(ValueError, match=r"got none of .*'large'"):
        readme.take_results({"parts": {"normals": {}, "times": {}, "segmentation": {}}})
