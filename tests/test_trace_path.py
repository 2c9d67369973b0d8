"""How many files a newcomer reads to follow a preset from points to planes."""

import re
from pathlib import Path

import pytest
import trace_path

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.parametrize("preset", trace_path.LONGEST)
def test_path_of_a_preset_stays_short(preset):
    assert len(trace_path.trace(preset)) <= trace_path.LONGEST[preset]


def test_readme_shows_the_path():
    (shown,) = re.findall(r"```text\n(pipeline\.py .*?)\n```", README.read_text(), re.DOTALL)
    assert shown.splitlines() == trace_path.as_lines(trace_path.trace("consensus"))
