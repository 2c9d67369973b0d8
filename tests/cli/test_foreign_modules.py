"""Files of Python next to the scans are data: no command or its processes run them."""

import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

MODULES = ("json", "numpy", "pickle", "random", "select", "torch")
"""Modules of the standard library and of others that interpreters, libraries or Ray load first."""
SEGMENT = ("segment", "a.npy", "--out", "../o.npz", "--preset", "classic")
CONVERT = ("convert", "folder", "../in", "../out", "--preset", "classic", "--workers", "2")
COMMAND = """
import sys
from torchrg.__main__ import main
if __name__ == "__main__":
    sys.exit(main())
"""
"""As the installed command, a file in a folder of its own."""
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")


@pytest.fixture
def folder(tmp_path, room):
    """A folder of two scans, with modules that say when they are run."""
    for name in ("in", "here"):
        (tmp_path / name).mkdir()
        for seed, scan in enumerate("ab"):
            np.save(tmp_path / name / f"{scan}.npy", room(2_000, seed=seed).points)
    for name in MODULES:
        text = f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})"
        (tmp_path / "here" / f"{name}.py").write_text(text)
    return tmp_path / "here"


@pytest.mark.parametrize(
    "arguments",
    [
        CONVERT,
        pytest.param((*CONVERT, "--engine", "ray"), marks=[pytest.mark.slow, needs_ray]),
    ],
    ids=["workers", "ray"],
)
def test_no_module_beside_the_scans_is_run(folder, arguments):
    command = folder.parent / "bin" / "command"
    command.parent.mkdir()
    command.write_text(COMMAND)
    done = subprocess.run(
        [sys.executable, str(command), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not (folder.parent / "ran").exists(), (folder.parent / "ran").read_text()


def test_the_module_called_as_a_command_runs_none_of_them(folder):
    command = [sys.executable, "-m", "torchrg", "info", "a.npy"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert "2,000 of float32" in done.stdout, done.stderr
    assert not (folder.parent / "ran").exists(), (folder.parent / "ran").read_text()
