"""DXF drawings as ezdxf, an independent reader, sees them."""

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from torchrg.io import dxf
from torchrg.io.plane_table import bounding_rectangle

ezdxf = pytest.importorskip("ezdxf", reason="needs the extra dxf")
shapely = pytest.importorskip("shapely", reason="needs the extra outline")

UTM = np.array([651_234.125, 5_412_345.5, 417.75])
PLANE = {
    "kind": "wall", "rms": 0.0, "area": 8.0, "count": 9, "center": [1.0, 2.0, 3.0],
    "extent": [4.0, 2.0], "axes": [[1.0, 0, 0], [0, 0, 1.0]],
}  # fmt: skip


@pytest.fixture(scope="module")
def scan(room, tmp_path_factory):
    path = tmp_path_factory.mktemp("scan") / "room.npz"
    np.savez(path, points=room(5000).points.double().numpy() + UTM)
    return path


def write(run, scan, table):
    places = ("--out", table.with_suffix(".npz"), "--table", table)
    assert run("segment", scan, "--preset", "classic", *places).code == 0


def test_the_polygons_are_those_of_the_csv(scan, tmp_path, run):
    for name in ("planes.dxf", "planes.csv"):
        write(run, scan, tmp_path / name)
    drawing = ezdxf.readfile(tmp_path / "planes.dxf")
    auditor = drawing.audit()
    assert not auditor.has_errors
    assert not auditor.has_fixes
    assert drawing.header["$INSUNITS"] == 6
    with (tmp_path / "planes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = []
    for row in rows:
        layer = {"wall": "WALL", "floor": "FLOOR", "ceiling": "CEILING"}.get(row["kind"], "OTHER")
        for part in shapely.get_parts(shapely.from_wkt(row["outline"])):
            rings = (part.exterior, *part.interiors)
            expected += [(layer, [list(p) for p in ring.coords[:-1]]) for ring in rings]
    found = []
    for line in drawing.modelspace():
        assert line.is_closed
        assert line.is_3d_polyline
        found.append((line.dxf.layer, [list(vertex.dxf.location) for vertex in line.vertices]))
    assert found == expected
    assert {layer for layer, _ in found} >= {"WALL", "FLOOR", "CEILING"}


@pytest.mark.slow  # Three processes.
def test_equal_runs_give_equal_bytes():
    """Sets have another order in each process."""
    program = (
        "import json, sys; from torchrg.io.dxf import encode_dxf; "
        "print(encode_dxf(json.loads(sys.argv[1])))"
    )
    table = json.dumps({"planes": [PLANE]})
    contents = {
        subprocess.run(
            [sys.executable, "-c", program, table],
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
            check=True,
            capture_output=True,
        ).stdout
        for seed in range(3)
    }
    assert len(contents) == 1


def test_a_plane_without_a_polygon_is_a_rectangle():
    text = dxf.encode_dxf({"planes": [PLANE]}).decode()
    assert text.count("VERTEX") == 4
    assert bounding_rectangle(PLANE) == [[-1, 2, 2], [3, 2, 2], [3, 2, 4], [-1, 2, 4]]


def test_without_ezdxf_it_is_refused_before_the_work(scan, tmp_path, run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ezdxf", None)
    places = ("--out", tmp_path / "out.npz", "--table", tmp_path / "planes.dxf")
    for command in (
        ("segment", scan, *places),
        ("convert", "folder", scan.parent, tmp_path / "o", "--table", "planes.dxf"),
    ):
        refused = run(*command)
        assert "pip install 'torchrg[dxf]'" in refused.error
    assert not (tmp_path / "out.npz").exists()
