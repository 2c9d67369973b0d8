"""How many files a newcomer reads to follow a preset from points to planes."""

import functools
import re
from pathlib import Path

import pytest
import trace_path

trace = functools.cache(trace_path.trace)
README = Path(__file__).parents[2] / "README.md"


@pytest.mark.parametrize("preset", trace_path.LONGEST)
def test_path_of_a_preset_stays_short(preset):
    assert len(trace(preset)) <= trace_path.LONGEST[preset]


def test_readme_shows_the_path():
    (shown,) = re.findall(r"```text\n(.*? > .*?)\n```", README.read_text(), re.DOTALL)
    assert shown.splitlines() == trace_path.as_paragraph(trace("consensus"))
