"""How plots look."""

from contextlib import AbstractContextManager

import matplotlib as mpl

SETTINGS = {
    "font.family": "serif",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.3,
    "grid.color": "#dddddd",
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "legend.frameon": False,
    "savefig.dpi": 250,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.04,
}


def settings() -> AbstractContextManager[None]:
    """Return a context in which plots look like those of a paper."""
    return mpl.rc_context(SETTINGS)
