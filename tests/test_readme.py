"""The examples of the README run as they are printed."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 5
    shared = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    shown = capsys.readouterr().out
    assert "planes;" in shown
    assert "['curvature', 'normal', 'plane', 'pos']" in shown
