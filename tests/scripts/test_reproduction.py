"""Reproduction of the paper: small runs, resumed runs, claims and kept results."""

import html
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrg import load_config, segment_planes
from torchrg.scenes import make_room
from torchrg.structures import Neighbors

SCRIPTS = Path(__file__).parents[2] / "scripts"
VARIANTS = ("pca", "irls", "jet", "detmm", "paper", "libra", "consensus")
METHODS = ("classic", "classic_increment", "detmm", "algorithm2", "paper", "consensus")

pytest.importorskip("matplotlib").use("agg")


@pytest.fixture(autouse=True)
def _scripts_on_the_path(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)


@pytest.fixture
def normals(monkeypatch):
    """The part ``normals`` with a grid that takes seconds."""
    from reproduction import normals

    small = (
        normals.Grid(60, ("cuboid", "dodecahedron"), (0.25,), (0,), VARIANTS),
        normals.Grid(60, ("octahedron",), (0.25,), (0,), VARIANTS),
    )
    monkeypatch.setattr(normals, "QUICK", small)
    monkeypatch.setattr(normals, "_DRAWN_POINTS", 500)
    monkeypatch.setattr(normals, "_warm_up", lambda variant: None)
    monkeypatch.setattr(normals, "_WIDTH", 60)
    return normals


@pytest.fixture
def small(monkeypatch):
    """Small clouds and images."""
    from reproduction import clouds, pictures, study

    room = make_room(600)
    synthetic = {key: (lambda quick: room, "a small room") for key in clouds.SYNTHETIC}
    monkeypatch.setattr(clouds, "SYNTHETIC", synthetic)
    for table, keys in (
        (clouds.OTHERS, clouds.OTHERS),
        (clouds.HARD, set(clouds.HARD) - {"curved"}),
    ):
        for key in tuple(keys):
            monkeypatch.delitem(table, key)
    monkeypatch.setattr(pictures, "_WIDTH", 60)
    monkeypatch.setattr(clouds, "_WARM_UP", 50)
    monkeypatch.setattr(study, "ANGLES_DEG", (2.0, 5.0, 8.0))
    return clouds


@pytest.fixture
def run(small, tmp_path):
    from reproduction.clouds import Run
    from reproduction.records import Folder

    return Run(Folder(tmp_path), quick=True)


def call_script(monkeypatch, *arguments):
    import reproduce_paper

    monkeypatch.setattr(sys, "argv", ["reproduce_paper.py", *map(str, arguments)])
    reproduce_paper.main()


def test_growth_from_kept_normals_gives_the_labels_of_the_pipeline(run):
    from reproduction.evaluation import read_segmented, regrow

    method = "consensus"
    limits = load_config(method).growing
    angle, quantile = limits.max_angle_deg, limits.curvature_quantile
    kept = read_segmented(run, "hallway", method).labels
    points = run.cloud("hallway").cloud.points
    turned = segment_planes(points, load_config(method).with_angle(8.0)).labels
    assert torch.equal(regrow(run, "hallway", method, 8.0, quantile), turned)
    # Another angle by less than rounding: grown again instead of read.
    assert torch.equal(regrow(run, "hallway", method, angle + 1e-12, quantile), kept)
    assert not torch.equal(regrow(run, "hallway", method, 0.5, quantile), kept)


def test_part_alone_makes_a_report_of_itself(small, tmp_path, monkeypatch):
    call_script(monkeypatch, "--out", tmp_path, "--quick", "method")
    report = json.loads((tmp_path / "quick" / "report.json").read_text())
    assert list(report["parts"]) == ["method"]
    assert "Figure 5" in (tmp_path / "quick" / "report.html").read_text()


@pytest.mark.slow
def test_one_call_makes_the_whole_report(small, normals, tmp_path, monkeypatch):
    call_script(monkeypatch, "--out", tmp_path, "--quick")
    folder = tmp_path / "quick"
    report = json.loads((folder / "report.json").read_text())
    assert list(report["parts"]) == ["method", "normals", "study", "segmentation", "times"]
    page = (folder / "report.html").read_text()
    for number in ("Table 1", "Table 2", "Table 3", *(f"Figure {n}" for n in range(1, 10))):
        assert number in page
    files = set(re.findall(r"src='([^']*)'", page))
    assert len(files) >= 14
    for file in files:
        assert (folder / file).read_bytes().startswith(b"\x89PNG"), file
    kept = {claim["text"] for claim in kept_results()["claims"]}
    for claim in report["claims"]:
        assert f"<td>{html.escape(claim['text'], quote=False)}</td>" in page.replace("&#39;", "'")
        assert claim["text"] in kept, claim["text"]
        assert claim["fails"] or not claim["why"], claim["text"]
    assert sum(bool(claim["numbers"]) for claim in report["claims"]) >= 24
    assert page.count("<b>another</b>") == 4

    # A second call computes nothing again, and one that was interrupted goes on.
    def refuse(*arguments, **settings):
        raise AssertionError("computed twice")

    from reproduction import evaluation

    monkeypatch.setattr(normals, "_measure", refuse)
    for name in ("segment_planes", "score_labels", "score_clusters", "evaluate_surfaces"):
        monkeypatch.setattr(evaluation, name, refuse)
    call_script(monkeypatch, "--out", tmp_path, "--quick", "normals", "segmentation", "times")
    assert json.loads((folder / "report.json").read_text()) == report


