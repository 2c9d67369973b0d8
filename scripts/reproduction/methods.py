"""The methods that are compared."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from torchrg import load_config
from torchrg.config import PipelineConfig


class Method(NamedTuple):
    """A way to segment a cloud.

    Attributes:
        title: Its name in tables.
        preset: The preset that it starts from.
        growing: Settings of growth in which it differs.
    """

    title: str
    preset: str
    growing: Mapping[str, Any] = {}


METHODS = {
    "pcl": Method("classic (PCL)", "classic"),
    "classic": Method("classic (paper)", "classic", {"seed_rule": "increment"}),
    "detmm": Method("DetMM", "detmm", {"seed_rule": "increment"}),
    "printed": Method("paper as printed", "paper", {"connectivity_scope": "region"}),
    "paper": Method("paper", "paper"),
    "consensus": Method("consensus", "consensus"),
}
"""Methods by key.

The paper compares all methods under its own description of region growing (II.B), in which a seed
is chosen by the increment of the curvature; PCL's ``RegionGrowing`` tests the curvature itself.
"As printed" is Algorithm 2, which drops unconnected neighbours; the text of the paper says three
times that they join and only do not become seeds.
"""

PAPERS = ("classic", "detmm", "paper")
"""The three of the paper, in the order in which it finds them to rise."""

DRAWN = (*PAPERS, "consensus")
"""Those that the figures show."""


def settings_of(method: str) -> PipelineConfig:
    """Return the settings of a method: its preset's, and where it differs its own."""
    _, preset, growing = METHODS[method]
    settings = load_config(preset)
    return replace(settings, growing=replace(settings.growing, **growing))


def titles(methods: Mapping[str, Any]) -> list[str]:
    """Return the names of some methods."""
    return [METHODS[method].title for method in methods]
