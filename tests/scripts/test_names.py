"""Scripts are found by who reads the README, and use what torchrg and the made scenes show."""

import ast
import re
from pathlib import Path

import docs
import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
BEHIND = {"environment.sh": "test.sh", "docs.py": "docs.sh"}
"""Scripts that others start, and these."""


def commands():
    """Return the scripts that somebody starts."""
    found = [*SCRIPTS.glob("*.sh"), *SCRIPTS.glob("*.py")]
    return sorted(
        path.name for path in found if path.suffix == ".sh" or "__main__" in path.read_text()
    )


def test_the_readme_names_every_script():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(commands()) > 8
    for name in commands():
        place = (SCRIPTS / BEHIND[name]).read_text() if name in BEHIND else text
        assert f"scripts/{name}" in place or f"/{name}" in place, name


def test_every_script_that_is_named_is_there():
    for path in (ROOT / "README.md", *(ROOT / "torchrg").rglob("*.py"), ROOT / ".ci" / "run"):
        for name in re.findall(r"scripts/([a-z_]+\.(?:py|sh))", path.read_text(encoding="utf-8")):
            assert (SCRIPTS / name).exists(), (path.name, name)


@pytest.mark.parametrize("folder", ["scripts", "tests/made"])
def test_scenes_are_made_by_what_the_package_of_scenes_shows(folder):
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                names = [alias.name for alias in node.names if alias.name.startswith("_")]
                assert not names, (path.name, names)
                assert not (node.module or "").startswith("torchrg.scenes."), path.name


def test_references_of_the_reference_lead_somewhere():
    modules = list(docs.modules())
    assert len(modules) > 100
    assert not [
        (module.__name__, target)
        for module in modules
        for _, target in docs.references(module)
        if not docs.leads_somewhere(target, module)
    ]
    assert not docs.leads_somewhere("torchrg.nothing", modules[0])
