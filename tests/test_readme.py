"""The README is short, its examples and commands run, and its links lead to files."""

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest

from torchrg.cli import COMMANDS, convert
from torchrg.cli.arguments import list_flags

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
MOST_LINES = 180
TEXTS = [README, *(ROOT / ".github").glob("*.md")]


def blocks_of(kind):
    text = README.read_text(encoding="utf-8")
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of("python")
    assert len(blocks) == 5
    shared = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    assert {"plane", "normal", "curvature", "offset"} <= set(shared["batch"])
    assert (shared["found"]["plane"] == 0).all()
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
