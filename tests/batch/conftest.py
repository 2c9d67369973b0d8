"""What the tests of batches share."""

import importlib
import sys
from pathlib import Path

import pytest


@pytest.fixture
def faults(monkeypatch):
    """The module of faulty scans, where worker processes find it too."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    yield importlib.import_module("faults")
    sys.modules.pop("faults")
