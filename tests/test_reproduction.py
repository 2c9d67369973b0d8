"""The script that makes the paper's figures again: small, resumed, complete."""

import json
from pathlib import Path

import pytest
import torch

SCRIPTS = Path(__file__).parents[1] / "scripts"
VARIANTS = ("pca", "paper", "consensus")


@pytest.fixture
def normals(monkeypatch):
    """The part ``normals`` with a grid that takes seconds."""
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.syspath_prepend(SCRIPTS)
    from reproduction import normals

    small = normals.Grid(("cuboid", "dodecahedron"), (0.0, 0.25), (400,), VARIANTS)
    monkeypatch.setattr(normals, "QUICK", small)
    monkeypatch.setattr(normals, "FULL", small)
    return normals


def test_part_writes_figures_tables_and_records(normals, tmp_path, capsys):
    from reproduction.cells import Folder

    normals.reproduce(Folder(tmp_path), quick=True)
    records = json.loads((tmp_path / "normals.json").read_text())
    assert len(records) == 2 * 2 * 3
    assert {"shape", "noise_percent", "num_points", "variant", "seconds"} <= set(records[0])
    assert {"msae", "rms", "median", "under_10_deg", "sharp_msae"} <= set(records[0]["score"])
    assert {"commit", "torch", "processor", "threads"} <= set(records[0]["made_with"])
    table = (tmp_path / "normals.md").read_text()
    assert "| cuboid | 0.25 % |" in table
    for name in ("figure3.png", "figure4.png", "figure4_all.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("MSAE") == len(records)


def test_interrupted_run_goes_on_where_it_stopped(normals, tmp_path, monkeypatch):
    from reproduction.cells import Folder

    measured = []
    measure = normals._measure

    def interrupted(*cell):
        if len(measured) == 5:
            raise KeyboardInterrupt
        measured.append(cell)
        return measure(*cell)

    monkeypatch.setattr(normals, "_measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        normals.reproduce(Folder(tmp_path), quick=True)
    assert len(list((tmp_path / "cells").iterdir())) == 5
    monkeypatch.setattr(normals, "_measure", lambda *cell: measured.append(cell) or measure(*cell))
    normals.reproduce(Folder(tmp_path), quick=True)
    assert len(measured) == len(set(measured)) == 12


def test_points_at_edges_are_those_whose_neighbors_lie_on_another_face(normals):
    scene = normals.make_shape("cuboid", 4000)
    at_edges = normals._near_edges(scene)
    near = normals.search_knn(scene.points, normals.K).indices.long()
    other = (scene.labels[near] != scene.labels[:, None]).any(dim=1)
    assert torch.equal(at_edges, other)
