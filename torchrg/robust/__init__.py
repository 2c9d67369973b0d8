"""Robust scale, location and scatter of many small point sets.

Breakdown points are measured by ``python scripts/bench.py breakdown``. All estimators tolerate
distant outliers, and outliers in a shell around the patch, up to 45 % except DetMM. A compact
cluster of 30 % breaks DetMCD, DetS and DetMM, whose published starts use the coordinate axes.
FastMCD tolerates it, and :func:`fit_detmcd` with ``starts="planes"`` even 45 % near a flat patch
of three coordinates, where FastMCD finds a determinant smaller than that of the plane: 22
coinciding points and five others. ``starts="planes"`` and :func:`fit_mve` are for such patches;
use the default starts for points of more coordinates.
"""

from torchrg.robust.mcd import fit_detmcd, fit_fastmcd
from torchrg.robust.mm import fit_detmm, fit_dets
from torchrg.robust.mve import fit_mve
from torchrg.robust.patches import RobustFit
from torchrg.robust.scale import mad, median, qn, qn_exceeds, tau

__all__ = [
    "RobustFit",
    "fit_detmcd",
    "fit_detmm",
    "fit_dets",
    "fit_fastmcd",
    "fit_mve",
    "mad",
    "median",
    "qn",
    "qn_exceeds",
    "tau",
]
__dir__ = __all__.copy
