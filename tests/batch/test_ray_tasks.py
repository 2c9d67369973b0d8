"""The Ray engine: the same bytes as the local one, and no scan is lost with a node."""

import json
import os
import subprocess
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.batch.test_interruptions import results_of
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds
from torchrg.errors import MissingDependencyError

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")


def run_python(*arguments):
    """Run Python with the modules of this folder at hand, and return what it printed."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_ray
@pytest.mark.slow
def test_ray_gives_the_bytes_of_one_process(folder_of_clouds, tmp_path):
    rooms, out, here = folder_of_clouds("a.npz", "b.npz", "c.ply"), tmp_path / "out", tmp_path / "h"
    options = ("--preset", "classic", "--engine", "ray", "--workers", "2")
    shown = run_python("-m", "torchrg", "convert", "folder", rooms, out, *options)
    assert "3 of 3 scans are complete" in shown
    for job in list_jobs(CloudSource(FolderOfClouds(rooms), load_config("classic")), here):
        convert_scan(job)
    assert results_of(out) == results_of(here)
    assert json.loads((out / "report.json").read_text())["engine"] == "ray"


@needs_ray
@pytest.mark.slow
def test_a_lost_node_loses_no_scan(tmp_path):
    run_python(Path(__file__).with_name("lose_node.py"), tmp_path)
    reports = json.loads((tmp_path / "reports.json").read_text())
    status = {report["name"]: report["status"] for report in reports}
    assert status.pop("8_c") == "failed"
    assert len(status) == len(reports) - 1 == 7
    assert set(status.values()) == {"converted"}
    lines = (tmp_path / "log").read_text().splitlines()
    begun = Counter(line.split()[0] for line in lines if not line.endswith("done"))
    assert begun["9_b"] == 2
    assert max(begun[name] for name in status if name != "9_b") == 2


@needs_ray
@pytest.mark.slow
def test_a_scan_whose_worker_dies_each_time_fails_with_its_cause_and_leaves_nothing(tmp_path):
    script = """
import dataclasses, json, pathlib, sys
import faults
from torchrg.batch.ray_tasks import run_ray
folder = pathlib.Path(sys.argv[1])
jobs = faults.make_jobs(folder, {"9_a": "kill while writing", "8_b": "kill once", "7_c": "plain"})
reports = [report for report in run_ray(jobs, workers=2, memory_limit=10**10) if report]
(folder / "reports.json").write_text(json.dumps([*map(dataclasses.asdict, reports)]))
"""
    run_python("-c", script, tmp_path)
    reports = {r["name"]: r for r in json.loads((tmp_path / "reports.json").read_text())}
    failed = {name for name, report in reports.items() if report["status"] == "failed"}
    assert failed == {"9_a"}
    assert reports["9_a"]["reason"].startswith("WorkerCrashedError: The worker died unexpectedly")
    assert sorted(results_of(tmp_path / "out")) == [
        f"{name}/{file}" for name in ("7_c", "8_b") for file in ("provenance.json", "result.txt")
    ]
    assert not [*(tmp_path / "out").rglob(".result.*")]


def test_ray_is_asked_for_by_name(monkeypatch):
    from torchrg.batch.ray_tasks import run_ray

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[ray\]'"):
        next(run_ray([], memory_limit=1))
