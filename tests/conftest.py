"""What all tests share: options, devices, dtypes, rooms, folders of clouds, the command line."""

import functools
import gc
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from tests import pretend
from torchrg.batch.scans import convert_scan
from torchrg.cli import main
from torchrg.io import write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud

collect_ignore = ["scripts/first_batch.py"]  # Imports a deprecated function of torch.
ORACLES = Path(__file__).parent / "oracles"


def pytest_addoption(parser):
    usual = "all" if torch.cuda.is_available() else "cpu"
    parser.addoption("--device", default=usual, help="cpu, cuda, pretend or all")
    parser.addoption("--run-slow", action="store_true", help="run the tests marked slow too")


def pytest_configure(config):
    """Register the pretend device before the tests that ask for it."""
    if config.getoption("--device") == "pretend":
        pretend.load()


def pytest_ignore_collect(collection_path, config):
    """Leave the checks of the pretend device to the process that has it."""
    is_check = collection_path.parent.name == "pretend"
    return True if is_check and config.getoption("--device") != "pretend" else None


def pytest_collection_modifyitems(config, items):
    """Leave out slow tests; a skipped test is one that this machine cannot run."""
    if config.getoption("--run-slow"):
        return
    slow = [item for item in items if "slow" in item.keywords]
    if slow:
        items[:] = [item for item in items if "slow" not in item.keywords]
        config.hook.pytest_deselected(items=slow)


def pytest_collection_finish():
    """Leave what lives as long as the tests out of each search for garbage."""
    gc.collect()
    gc.freeze()


def on_cuda():
    """Return the parameter of tests on CUDA, which are skipped without it."""
    skip = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    return pytest.param("cuda", marks=[pytest.mark.cuda, skip])


def pytest_generate_tests(metafunc):
    asked, cuda = metafunc.config.getoption("--device"), on_cuda()
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", {"all": ["cpu", cuda], "cuda": [cuda]}.get(asked, [asked]))
    if "accelerator" in metafunc.fixturenames:  # For what is compared with the CPU.
        metafunc.parametrize("accelerator", [asked if asked == "pretend" else cuda])
    if "dtype" in metafunc.fixturenames:
        metafunc.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def set_threads():
    """``set_threads(n)``: torch works in n threads, until the end of the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def scan():
    """``scan(name)``: path of a real scan."""
    return (ORACLES / "scans").joinpath


@pytest.fixture
def oracles_folder():
    """Folder of reference values of other implementations."""
    return ORACLES


@functools.cache
def _room(num_points, noise, seed, layout):
    return make_room(num_points, noise, seed, layout=layout)


def copied_room(num_points=8000, noise=0.003, seed=1, layout=None):
    """Return a made room whose tensors a test may change; rooms with equal arguments are equal."""
    scene = _room(num_points, noise, seed, layout)
    return scene._replace(
        points=scene.points.clone(), labels=scene.labels.clone(), normals=scene.normals.clone()
    )


@pytest.fixture(scope="session")
def room():
    """``room(num_points, noise, seed, layout)``: a made room, each made once in a session."""
    return copied_room


@pytest.fixture(scope="session")
def folder_of_clouds(tmp_path_factory):
    """``folder_of_clouds("a.ply", "b/c.npz")``: a new folder of rooms with labels and normals."""

    def write(*names, num_points=2000):
        folder = tmp_path_factory.mktemp("clouds")
        for seed, name in enumerate(names):
            scene = copied_room(num_points, seed=seed)
            fields = {"labels": scene.labels.numpy(), "normals": scene.normals.numpy()}
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_cloud(folder / name, Cloud(scene.points.numpy(), fields))
        return folder

    return write


class Run(NamedTuple):
    """What a command did: its exit code, and all that it wrote on stdout and on stderr."""

    code: int
    out: str
    err: str

    @property
    def error(self):
        """The one line that a refused command wrote on stderr."""
        assert self.code != 0, self.out
        assert self.err.count("\n") == 1, self.err
        return self.err


def convert_here(jobs, *, workers, memory_limit):
    """Stand for the engine of ``torchrg convert``: scans one by one, in this process."""
    return (convert_scan(job) for job in jobs)


@pytest.fixture
def in_workers():
    """For tests whose subject are the worker processes of ``torchrg convert``."""


@pytest.fixture(autouse=True)
def _without_workers(request, monkeypatch):
    """Let commands convert in this process: a worker takes seconds to load torch."""
    if "in_workers" not in request.fixturenames:
        monkeypatch.setattr("torchrg.cli.convert.run_local", convert_here)


@pytest.fixture
def run(capsys):
    """``run("segment", path, "--out", out)``: a command of torchrg, in this process."""

    def call(*arguments):
        capsys.readouterr()
        code = main([*map(str, arguments)])
        return Run(code, *capsys.readouterr())

    return call


@pytest.fixture
def make_cloud():
    """A cloud with a field of every kind that all formats hold."""

    def make(num_points=60, dtype=np.float32, origin=(0.0, 0.0, 0.0), **options):
        rng = np.random.default_rng(0)
        normals = rng.normal(size=(num_points, 3)).astype(np.float32)
        fields = {
            "color": rng.integers(0, 256, (num_points, 3)).astype(np.uint8),
            "intensity": rng.random(num_points).astype(np.float32),
            "labels": rng.integers(-1, 5, num_points),
            "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
            "curvature": (rng.random(num_points) / 3).astype(np.float32),
            "histogram": rng.random((num_points, 4)).astype(np.float32),
            "ring": rng.integers(0, 200, num_points).astype(np.uint8),
        }
        coordinates = (rng.normal(size=(num_points, 3)) + np.array(origin)).astype(dtype)
        return Cloud(coordinates, fields, **options)

    return make
