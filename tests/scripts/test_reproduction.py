"""The script that makes the paper's tables and figures again: small, resumed, complete."""

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
    from reproduction import normal_figures, normals

    small = (
        normals.Grid(60, ("cuboid", "dodecahedron"), (0.25,), (0,), VARIANTS),
        normals.Grid(60, ("octahedron",), (0.25,), (0,), VARIANTS),
    )
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
    made = {key: (lambda quick: room, "a small room") for key in clouds.MADE}
    monkeypatch.setattr(clouds, "MADE", made)
    for table, keys in (
        (clouds.OTHERS, clouds.OTHERS),
        (clouds.HARD, set(clouds.HARD) - {"curved"}),
    ):
        for key in tuple(keys):
            monkeypatch.delitem(table, key)
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


@pytest.mark.slow
def test_one_call_makes_the_whole_report(small, tmp_path, monkeypatch, capsys):
    from reproduction import readme

    call_script(monkeypatch, "--out", tmp_path, "--quick")
    folder = tmp_path / "quick"
    report = json.loads((folder / "report.json").read_text())
    names = ["method", "normals", "study", "segmentation", "times"]
    assert list(report["parts"]) == names
    page = (folder / "report.html").read_text()
    for number in ("Table 1", "Table 2", "Table 3", *(f"Figure {n}" for n in range(1, 10))):
        assert number in page
    files = set(re.findall(r"src='([^']*)'", page))
    assert len(files) >= 14
    for file in files:
        assert (folder / file).read_bytes().startswith(b"\x89PNG"), file
    assert "printed: classic_increment" in page
    for claim in report["claims"]:
        assert f"<td>{html.escape(claim['text'], quote=False)}</td>" in page.replace("&#39;", "'")
        assert claim["numbers"] or "1,000" in claim["text"], claim["text"]
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
    assert "full size" in readme.to_section(full)
    assert full["claims"] == report["claims"]
    shown = capsys.readouterr().out
    assert all(f"== {name}: " in shown for name in names)

    # A second call computes nothing again.
    def refuse(*arguments, **settings):
        raise AssertionError("computed twice")

    from reproduction import normals, segmentations

    monkeypatch.setattr(normals, "_measure", refuse)
    for name in ("segment_planes", "score_labels", "score_clusters", "score_faces"):
        monkeypatch.setattr(segmentations, name, refuse)
    call_script(monkeypatch, "--out", tmp_path, "--quick", "normals", "segmentation", "times")
    assert json.loads((folder / "report.json").read_text()) == report


def test_part_alone_makes_a_report_of_itself(small, tmp_path, monkeypatch):
    call_script(monkeypatch, "--out", tmp_path, "--quick", "method")
    report = json.loads((tmp_path / "quick" / "report.json").read_text())
    assert list(report["parts"]) == ["method"]
    assert "Figure 5" in (tmp_path / "quick" / "report.html").read_text()


def test_interrupted_run_goes_on_where_it_stopped(normals, run, monkeypatch):
    grid = normals.Grid(60, ("cuboid", "dodecahedron"), (0.0, 0.25), (0,), ("pca", "paper"))
    monkeypatch.setattr(normals, "QUICK", (grid,))
    monkeypatch.setattr(normals, "_blocks", lambda run, records: [])
    monkeypatch.setattr(normals, "normal_claims", lambda records, with_times: [])
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


def test_results_are_computed_again_once_a_call(run):
    from reproduction.cells import Folder

    made = []

    def work():
        made.append(1)
        return {"value": len(made)}

    run.folder.cell("a", work)
    again = Folder(run.folder.path, again=True)
    assert [again.cell("a", work)["value"] for _ in range(3)] == [2, 2, 2]
    assert run.folder.cell("a", work)["value"] == 2


def test_results_of_another_commit_are_computed_again(run, monkeypatch):
    from reproduction import cells

    made = []

    def work():
        made.append(1)
        return {}

    for commit in ("a", "a", "b"):
        monkeypatch.setattr(cells, "made_with", lambda commit=commit: {"commit": commit})
        run.folder.cell("a", work)
    assert len(made) == 2


def test_points_at_edges_are_those_whose_neighbors_lie_on_another_face(normals):
    scene = normals.make_shape("cuboid", 4000)
    at_edges = normals._near_edges(scene)
    near = normals.search_knn(scene.points, normals.K).indices.long()
    other = (scene.labels[near] != scene.labels[:, None]).any(dim=1)
    assert torch.equal(at_edges, other)


