"""How many files a newcomer reads to follow a preset from points to planes."""

import functools

import pytest
import trace_path

trace = functools.cache(trace_path.trace)


@pytest.mark.parametrize("preset", trace_path.LONGEST)
def test_path_of_a_preset_stays_short(preset):
    assert len(trace(preset)) <= trace_path.LONGEST[preset]
