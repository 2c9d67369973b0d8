"""Importing torchrg is quiet, quick, and brings no optional or heavy package."""

import subprocess
import sys

HEAVY = ["kornia", "laspy", "matplotlib", "meshio", "pypcd4", "ray", "scipy", "tyro", "yaml"]
SCRIPT = """
import sys, warnings
import numpy, torch
warnings.simplefilter("error")
before = set(sys.modules)
import torchrg
print(*(set(sys.modules) - before))
"""


def test_import_is_quiet_and_light():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    )
    assert not set(HEAVY) & set(done.stdout.split())
    assert done.stderr == ""