@pytest.mark.parametrize("method", ["classic_increment", "paper", "consensus"])
def test_growth_from_kept_normals_gives_the_labels_of_the_pipeline(run, method):
    from reproduction.segmentations import read_segmented, regrow

    limits = load_config(method).growing
    angle, quantile = limits.max_angle_deg, limits.curvature_quantile
    kept = read_segmented(run, "hallway", method).labels
    points = run.cloud("hallway").cloud.points
    turned = segment_planes(points, load_config(method).at_angle(8.0)).labels
    assert torch.equal(regrow(run, "hallway", method, 8.0, quantile), turned)
    # Another angle by less than rounding: grown again instead of read.
    assert torch.equal(regrow(run, "hallway", method, angle + 1e-12, quantile), kept)
    assert not torch.equal(regrow(run, "hallway", method, 0.01, quantile), kept)


def test_outcome_of_each_point():
    from torchrg.render.channels import outcomes_of

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
    np.savez(tmp_path / "hall.npz", points=points, labels=np.arange(500))
    cloud = load_cloud("hallway", tmp_path / "hall.npz", quick=False)
    assert (len(cloud.points), cloud.is_papers) == (499, True)
    assert cloud.labels.tolist() == [*range(3), *range(4, 500)]
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


def test_colors_of_many_points_are_faces():
    from reproduction.clouds import faces_of_colors

    colors = np.repeat(np.eye(3, dtype=np.uint8), (50, 49, 60), axis=0)
    faces = faces_of_colors(colors)
    assert len(faces[:50].unique()) == len(faces[99:].unique()) == 1
    assert -1 not in (faces[0], faces[-1])
    assert faces[0] != faces[-1]
    assert faces[50:99].unique().tolist() == [-1]


def test_objects_are_faces_of_the_shell_and_whole_pieces_of_furniture(small):
    from reproduction.clouds import _objects

    room = make_room(4000)
    objects = _objects(room)
    kinds = np.array(room.kinds)[room.labels.numpy()]
    walls = torch.from_numpy(np.isin(kinds, ("floor", "ceiling", "wall")))
    assert torch.equal(
        objects[walls].unique(return_inverse=True)[1],
        room.labels[walls].unique(return_inverse=True)[1],
    )
    assert torch.equal(objects[~walls], room.objects[room.labels[~walls]])
    assert not set(objects[walls].tolist()) & set(objects[~walls].tolist())


def test_faces_are_scored_by_size_and_kind():
    from reproduction.clouds import EvalCloud
    from reproduction.faces import match_faces, score_faces

    truth = torch.tensor([0] * 2000 + [1] * 1000 + [2] * 10 + [3] * 10)
    labels = truth.clone()
    labels[:1000] = -1  # half of the first face
    labels[2000:2500] = 9  # and of the second
    labels[3000:3010] = 0  # all of the third goes to the first
    faces = match_faces(labels, truth)
    assert faces.sizes.tolist() == [2000, 1000, 10, 10]
    assert faces.recall[[0, 1, 3]].tolist() == [50, 50, 100]
    assert faces.recall[2].isnan()
    cloud = EvalCloud("", "", torch.zeros(3020, 3), truth, None, "", curved=torch.tensor([1]))
    at_edges = torch.zeros(3020, dtype=torch.bool)
    at_edges[[0, 1500, 2999, 3005]] = True
    scores = score_faces(labels, cloud, at_edges)
    precision = (100 * 1000 / 1010 + 100) / 2
    assert scores["f1_large"] == pytest.approx(2 * precision * 50 / (precision + 50))
    assert (scores["found_large"], scores["found_small"]) == (0, 0.5)
    assert (scores["right_at_edges"], scores["none_at_edges"]) == (0.5, 0.25)
    assert scores["found_curved"] == scores["found_flat"] == 0
    assert "f1_objects" not in scores


def test_points_at_edges_of_a_cloud_have_another_face_among_their_neighbors():
    from reproduction.faces import find_edges

    from torchrg.structures import Neighbors

    truth = torch.tensor([0, 0, 1, -1])
    indices = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 0]])
    assert find_edges(truth, Neighbors(indices)).tolist() == [False, True, False, False]


def scored(title, ari, f1=(60.0, 70, 80, 85, 90, 95)):
    """Records of the six methods with such scores."""
    faces = {
        "f1_large": 1.0,
        "f1_objects": None,
        "right_at_edges": 0.5,
        "none_at_edges": 0.1,
        "found_small": 0.1,
        "f1_of_every": 5.0,
        "found_large": 0.9,
        "found_curved": 0.8,
        "found_flat": 0.7,
    }
    return {
        method: {
            "title": title,
            "regions": 5,
            "labels": {"ari": a, "f1": b, "mean_best_iou": 0.5, "faces": 7},
            "faces": faces,
        }
        for method, a, b in zip(METHODS, ari, f1, strict=True)
    }


