"""The examples of the README run as they are printed."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"
MOST_LINES = 200


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 5
    shared = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    assert {"plane", "normal", "curvature", "offset"} <= set(shared["batch"])
    assert (shared["found"]["plane"] == 0).all()
    assert "planes;" in capsys.readouterr().out


def test_readme_stays_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= MOST_LINES
