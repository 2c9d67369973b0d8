"""What a release is made of says the same in every place."""

import json
import re
from pathlib import Path

import pytest
import yaml

from torchrg.version import __version__

tomllib = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def workflow(name):
    return yaml.safe_load((ROOT / ".github" / "workflows" / name).read_text(encoding="utf-8"))


def test_versions_of_python_are_those_that_are_tested():
    listed = {
        found[1]
        for classifier in PROJECT["classifiers"]
        if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", classifier))
    }
    matrix = workflow("test.yml")["jobs"]["suite"]["strategy"]["matrix"]
    assert set(matrix["python"]) == listed
    assert PROJECT["requires-python"] == f">={min(listed, key=lambda v: int(v[2:]))}"
    kinds = {row["torch"] for row in matrix["include"]} | set(matrix["torch"])
    assert kinds == {"lowest", "pinned", "newest"}


def test_scripts_that_the_machines_run_are_there():
    texts = [*(ROOT / ".github" / "workflows").iterdir(), ROOT / ".readthedocs.yaml"]
    named = [name for text in texts for name in re.findall(r"scripts/[\w.]+", text.read_text())]
    assert len(named) > 5
    assert all((ROOT / name).is_file() for name in named)


def test_version_license_and_authors_are_the_same_everywhere():
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    authors = [author["name"] for author in PROJECT["authors"]]
    assert PROJECT["version"] == __version__
    assert zenodo["license"] == PROJECT["license"]
    assert [creator["name"] for creator in zenodo["creators"]] == authors
    citation = yaml.safe_load((ROOT / ".github" / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (__version__, PROJECT["license"])
    assert [author["name"] for author in citation["authors"]] == authors
    assert citation["title"] == zenodo["title"]
    assert f"{authors[0].lower()}\n" in (ROOT / "LICENSE").read_text(encoding="utf-8").lower()


def test_the_paper_is_named_as_in_the_readme():
    (url,) = PROJECT["urls"].values()
    assert url in (ROOT / "README.md").read_text(encoding="utf-8")
    assert url in (ROOT / ".zenodo.json").read_text(encoding="utf-8")
    assert url in (ROOT / ".github" / "CITATION.cff").read_text(encoding="utf-8")


def test_hooks_use_the_linter_of_the_suite():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    (rev,) = (repo["rev"] for repo in hooks["repos"] if "ruff" in repo["repo"])
    extras = PROJECT["optional-dependencies"]["dev"]
    (lowest,) = (need.partition(">=")[2] for need in extras if need.startswith("ruff"))
    assert rev.removeprefix("v").startswith(lowest)