def test_claims_hold_only_where_the_numbers_say_so():
    from reproduction.claims import segmentation_claims
    from reproduction.sections import verdict

    low, high = (0.9, 0.1, 0.2, 0.8, 0.3, 0.4), (0, 0.5, 0.4, 0, 0.3, 0.2)
    printed = {
        "tutorial": {"classic_increment": (0.2, 0.6, 2, 10), "detmm": (0.15, 0.4, 1.4, 4)},
        "hallway": {"classic_increment": (0.1, 0.4, 2, 7), "detmm": (0.2, 0.3, 1.5, 4)},
    }
    printed["tutorial"]["paper"], printed["hallway"]["paper"] = (0.1, 0.7, 1.7, 5), (0.3, 0.2, 1, 5)
    names = ("cp", "sp", "dbi", "dvi")
    sphere = {
        key: {
            m: {
                "title": key,
                **dict(zip(names, row, strict=True)),
                "directions": {"sp": 1.0, "dbi": 2.0},
            }
            for m, row in rows.items()
        }
        for key, rows in printed.items()
    }
    by_angle = {"2": {"ari": 0.1}, "5": {"ari": 0.3}, "8": {"ari": 0.2}}
    angles = {"cory": {"title": "storey", "angles": by_angle}}
    scores = {
        key: scored(key, ari)
        for key, ari in (("tutorial", low), ("hallway", high), ("exact", low), ("curved", high))
    }
    claims = {claim["text"]: claim for claim in segmentation_claims(scores, sphere, angles, "")}
    ari = claims["Classic < DetMM < the paper's method by ARI."]
    assert (ari["holds"], ari["fails"]) == (["tutorial"], ["hallway"])
    assert verdict(ari) == "holds on 1 of 2: tutorial"
    assert ari["numbers"]["tutorial"] == "0.100 < 0.200 < 0.300"
    assert ari["numbers"]["hallway"] == "0.500, 0.400, 0.300"
    all_faces = claims["Classic < DetMM < the paper's method by F1 of all faces."]
    assert verdict(all_faces) == "holds"
    large = claims["Classic < DetMM < the paper's method by F1 of faces of 1,000 points and more."]
    assert verdict(large) == "does not"
    order = claims[
        "The internal indices put classic, DetMM and the paper's method in the printed order."
    ]
    assert "CP of tutorial" in order["holds"]
    assert "CP of hallway" in order["fails"]
    text = (
        "The paper's method is best in the internal indices in which the printed table has it best."
    )
    assert claims[text]["holds"] == ["CP of tutorial", "SP of tutorial", "DBI of hallway"]
    assert claims[text]["fails"] == ["CP of hallway", "SP of hallway"]
    best = claims[
        "The paper's method is best in at least three of the four internal indices, as printed."
    ]
    assert best["numbers"] == {
        "region_growing_tutorial": "best in 2: CP, SP",
        "hallway_2": "best in 3: CP, SP, DBI",
    }
    assert best["holds"] == ["hallway_2"]
    assert verdict(claims["The desired segmentation comes at 5 degrees."]) == "holds"
    ahead = claims["paper < consensus by ARI."]
    assert ahead["holds"] == ["tutorial", "exact"]


def test_normals_hold_only_if_they_do_for_every_seed():
    from reproduction.normal_tables import normal_claims

    def measured(seed, paper):
        msae = {
            "pca": 100.0,
            "jet": 110.0,
            "irls": 80.0,
            "detmm": 70.0,
            "paper": paper,
            "libra": 90.0,
        }
        return [
            {
                "shape": "cuboid",
                "noise_percent": 0.25,
                "num_points": 9,
                "seed": seed,
                "variant": name,
                "seconds": 0.05 if name == "paper" else 1.0,
                "score": {"msae": value, "mean": value},
            }
            for name, value in msae.items()
        ]

    good = normal_claims([*measured(0, 90.0), *measured(1, 75.0)], with_times=True)
    libra = [True, True, False, False]
    assert [bool(claim["holds"]) for claim in good] == [True, True, False, False, *libra, True]
    assert "paper 82.5" in good[0]["numbers"]["cuboid 0.25 %"]
    assert good[3]["numbers"]["cuboid 0.25 %"] == "detmm < irls < paper < pca < jet"
    assert good[7]["numbers"]["cuboid 0.25 %"] == "detmm < irls < libra < pca < jet"
    bad = normal_claims([*measured(0, 101.0), *measured(1, 60.0)], with_times=False)
    assert [bool(claim["fails"]) for claim in bad[:4]] == [True, True, False, True]


def test_ratio_is_the_papers_time_over_ours_per_point():
    from reproduction.times import ratio

    record = {"cloud": "cory", "method": "paper", "points": 1_097_901, "total": 9.84}
    assert ratio(record) == pytest.approx(60)
    half = {**record, "points": 1_097_901 / 2}
    assert ratio(half) == pytest.approx(30)
    assert ratio({**record, "method": "consensus"}) is None


