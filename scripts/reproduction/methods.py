"""The methods that are compared."""

from dataclasses import replace

from torchrg import load_config
from torchrg.config import PipelineConfig

METHODS = {
    "classic": "classic RG",
    "detmm": "DetMM",
    "paper": "paper",
    "paper@0.5": "paper, half shared",
    "consensus": "consensus",
}
"""Methods, and their names in tables.

A method is a preset, or a preset and the share of common neighbours that connects two points. The
paper asks for 75 % and says that it may be tuned; among points spread at random two neighbours on
one wall have less in common than in the even clouds of some scanners.
"""

DRAWN = tuple(method for method in METHODS if "@" not in method)
"""Those that the figures show."""


def settings_of(method: str) -> PipelineConfig:
    """Return the settings of a method: its preset's, with its own connectivity if it has one."""
    preset, _, connectivity = method.partition("@")
    settings = load_config(preset)
    if not connectivity:
        return settings
    return replace(settings, growing=replace(settings.growing, connectivity=float(connectivity)))
