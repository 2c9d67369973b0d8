"""README and guides name all scripts, and scripts use only public names."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
BEHIND = {"environment.sh": "test.sh", "docs.py": "docs.sh"}
"""Scripts started by other scripts, and the latter."""


def commands():
    """Return the scripts for users."""
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
    guides = {*(SCRIPTS / "guides").glob("*.md")} - {SCRIPTS / "guides" / "clients.md"}
    texts = (ROOT / "README.md", *guides, ROOT / ".ci" / "run")
    for path in (*texts, *(ROOT / "torchrg").rglob("*.py")):  # Recipes name scripts of others.
        for name in re.findall(r"scripts/([a-z_]+\.(?:py|sh))", path.read_text(encoding="utf-8")):
            assert (SCRIPTS / name).exists(), (path.name, name)


def test_scripts_make_scenes_by_what_the_packages_show():
    for path in SCRIPTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                names = [alias.name for alias in node.names if alias.name.startswith("_")]
                assert not names, (path.name, names)
                hidden = ("torchrg.scenes.", "tests.made.")
                assert not (node.module or "").startswith(hidden), path.name
