"""Files of Python beside the scans are data: no command runs them, nor a process that it starts."""

import os
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from torchrg.scenes import make_room

MODULES = ("json", "numpy", "pickle", "random", "select", "torch")
"""Of the standard library and of others, loaded by interpreters, libraries or Ray as they start."""
SEGMENT = ("segment", "a.npy", "--out", "../o.npz", "--preset", "classic")
CONVERT = ("convert", "folder", "../in", "../out", "--preset", "classic", "--workers", "2")
CAMERA = ("--intrinsics", "50,50,39.5,29.5", "--depth-scale", "1")
COMMAND = """
import sys
from torchrg.__main__ import main
from torchrg.cli import segment
if __name__ == "__main__":
    segment.choose_workers = lambda *sizes: 2
    sys.exit(main())
"""
"""As the installed command, a file in a folder of its own; small clouds have processes too."""
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")


@pytest.fixture
def folder(tmp_path):
    """A folder of two scans and two depth images, with modules that say when they are run."""
    for name in ("in", "here"):
        (tmp_path / name).mkdir()
    for seed, name in enumerate("ab"):
        points = make_room(num_points=40_000, noise=0.003, seed=seed).points
        np.save(tmp_path / "in" / f"{name}.npy", points[:2000])
        np.save(tmp_path / "here" / f"{name}.npy", points)
        np.save(tmp_path / "here" / f"depth_{name}.npy", np.full((60, 80), 2.0, np.float32))
    for name in MODULES:
        text = f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})"
        (tmp_path / "here" / f"{name}.py").write_text(text)
    return tmp_path / "here"


@pytest.mark.parametrize(
    "arguments",
    [
        CONVERT,
        pytest.param(
            ("depth", "depth_a.npy", "depth_b.npy", *CAMERA, "--out", "../out", "--workers", "2"),
            marks=pytest.mark.slow,
        ),
        pytest.param((*SEGMENT, "--limit-memory", "0.542"), marks=pytest.mark.slow),
        pytest.param((*SEGMENT, "--compile"), marks=pytest.mark.slow),
        pytest.param((*CONVERT, "--engine", "ray"), marks=[pytest.mark.slow, needs_ray]),
        pytest.param(
            (*SEGMENT, "--limit-memory", "0.542", "--engine", "ray"),
            marks=[pytest.mark.slow, needs_ray],
        ),
    ],
    ids=["workers", "frames", "tiles", "compile", "ray", "tiles of ray"],
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
        env=os.environ | {"TORCHRG_CACHE_DIR": str(folder.parent / "cache")},
    )
    assert done.returncode == 0, done.stderr
    assert not (folder.parent / "ran").exists(), (folder.parent / "ran").read_text()
    if "--limit-memory" in arguments:
        assert "in tiles of" in done.stdout
    if "--compile" in arguments:
        assert done.stderr == ""


def test_the_module_called_as_a_command_runs_none_of_them(folder):
    command = [sys.executable, "-m", "torchrg", "info", "a.npy"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert "40,000 of float32" in done.stdout, done.stderr
    assert not (folder.parent / "ran").exists(), (folder.parent / "ran").read_text()
