"""The examples of the README run as they are printed."""

import re
from pathlib import Path

from torchrg import transforms

README = Path(__file__).parents[1] / "README.md"


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 5
    shared = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    names = [settings.pop("type") for settings in shared["transform"]]
    chain = [getattr(transforms, n)(**s) for n, s in zip(names, shared["transform"], strict=True)]
    sample = {"coord": shared["room"].points.numpy(), "index_valid_keys": ["coord"]}
    for step in chain:
        sample = step(sample)
    assert {"plane", "curvature"} <= set(sample["index_valid_keys"])
    shown = capsys.readouterr().out
    assert "planes;" in shown
    assert "['curvature', 'normal', 'plane', 'pos']" in shown
