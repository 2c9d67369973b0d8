"""Importing torchrg is quiet, quick, and brings no optional or heavy package."""

import subprocess
import sys

import pytest

import torchrg

HEAVY = ["kornia", "laspy", "matplotlib", "meshio", "pypcd4", "ray", "scipy", "yaml"]
SCRIPT = """
import sys, warnings
import torchrg
print("numpy" in sys.modules)
import numpy, torch
warnings.simplefilter("error")
before = set(sys.modules)
[getattr(torchrg, name) for name in torchrg.__all__]
print(*(set(sys.modules) - before))
"""


def test_import_is_quiet_and_light():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    )
    first, loaded = done.stdout.splitlines()
    assert first == "False"
    assert "torchrg.pipeline" in loaded.split()
    assert not set(HEAVY) & set(loaded.split())
    assert done.stderr == ""


def test_modules_load_when_they_are_asked_for():
    assert set(torchrg.__all__) <= set(dir(torchrg))
    assert torchrg.render.__name__ == "torchrg.render"
    assert torchrg.segment_planes.__module__ == "torchrg.pipeline.planes"
    with pytest.raises(AttributeError, match="module 'torchrg' has no attribute 'nothing'"):
        _ = torchrg.nothing