@pytest.mark.slow
def test_an_estimator_of_ones_own_is_in_the_tables(normals, tmp_path, monkeypatch):
    from reproduction.clouds import Run
    from reproduction.records import Folder

    (tmp_path / "their_pca.py").write_text(
        "import torchrg\n\ndef estimate(points):\n"
        "    fit = torchrg.estimate_normals(points, method='pca', k=50)\n"
        "    return fit.normals, fit.curvature\n"
    )
    monkeypatch.chdir(tmp_path)
    run = Run(Folder(tmp_path), quick=True, estimator="their_pca:estimate")
    records = normals.reproduce(run)["records"]
    theirs = [record["score"] for record in normals.where(records, variant=run.estimator)]
    assert theirs == [record["score"] for record in normals.where(records, variant="pca")]


def test_results_of_another_commit_or_without_their_file_are_computed_again(run, monkeypatch):
    from reproduction import records

    made, target = [], run.folder.path_of("image.png")

    def work():
        made.append(1)
        target.write_text("x")
        return {}

    for commit in ("a", "a", "b"):
        monkeypatch.setattr(records, "made_with", lambda commit=commit: {"commit": commit})
        run.folder.cell("a", work, needs=target)
    assert len(made) == 2
    target.unlink()
    run.folder.cell("a", work, needs=target)
    assert len(made) == 3


def test_file_of_the_paper_is_used_where_it_is_given(small, tmp_path):
    from reproduction.clouds import load_cloud

    points = np.random.default_rng(0).normal(size=(500, 3))
    points[3] = np.nan
    np.savez(tmp_path / "hall.npz", points=points, labels=np.arange(500))
    cloud = load_cloud("hallway", tmp_path / "hall.npz", quick=False)
    assert (len(cloud.points), cloud.is_papers) == (499, True)
    assert cloud.labels.tolist() == [*range(3), *range(4, 500)]
    assert load_cloud("hallway", None, quick=True).name != cloud.name


def test_surfaces_are_evaluated_by_size_and_at_edges():
    from reproduction.clouds import EvalCloud, find_edges
    from reproduction.evaluation import evaluate_surfaces

    truth = torch.tensor([0] * 2000 + [1] * 1000 + [2] * 10 + [3] * 10)
    labels = truth.clone()
    labels[:1000] = -1  # half of the first face
    labels[2000:2500] = 9  # and of the second
    labels[3000:3010] = 0  # all of the third goes to the first
    cloud = EvalCloud("", "", torch.zeros(3020, 3), truth, None, "", curved=torch.tensor([1]))
    at_edges = torch.zeros(3020, dtype=torch.bool)
    at_edges[[0, 1500, 2999, 3005]] = True
    scores = evaluate_surfaces(labels, cloud, at_edges)
    precision = (100 * 1000 / 1010 + 100) / 2
    assert scores["f1_large"] == pytest.approx(2 * precision * 50 / (precision + 50))
    assert (scores["found_large"], scores["found_small"]) == (0, 0.5)
    assert (scores["right_at_edges"], scores["none_at_edges"]) == (0.5, 0.25)
    truth = torch.tensor([0, 0, 1, -1])
    neighbors = Neighbors(torch.tensor([[0, 1], [1, 2], [2, 3], [3, 0]]))
    assert find_edges(truth, neighbors).tolist() == [False, True, False, False]


def test_claims_hold_only_where_the_numbers_say_so():
    from reproduction.records import claim, mark_best, rising, verdict

    found = {"a": rising([0.1, 0.2, 0.3], ".1f"), "b": rising([0.1, 0.3, 0.2], ".1f")}
    made = claim("IV", "It rises.", {**found, "c": rising([0.1, None], ".1f")})
    assert (made["holds"], made["fails"]) == (["a"], ["b"])
    assert made["numbers"] == {"a": "0.1 < 0.2 < 0.3", "b": "0.1, 0.3, 0.2"}
    assert verdict(made) == "holds on 1 of 2: a"
    assert mark_best([3.0, 1.0, None], ".1f", higher=True) == ["**3.0**", "1.0", "-"]
    assert mark_best([3.0, 1.0], ".1f", higher=False) == ["3.0", "**1.0**"]
    assert mark_best([3.0, 3.0], ".1f", higher=True) == ["3.0", "3.0"]


