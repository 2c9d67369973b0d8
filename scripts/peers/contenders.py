"""Who is compared, and one timed run of one of them."""

import json
import os
import re
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from peers.worker import CONTENDERS, K

_SCRIPTS = Path(__file__).parents[1]
_MAX_ANGLE_DEG, _CURVATURE_PERCENTILE, _MIN_SIZE = 5, 95, 50


class Run(NamedTuple):
    """What one run took.

    Attributes:
        seconds: By stage, and ``total`` of the stages.
        whole_seconds: From the start of the process to its end.
        peak_mib: Most memory the process had, in MiB.
    """

    seconds: dict[str, float]
    whole_seconds: float
    peak_mib: float


def write_cloud_files(cloud: str, folder: Path) -> None:
    """Write a cloud in the forms that the contenders read."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        [sys.executable, "-m", "peers.clouds", cloud, str(folder)],
        check=True,
        env={**os.environ, "PYTHONPATH": str(_SCRIPTS)},
    )


def available(peers: Path | None) -> list[str]:
    """Return the names of the contenders that are installed here."""
    names = [name for name in CONTENDERS if not name.startswith("open3d") or _has("open3d")]
    names += [f"{name}-command" for name in ("torchrg-classic", "torchrg-paper")]
    names.append("torchrg-consensus-command")
    if peers is not None:
        names += [name for name in ("pclrg", "cgaln") if (peers / name).exists()]
    return names


def run_once(name: str, folder: Path, peers: Path | None, threads: int) -> Run:
    """Run a contender once on the cloud of a folder, in a process of its own.

    Raises:
        RuntimeError: If it fails.
    """
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": str(threads),
        "PYTHONPATH": str(_SCRIPTS),
    }
    begin = time.perf_counter()
    process = subprocess.Popen(
        _command(name, folder, peers), stdout=subprocess.PIPE, text=True, env=environment
    )
    text = process.stdout.read() if process.stdout else ""
    _, status, usage = os.wait4(process.pid, 0)
    whole = time.perf_counter() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{name}: exit code {process.returncode}: {text}")
    seconds = _seconds(name, text, whole)
    seconds["total"] = sum(seconds.values())
    return Run(seconds, whole, usage.ru_maxrss / 1024)


def _command(name: str, folder: Path, peers: Path | None) -> list[str]:
    if name == "pclrg":
        settings = [K, _MAX_ANGLE_DEG, _CURVATURE_PERCENTILE, _MIN_SIZE]
        arguments = [folder / "cloud.f32", *settings, folder / "labels.i32"]
        return [str(part) for part in (Path(peers or ".") / name, *arguments)]
    if name == "cgaln":
        # CGAL adds the point itself.
        return [str(part) for part in (Path(peers or ".") / name, folder / "cloud.f32", K - 1)]
    if name.endswith("-command"):
        preset = name.split("-")[1]
        files = [str(folder / "cloud.npy"), "--out", str(folder / f"{preset}.npz")]
        return [sys.executable, "-m", "torchrg", "segment", *files, "--preset", preset]
    return [sys.executable, "-m", "peers.worker", name, str(folder / "cloud.npy")]


def _seconds(name: str, text: str, whole: float) -> dict[str, float]:
    """Read what a run printed about its stages."""
    if name in ("pclrg", "cgaln"):
        found = re.findall(r"([a-z][a-z ]*?) (\d+\.\d+) s", text)
        stages = {"region growing": "regions"}
        return {stages.get(stage, stage): float(value) for stage, value in found}
    if name.endswith("-command"):
        return {"command": whole}
    result: dict[str, Any] = json.loads(text.splitlines()[-1])
    return {stage: float(value) for stage, value in result.items()}


def _has(module: str) -> bool:
    return find_spec(module) is not None
