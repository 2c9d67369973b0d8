"""The Ray engine: the same bytes as the local one, and no scan is lost with a node."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

from tests.batch.test_interruptions import results_of
from torchrg.batch.ray_tasks import run_ray
from torchrg.batch.run import list_jobs
from torchrg.batch.scans import convert_scan
from torchrg.batch.sources import CloudSource
from torchrg.config import load_config
from torchrg.datasets import FolderOfClouds
from torchrg.errors import ConfigError, MissingDependencyError

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")


def run_python(*arguments, **variables):
    """Run Python with the modules of this folder at hand, and return what it printed."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": f"{Path(__file__).parent}:{Path.cwd()}"} | variables,
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
    for job in list_jobs(
        CloudSource(FolderOfClouds(rooms), load_config("classic", **{"planes.up": "z"})), here
    ):
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


@needs_ray
@pytest.mark.slow
@pytest.mark.parametrize("address", ["ray://127.0.0.1:9", "auto"])
def test_ray_that_cannot_connect_is_one_line(address):
    with pytest.raises(ConfigError, match=f"Ray address {address}: no connection: ") as info:
        next(run_ray([], memory_limit=1, address=address))
    assert "\n" not in str(info.value)


@needs_ray
@pytest.mark.slow
def test_a_scan_above_the_memory_of_its_node_fails_after_three_attempts(tmp_path):
    script = """
import dataclasses, json, pathlib, sys
import faults
from torchrg.batch.ray_tasks import run_ray
folder = pathlib.Path(sys.argv[1])
jobs = faults.make_jobs(folder, {"1_a": "sleep 60"})
reports = [report for report in run_ray(jobs, workers=1, memory_limit=10**9) if report]
(folder / "reports.json").write_text(json.dumps([*map(dataclasses.asdict, reports)]))
"""
    limits = {"RAY_memory_usage_threshold": "0.01", "RAY_memory_monitor_refresh_ms": "100"}
    run_python("-c", script, tmp_path, **limits)
    (report,) = json.loads((tmp_path / "reports.json").read_text())
    assert report["status"] == "failed"
    assert report["attempts"] == 3
    assert report["reason"].startswith("the memory of its node ran out in 3 attempts")


@needs_ray
@pytest.mark.slow
def test_handlers_of_interrupts_stay(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    assert [*run_ray([], workers=1, memory_limit=10**9)] == []
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize("address", ["", "nowhere", "host:port", "127.0.0.1:99999999"])
def test_an_address_without_a_cluster_is_refused(address, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", ModuleType("ray"))
    with pytest.raises(ConfigError, match=f"Ray (address )?'?{address}'?: (expected|no cluster)"):
        next(run_ray([], memory_limit=1, address=address))


def test_an_address_where_nothing_listens_is_refused_at_once(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", ModuleType("ray"))
    with socket.socket() as bound:  # Bound, but not listening.
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
        with pytest.raises(ConfigError, match=f"ray start --head --port {port}"):
            next(run_ray([], memory_limit=1, address=f"127.0.0.1:{port}"))


def test_ray_is_asked_for_by_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[ray\]'"):
        next(run_ray([], memory_limit=1))
