"""The examples of the guide to other libraries run where the library is installed."""

import re

import guide_pages
import numpy as np
import pytest

PAGE = (guide_pages.GUIDES / "bridges.md").read_text()
START, *SECTIONS = re.split(r"^### ", PAGE, flags=re.MULTILINE)
EXAMPLES = {section.splitlines()[0]: section for section in SECTIONS}
BLOCK = re.compile(r"^```py\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def run_example(title, folder, monkeypatch):
    """Return the names that the example of a library leaves."""
    monkeypatch.chdir(folder)
    names = {"__name__": "bridges"}
    exec("".join(BLOCK.findall(START) + BLOCK.findall(EXAMPLES[title])), names)
    return names


def test_pyvista_reads_labels(tmp_path, monkeypatch):
    pyvista = pytest.importorskip("pyvista")
    names = run_example("PyVista", tmp_path, monkeypatch)
    assert np.array_equal(pyvista.read("planes.vtp")["plane"], names["seg"].labels.numpy())


def test_rerun_writes_a_recording(tmp_path, monkeypatch):
    rerun = pytest.importorskip("rerun")
    run_example("rerun", tmp_path, monkeypatch)
    rerun.disconnect()
    assert (tmp_path / "planes.rrd").stat().st_size > 4_000 * 12


def test_pandas_lists_the_planes(tmp_path, monkeypatch):
    pytest.importorskip("pandas")
    names = run_example("pandas", tmp_path, monkeypatch)
    assert names["table"]["area"].tolist() == names["seg"].planes.area.tolist()
