"""The public names are those of tests/public_names.txt, and ``dir`` shows no others."""

import importlib
import inspect
from pathlib import Path

import pytest

import torchrg

FILE = Path(__file__).with_name("public_names.txt")
LISTED = {
    module: names.split()
    for module, _, names in (line.partition(":") for line in FILE.read_text().splitlines())
}


def test_every_public_module_is_listed():
    found = [getattr(torchrg, name) for name in dir(torchrg)]
    modules = {module.__name__ for module in found if inspect.ismodule(module)}
    assert modules == {name for name in LISTED if name.count(".") == 1}


@pytest.mark.parametrize("module", LISTED)
def test_names_are_listed(module):
    """A difference is a change of the API, which the changelog must name."""
    if module == "torchrg.metrics.modules":
        pytest.importorskip("torchmetrics")
    loaded = importlib.import_module(module)
    assert sorted(loaded.__all__) == LISTED[module]
    assert set(dir(loaded)) >= {*LISTED[module]}
    if module != "torchrg":
        assert dir(loaded) == LISTED[module]
    if module != "torchrg.batch":  # Its names are modules.
        assert all(hasattr(loaded, name) for name in LISTED[module])


def test_signatures_show_the_names_of_types():
    for function in (torchrg.segment_planes, torchrg.estimate_normals, torchrg.grow_regions):
        text = str(inspect.signature(function))
        assert "Points" in text
        assert "numpy" not in text
        assert "typing" not in text
