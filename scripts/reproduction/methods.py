"""The methods that are compared."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from torchrg import load_config
from torchrg.config import PipelineConfig


class Method(NamedTuple):
    """A way to segment a cloud: its name in tables, and its preset."""

    title: str
    preset: str


METHODS = {
    "pcl": Method("classic (PCL)", "classic"),
    "classic": Method("classic", "classic_increment"),
    "detmm": Method("DetMM", "detmm"),
    "printed": Method("Algorithm 2", "algorithm2"),
    "paper": Method("paper", "paper"),
    "consensus": Method("consensus", "consensus"),
}
"""Methods by key.

The paper compares all methods under its own description of region growing (II.B), in which a seed
is chosen by the increment of the curvature; PCL's ``RegionGrowing`` tests the curvature itself.
Algorithm 2 drops unconnected neighbours; the text of the paper says three times that they join and
only do not become seeds.
"""

PAPERS = ("classic", "detmm", "paper")
"""The three of the paper, in the order in which it finds them to rise."""

DRAWN = (*PAPERS, "consensus")
"""Those that the figures show."""


def settings_of(method: str) -> PipelineConfig:
    """Return the settings of a method."""
    return load_config(METHODS[method].preset)


def titles(methods: Mapping[str, Any]) -> list[str]:
    """Return the names of some methods."""
    return [METHODS[method].title for method in methods]
