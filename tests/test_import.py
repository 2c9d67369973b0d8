"""Importing torchrg is quiet, quick, and brings no optional or heavy package."""

import re
import subprocess
import sys

import pytest
import torch

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


@pytest.mark.slow
def test_torch_load_knows_saved_results(tmp_path):
    torch.save(torchrg.segment_planes(torch.rand(200, 3), "classic"), tmp_path / "seg.pt")
    script = f"import torch, torchrg; print(torch.load({str(tmp_path / 'seg.pt')!r}))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("Segmentation(200 points, ")


@pytest.mark.parametrize(
    ("name", "use"),
    [
        ("segment_plane", "torchrg.segment_planes(points)"),
        ("SACSegmentation", "torchrg.segment_planes(points)"),
        ("read_point_cloud", "torchrg.read_cloud(path)"),
        ("save", "torchrg.write_cloud(path, cloud, seg)"),
        ("voxel_down_sample", "voxel, as in"),
        ("DetMCD", "torchrg.nn.DetMCD"),
        ("Segmentation", "torchrg.structures.Segmentation"),
        ("search_kn", "torchrg.search_knn"),
    ],
)
def test_names_of_other_libraries_lead_to_those_here(name, use):
    with pytest.raises(AttributeError, match=f"no attribute {name!r}; use {re.escape(use)}"):
        getattr(torchrg, name)
