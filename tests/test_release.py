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
    assert all((ROOT / name).exists() for name in named)


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
    url = PROJECT["urls"]["Paper"]
    assert url in (ROOT / "README.md").read_text(encoding="utf-8")
    assert url in (ROOT / ".zenodo.json").read_text(encoding="utf-8")
    assert url in (ROOT / ".github" / "CITATION.cff").read_text(encoding="utf-8")


def test_addresses_are_complete_and_in_one_place():
    urls = PROJECT["urls"]
    assert {"Homepage", "Documentation", "Repository", "Issues", "Changelog", "Paper"} <= set(urls)
    assert all(url.startswith("https://") for url in urls.values())
    folders = [ROOT / ".github", ROOT / "scripts", ROOT / "torchrg"]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    assert not {path.name for path in files if b"/OWNER" in path.read_bytes()}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"git clone {urls['Homepage']} &&" in readme
    assert f"will be at {urls['Documentation']};" in readme
    assert any("OWNER" in url for url in urls.values()) == (
        "@OWNER" in (ROOT / ".github" / "CODEOWNERS").read_text()
    )


def test_extras_of_development_contain_those_of_tests_and_documentation():
    extras = PROJECT["optional-dependencies"]
    assert "torchrg[docs,test]" in extras["dev"]
    tools = {need.partition(">=")[0] for need in extras["test"] + extras["docs"]}
    assert {"pytest", "sphinx"} <= tools
    assert not {"ruff", "mypy"} & tools


def test_the_changelog_has_the_version():
    changes = (ROOT / "scripts" / "guides" / "changes.md").read_text(encoding="utf-8")
    first = re.search(r"^## (.*), (unreleased|\d{4}-\d\d-\d\d)$", changes, re.MULTILINE)
    assert first[1] == __version__


def test_links_of_the_readme_have_addresses_in_the_package():
    pytest.importorskip("hatchling", reason="needs the extra test")
    from build_readme import ReadmeHook

    metadata = {"urls": {"Homepage": "https://host/repository"}, "version": "1.2"}
    ReadmeHook(str(ROOT), {}).update(metadata)
    text = metadata["readme"]["text"]
    links = re.findall(r"\]\((.*?)\)", text)
    assert len(links) > 5
    assert all(link.startswith(("https://", "#")) for link in links)
    assert (
        "![An office" in text.partition("](https://host/repository/raw/v1.2/scripts/rooms.png)")[0]
    )


def test_actions_are_pinned_by_hash():
    files = [*(ROOT / ".github" / "workflows").iterdir()]
    uses = [line for path in files for line in path.read_text().splitlines() if "uses:" in line]
    assert len(uses) > 10
    assert all(re.search(r"@[0-9a-f]{40} # v[\d.]+$", line) for line in uses)


def test_the_release_builds_every_wheel():
    build_kernels = pytest.importorskip("build_kernels", reason="needs the extra test")
    (step,) = (
        step["run"]
        for step in workflow("release.yml")["jobs"]["build"]["steps"]
        if step.get("name") == "Build"
    )
    words = re.search(r"for target in (.*); do", step)[1].replace(
        "{x86_64,aarch64}-linux-{gnu.2.17,musl}",
        " ".join(f"{cpu}-linux-{c}" for cpu in ("x86_64", "aarch64") for c in ("gnu.2.17", "musl")),
    )
    assert set(words.split()) == {*build_kernels.WHEELS, "0"}


def test_hooks_use_the_linter_of_the_suite():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    (rev,) = (repo["rev"] for repo in hooks["repos"] if "ruff" in repo["repo"])
    extras = PROJECT["optional-dependencies"]["dev"]
    (lowest,) = (need.partition(">=")[2] for need in extras if need.startswith("ruff"))
    assert rev.removeprefix("v").startswith(lowest)
