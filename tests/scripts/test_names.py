"""Scripts are found by who reads README and guides, and use public names alone."""

import ast
import re
from pathlib import Path

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


def test_the_readme_or_a_guide_names_every_script():
    texts = [ROOT / "README.md", *(SCRIPTS / "guides").glob("*.md")]
    text = "".join(path.read_text(encoding="utf-8") for path in texts)
    assert len(commands()) > 8
    for name in commands():
        place = (SCRIPTS / BEHIND[name]).read_text() if name in BEHIND else text
        assert f"scripts/{name}" in place or f"/{name}" in place, name


def test_every_script_that_is_named_is_there():
    texts = (ROOT / "README.md", *(SCRIPTS / "guides").glob("*.md"), ROOT / ".ci" / "run")
    for path in (*texts, *(ROOT / "torchrg").rglob("*.py")):
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
