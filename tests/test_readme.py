"""The README is short, its examples and commands run, and its links lead to files."""

import json
import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

from torchrg.cli import COMMANDS, convert
from torchrg.cli.arguments import list_flags

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
MOST_LINES = 170
TEXTS = [README, *(ROOT / ".github").glob("*.md")]


def blocks_of(kind):
    text = README.read_text(encoding="utf-8")
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of("python")
    assert len(blocks) == 6
    shared = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    assert {"plane", "normal", "curvature", "offset"} <= set(shared["batch"])
    assert (shared["sample"]["plane"] == 0).all()
    assert "planes;" in capsys.readouterr().out


def test_commands_have_the_flags_that_they_are_shown_with():
    lines = [shlex.split(line, comments=True) for line in "".join(blocks_of("bash")).splitlines()]
    shown = [line for line in lines if line[:1] == ["torchrg"]]
    assert len(shown) > 5
    for _, name, *rest in shown:
        assert name in COMMANDS
        kind = (
            convert.KINDS[rest[0]]
            if name == "convert"
            else import_module(f"torchrg.cli.{name}").Arguments
        )
        known = {flag.name for flag in list_flags(kind)}
        assert {word for word in rest if word.startswith("--")} <= known


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_to_files(text):
    for target in re.findall(r"\]\(([^)#]+)\)", text.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (text.parent / target).exists(), target


def test_readme_stays_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_figures_are_those_that_are_kept():
    import readme_tables

    text = README.read_text(encoding="utf-8")
    figures = json.loads(readme_tables.FIGURES.read_text(encoding="utf-8"))
    assert readme_tables.insert(text, figures) == text
    with pytest.raises(ValueError, match="expected a README with"):
        readme_tables.insert("no place", figures)


def test_figures_are_medians_means_and_what_lies_between_two_partitions():
    import readme_tables

    def run(neighbors, total):
        return {"seconds": {"normals": neighbors}, "total": total}

    names = {name.split()[0] for names in readme_tables.WORK.values() for name in names}
    by = {name: [run(1.0, 2.0)] for name in names}
    by["pclrg"] = [run(3.0, 5.0), run(4.0, 9.0), run(5.0, 6.0)]
    made = {"commit": "2f26e94", "processor": "a processor", "cores": 2}
    peers = {"made_with": made, "results": {"room 1000000 random": by}}
    shares = {"consensus": [{"recall_iou50": 0.8}], "PCL": [{"recall_iou50": 0.5}]}
    other = {"consensus": [{"recall_iou50": 0.6}], "PCL": [{"recall_iou50": 0.1}]}
    for clouds in (shares, other):
        clouds["Open3D"] = clouds["PCL"]
    accuracy = {"results": {"room, 1 mm": shares, "rooms/room_2": other}}
    levels = [{"count": 100, "asa": 0.5}, {"count": 900, "asa": 0.7}]
    parts = {"torchrg": [{"levels": levels}], "cut pursuit": [{"levels": levels}]}
    figures = readme_tables.take_figures(peers, accuracy, {"results": {"a_scan": parts}})
    section = readme_tables.to_section(figures)
    assert "| planes by `paper`, random order | 1 | 3.0 | 1.0 |" in section
    assert "| normals by `pca`, random order | 1 | 2.0 | 1.0 |" in section
    assert "| made rooms, seven noises and densities | 0.70 | 0.30 | 0.30 |  |" in section
    assert "| superpoints: a scan | 0.600 |  |  | 0.600 |" in section
