"""Options, devices and dtypes shared by all tests."""

import gc
from pathlib import Path

import pytest
import torch

SCANS = Path(__file__).parents[2] / "shared" / "data"
ORACLES = Path(__file__).parents[2] / "shared" / "oracles"
POINTCEPT = Path(__file__).parents[2] / "shared" / "pointcept"


def pytest_addoption(parser):
    usual = "all" if torch.cuda.is_available() else "cpu"
    parser.addoption("--device", default=usual, help="cpu, cuda or all")
    parser.addoption("--run-slow", action="store_true", help="run the tests marked slow too")


def pytest_collection_modifyitems(config, items):
    if config.getoption("--run-slow"):
        return
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="slow; run with --run-slow"))


def pytest_collection_finish():
    """Leave what lives as long as the tests out of each search for garbage."""
    gc.collect()
    gc.freeze()


def pytest_generate_tests(metafunc):
    if "device" in metafunc.fixturenames:
        asked = metafunc.config.getoption("--device")
        names = ["cpu", "cuda"] if asked == "all" else [asked]
        marks = [pytest.mark.cuda]
        if not torch.cuda.is_available():
            marks.append(pytest.mark.skip(reason="no CUDA device"))
        metafunc.parametrize(
            "device", [pytest.param(n, marks=marks if n == "cuda" else []) for n in names]
        )
    if "dtype" in metafunc.fixturenames:
        metafunc.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def scan():
    """Path of a real scan by name; the test is skipped where the scans are absent."""

    def path_of(name):
        path = SCANS / name
        if not path.exists():
            pytest.skip(f"needs the real scan {name}")
        return path

    return path_of


@pytest.fixture
def oracles_folder():
    """Folder of reference values; the test is skipped where it is absent."""
    if not ORACLES.exists():
        pytest.skip("needs the reference values of other implementations")
    return ORACLES


@pytest.fixture(scope="session")
def pointcept_folder():
    """Folder of Pointcept's own data pipeline; the test is skipped where it is absent."""
    if not POINTCEPT.exists():
        pytest.skip("needs the data pipeline of Pointcept")
    return POINTCEPT
