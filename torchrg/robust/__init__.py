"""Robust scale, location and scatter of many small point sets at once."""

from torchrg.robust.fastmcd import fit_fastmcd
from torchrg.robust.mcd import fit_detmcd
from torchrg.robust.mm import fit_detmm, fit_dets
from torchrg.robust.mve import fit_mve
from torchrg.robust.result import RobustFit
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