def test_reasons_are_computed_from_the_places_where_a_claim_fails():
    from reproduction.records import claim

    def why(fails):
        return f"It falls on {', '.join(fails)}."

    mixed = claim("IV", "It rises.", {"a": (True, "1"), "b": (False, "2")}, why=why)
    assert mixed["why"] == "It falls on b."
    assert claim("IV", "It rises.", {"a": (True, "1")}, why=why)["why"] == ""


@pytest.mark.parametrize("found", [{}, {"a": None}])
def test_claims_tried_on_nothing_are_not_tried(found):
    from reproduction.records import claim, verdict
    from reproduction.report import to_html, to_markdown

    made = claim("IV", "It rises.", found, why=lambda fails: "A reason.")
    assert verdict(made) == "not tried"
    report = {"title": "", "intro": "", "made_with": "", "parts": {}, "claims": [made]}
    assert "<td class=note><b>not tried</b></td>" in to_html(report)
    page = to_markdown({"scores": [], "claims": [made]})
    assert "IV: **not tried**." in page
    assert "tried on" not in page
    assert "A reason" not in page


def kept_results():
    from reproduction.report import RESULTS

    return json.loads(RESULTS.read_text(encoding="utf-8"))


def test_kept_results_give_reasons_only_for_failures():
    for claim in kept_results()["claims"]:
        assert set(claim["numbers"]) == {*claim["holds"], *claim["fails"]}
        assert claim["fails"] or not claim["why"], claim["text"]


def test_kept_reasons_are_those_of_the_kept_numbers():
    from reproduction.evaluation import PAPERS
    from reproduction.normals import why_not_below
    from reproduction.segmentation import LABELED, listed, printed_best

    kept = kept_results()
    labeled = {}
    for score in kept["scores"]:
        labeled.setdefault(score["title"], {})[score["method"]] = score["fraction_labeled"]
    labeled = {title: [by[method] for method in PAPERS] for title, by in labeled.items()}
    seen = 0
    for claim in kept["claims"]:
        if "MSAE than" in claim["text"] or "mean angle than" in claim["text"]:
            means = {
                place: {name: float(mean) for name, mean in map(str.split, words.split(", "))}
                for place, words in claim["numbers"].items()
            }
            assert claim["why"] == why_not_below(means, claim["fails"])
            seen += 1
        elif claim["why"].startswith("Fraction labeled: "):
            assert claim["why"] == listed("Fraction labeled", labeled, LABELED.form, claim["fails"])
            seen += 1
        elif claim["where"] == "IV, Table 2":
            assert claim == printed_best()
            seen += 1
    assert seen == 11


def test_normals_hold_only_if_they_do_for_every_seed():
    from reproduction.normals import normal_claims

    names = ("pca", "jet", "irls", "detmm", "libra", "paper")

    def measured(seed, paper):
        return [
            {
                "shape": "cuboid",
                "noise_percent": 0.25,
                "num_points": 9,
                "seed": seed,
                "variant": name,
                "seconds": 1.0,
                "score": {"msae": value, "mean": value},
            }
            for name, value in zip(names, (100.0, 110.0, 80.0, 70.0, 90.0, paper), strict=True)
        ]

    good = normal_claims([*measured(0, 90.0), *measured(1, 75.0)], with_times=False)
    assert good[0]["holds"]
    assert "paper 82.5" in good[0]["numbers"]["cuboid 0.25 %"]
    bad = normal_claims([*measured(0, 101.0), *measured(1, 60.0)], with_times=False)
    assert bad[0]["fails"]


def test_results_of_code_that_is_not_committed_are_refused(monkeypatch):
    from reproduction import report as module

    monkeypatch.setattr(module, "atomic_path", lambda path: pytest.fail("written"))
    for commit in ("2f26e94-dirty", "unknown", "2f26e94, ad1e777"):
        report = {"quick": False, "made_with": f"torchrg 0.1.0; commit {commit}; python 3"}
        with pytest.raises(ValueError, match=f"expected a report of one commit, got {commit}"):
            module.keep(report)


def test_full_report_of_a_tree_with_changes_is_refused(tmp_path, monkeypatch):
    import reproduce_paper

    monkeypatch.setattr(reproduce_paper, "made_with", lambda: {"commit": "2f26e94-dirty"})
    with pytest.raises(SystemExit, match=r"expected committed code .* got commit 2f26e94-dirty"):
        call_script(monkeypatch, "--out", tmp_path, "times")
    assert not list(tmp_path.iterdir())


def test_only_reports_with_scores_are_kept():
    from reproduction.report import take_results

    with pytest.raises(ValueError, match="expected the part segmentation"):
        take_results({"parts": {"normals": {}}})
