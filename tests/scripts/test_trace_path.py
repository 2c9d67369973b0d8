"""How many files a newcomer reads to follow a preset from points to planes."""

import sys

import pytest
import trace_path

from torchrg import kernels


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 names no methods in a trace")
@pytest.mark.skipif(kernels.name_of_library() is None, reason="needs the kernels")
@pytest.mark.parametrize("preset", trace_path.MAX_FILES)
def test_path_of_a_preset_stays_short(preset, monkeypatch):
    # The same files as of twice as many points.
    monkeypatch.setattr(trace_path, "NUM_POINTS", 4000)
    assert len(trace_path.trace(preset)) <= trace_path.MAX_FILES[preset]
