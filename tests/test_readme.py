"""README: length, examples, commands and links."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.datasets.s3dis_tree import text_of, write_objects
from torchrg.cli import main
from torchrg.io import write_cloud
from torchrg.render import write_png
from torchrg.scenes import make_room
from torchrg.structures import Cloud

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
MAX_LINES = 170
TEXTS = [README, *(ROOT / ".github").glob("*.md")]


def blocks_of(kind):
    text = README.read_text(encoding="utf-8")
    return re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of("python")
    assert len(blocks) == 6
    shared = {"__name__": "__main__"}
    for block in blocks:
        exec(compile(block, str(README), "exec"), shared)
    assert {"plane", "normal", "curvature", "offset"} <= set(shared["batch"])
    assert (shared["sample"]["plane"] == 0).all()
    assert "planes;" in capsys.readouterr().out


@pytest.mark.slow
def test_examples_have_no_errors_of_types(tmp_path):
    """The idioms shown, and results of modules, pass mypy --strict."""
    pytest.importorskip("mypy", reason="needs the extra dev")
    uses = """
def covariance(patches: torch.Tensor) -> torch.Tensor:
    return DetMCD()(patches).covariance

torchrg.segment_planes(cloud, {"normals.k": 30}, kinds=["wall"], min_area=0.5)
SegmentPlanes({"base": "classic", "normals": {"k": 30}})
torchrg.load_config({"growing.absorb": "no"})
"""
    (tmp_path / "blocks.py").write_text("\n".join([*blocks_of("python"), uses]), encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "blocks.py"]
    environment = {**os.environ, "MYPYPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("method", ["spawn", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_loader_block_runs_as_a_script(method, tmp_path):
    (block,) = (block for block in blocks_of("python") if "DataLoader(" in block)
    start = f"import multiprocessing\nmultiprocessing.set_start_method({method!r}, force=True)\n"
    (tmp_path / "script.py").write_text(f"{start}{block}", encoding="utf-8")
    for seed in (0, 1):
        points = make_room(2_000, noise=0.003, seed=seed).points.numpy()
        write_cloud(tmp_path / f"room{seed}.ply", Cloud(points))
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("torch.Size([2000])") == 2


@pytest.mark.slow
def test_commands_run_in_their_order(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pydeck", reason="needs the extra view")
    monkeypatch.chdir(tmp_path)
    room = make_room(4_000, noise=0.003, seed=1)
    points = room.points.numpy()
    write_cloud("scan.ply", Cloud(points))
    write_cloud("truth.npz", Cloud(points, {"labels": room.labels.numpy()}))
    write_png(Path("frame.png"), np.full((48, 64), 2000))
    camera = {"fl_x": 53.0, "fl_y": 53.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    Path("camera.json").write_text(json.dumps(camera))
    for area in range(1, 7):
        folder = Path("Stanford3dDataset_v1.2") / f"Area_{area}" / "office_1"
        write_objects(folder, {"wall_1.txt": text_of(np.hstack([points, 0 * points]))})
    lines = [shlex.split(line, comments=True) for line in "".join(blocks_of("bash")).splitlines()]
    for _, *words in [line for line in lines if line[:1] == ["torchrg"]]:
        assert main(words) == 0, (words, capsys.readouterr().err)
    for name in (
        "planes.npz",
        "planes.csv",
        "planes.html",
        "labels.png",
        "parts.npz",
    ):
        assert Path(name).stat().st_size > 0
    assert not Path("s3dis").exists()


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_links_lead_to_files(text):
    for target in re.findall(r"\]\(([^)#]+)\)", text.read_text(encoding="utf-8")):
        assert target.startswith("https://") or (text.parent / target).exists(), target


def test_readme_stays_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


def test_figures_are_those_that_are_kept():
    import readme_tables

    text = README.read_text(encoding="utf-8")
    figures = json.loads(readme_tables.FIGURES.read_text(encoding="utf-8"))
    assert readme_tables.insert(text, figures) == text
    with pytest.raises(ValueError, match="expected a README with"):
        readme_tables.insert("no place", figures)


def test_figures_are_medians_means_and_what_lies_between_two_partitions():
    import readme_tables

    def run(neighbors, total):
        return {"seconds": {"normals": neighbors}, "total": total, "whole": total + 1.0}

    names = {name.split()[0] for names in readme_tables.WORK.values() for name in names}
    by = {name: [run(1.0, 2.0)] for name in names}
    by["pclrg"] = [run(3.0, 5.0), run(4.0, 9.0), run(5.0, 6.0)]
    made = {"commit": "2f26e94", "processor": "a processor", "cores": 2}
    peers = {"made_with": made, "results": {"room random": by, "room sorted": by}}

    def detected(fraction):
        return [{"recall_iou50": fraction, "mean_best_iou": fraction / 2}]

    fractions = {"consensus": detected(0.8), "PCL": detected(0.5)}
    other = {"consensus": detected(0.6), "PCL": detected(0.1)}
    for clouds in (fractions, other):
        clouds["Open3D"] = clouds["CGAL growing, pca"] = clouds["PCL"]
        clouds["CGAL RANSAC, pca"] = detected(0.2)
    patches = {"office_parts, patches at 10 mm": other}
    accuracy = {"results": {"room, 1 mm": fractions, "rooms/room_2": other, **patches}}
    levels = [{"count": 100, "asa": 0.5}, {"count": 900, "asa": 0.7}]
    parts = {"torchrg": [{"levels": levels}], "cut pursuit": [{"levels": levels}]}
    figures = readme_tables.times_of(peers) | readme_tables.quality_of(accuracy)
    figures |= readme_tables.partitions_of({"results": {"office_parts": parts, "another": parts}})
    section = readme_tables.to_section(figures)
    assert "| planes, `paper` | 1 | 3.0 | 1.0 | 3.0 | 1.0 |" in section
    assert "| normals, `pca` | 1 | 2.0 | 1.0 | 2.0 | 1.0 |" in section
    assert "| from file to file, `classic` | 1 | 2.3 | 1.0 | 2.3 | 1.0 |" in section
    assert (
        "| synthetic rooms, seven noise levels and densities | 0.70 | 0.30 | 0.30 | 0.30 |  |"
        in section
    )
    office = "real office, planar patches inside labeled parts"
    assert f"| {office} | 0.60 | 0.10 | 0.10 | 0.20 |  |" in section
    assert f"| {office}: mean IoU | 0.30 | 0.05 | 0.05 | 0.10 |  |" in section
    assert "| superpoints: office parts | 0.60 |  |  |  | 0.60 |" in section