def test_times_hold_only_where_the_numbers_say_so():
    from reproduction.times import time_claims

    def timed(key, **seconds):
        return [
            {
                "cloud": key,
                "title": key,
                "method": method,
                "points": 1_097_901,
                "total": total,
                "seconds": {"normals": total / 2},
            }
            for method, total in seconds.items()
        ]

    records = []
    for key in ("tutorial", "hallway", "kinect"):
        records += timed(key, classic_increment=2, detmm=4, paper=3)
    records += timed("cory", classic_increment=2, detmm=14, paper=14.8)
    order, minute, goal = time_claims(records)
    assert (order["holds"], order["fails"]) == (["tutorial", "hallway", "kinect"], ["cory"])
    assert minute["numbers"] == {"cory": "7.4 s"}
    assert goal["fails"] == ["cory"]
    assert "39.9 times" in goal["numbers"]["cory"]


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


def test_page_escapes_words_and_shows_verdicts():
    from reproduction import sections
    from reproduction.report import to_html

    claims = [
        sections.claim("IV", "F1 < 5", {"a & b": (False, "6")}, "Why."),
        sections.claim("IV", "F1 > 5", {"a": (True, "6"), "b": (False, "4")}),
    ]
    part = sections.section("Part", [sections.table("", ["a"], [["**1**"]])], None, claims)
    report = {"title": "T", "intro": "I", "made_with": "M", "claims": claims}
    page = to_html({**report, "parts": {"part": part}})
    assert "<td><b>1</b></td>" in page
    assert (
        "<td>F1 &lt; 5</td>\n<td class=fails><b>does not</b></td><td>a &amp; b: 6. Why.</td>"
        in page
    )
    assert "<td class=partly><b>holds on 1 of 2: a</b></td><td>a: 6; b: 4.</td>" in page


def test_results_in_the_readme_are_what_the_script_makes():
    from reproduction import readme

    text = readme.README.read_text(encoding="utf-8")
    results = json.loads(readme.RESULTS.read_text(encoding="utf-8"))
    assert readme.insert(text, results) == text
    assert f"{readme.BEGIN}\n{readme.to_section(results)}\n{readme.END}" in text


def test_results_are_those_of_clouds_with_truth():
    from reproduction import readme

    labels = {"faces": 3, "ari": 0.5, "f1": 1.0, "mean_best_iou": 1.0}
    faces = {"f1_large": 2.0}
    record = {"cloud": "cory", "title": "Cory", "method": "paper", "share_labeled": 1}
    scores = [
        {"cloud": "tutorial", "method": "paper"},
        {**record, "labels": labels, "faces": faces},
    ]
    parts = {"segmentation": {"records": {"scores": scores}}}
    report = {"quick": False, "made_with": "", "claims": [], "parts": parts}
    found = readme.take_results(report)
    assert [(record["cloud"], record["f1_large"]) for record in found["scores"]] == [("cory", 2.0)]


def test_results_of_code_that_is_not_committed_are_refused(monkeypatch):
    from reproduction import readme

    monkeypatch.setattr(readme, "_write", lambda path, text: pytest.fail("written"))
    for commit in ("2f26e94-dirty", "unknown", "2f26e94, ad1e777"):
        report = {"quick": False, "made_with": f"torchrg 0.1.0; commit {commit}; python 3"}
        with pytest.raises(ValueError, match=f"expected a report of one commit, got {commit}"):
            readme.update(report)


def test_full_report_of_a_tree_with_changes_is_refused(tmp_path, monkeypatch):
    import reproduce_paper

    monkeypatch.setattr(reproduce_paper, "made_with", lambda: {"commit": "2f26e94-dirty"})
    with pytest.raises(SystemExit, match=r"expected committed code .* got commit 2f26e94-dirty"):
        call_script(monkeypatch, "--out", tmp_path, "times")
    assert not list(tmp_path.iterdir())


def test_readme_is_updated_between_the_markers_only(tmp_path, monkeypatch):
    from reproduction import readme

    numbers = {"ari": 0.5, "f1_large": 90.0, "mean_best_iou": 0.25, "faces": 3}
    one = {"cloud": "cory", "title": "Cory", **numbers}
    rows = [{**one, "method": method} for method in METHODS]
    results = {"quick": False, "made_with": "torchrg", "scores": rows}
    text = f"before\n{readme.BEGIN}\nold\n{readme.END}\nafter\n"
    made = readme.insert(text, results)
    assert made.startswith(f"before\n{readme.BEGIN}\nAdjusted Rand index")
    assert made.endswith(f"\n{readme.END}\nafter\n")
    assert "old" not in made
    assert "| Cory (3 faces) | 0.50 / 90 / 0.25 |" in made
    with pytest.raises(ValueError, match="expected a README with"):
        readme.insert("no markers", results)
    with pytest.raises(ValueError, match="expected the part segmentation"):
        readme.take_results({"parts": {"normals": {}}})
