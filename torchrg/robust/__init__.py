"""Robust scale, location and scatter of many small point sets at once.

Breakdown: angle of the normal of noisy planes of 50 points, turned at random, with a share of
outliers, in degrees, median / 90th percentile over 200 patches
(``python scripts/bench.py breakdown``). The clusters are compact (0.05 beside an extent of
1 and a noise of 0.01), the shells surround the patch, the far points lie ten extents away.

| outliers      |         PCA |      DetMCD |      planes |     FastMCD |        DetS |       DetMM|
|---|---|---|---|---|---|---|
| none          |   0.3 / 0.6 |   0.5 / 1.0 |   0.6 / 1.2 |   0.7 / 1.3 |   0.4 / 0.8 |   0.3 / 0.6|
| cluster, 10 % |  7.5 / 10.4 |   0.5 / 0.9 |   0.5 / 1.0 |   0.5 / 1.2 |   0.4 / 0.8 |   0.4 / 0.6|
| cluster, 30 % | 26.0 / 33.6 | 37.8 / 79.1 |   0.4 / 0.9 |   0.4 / 0.9 | 39.9 / 77.8 | 23.0 / 35.1|
| cluster, 45 % | 37.7 / 47.5 | 70.3 / 85.7 |   0.5 / 0.8 | 63.4 / 83.6 | 65.7 / 84.0 | 46.9 / 66.2|
| shell, 10 %   |   2.6 / 5.0 |   0.5 / 1.1 |   0.5 / 1.0 |   0.6 / 1.2 |   0.4 / 0.8 |   0.4 / 0.7|
| shell, 30 %   |  5.5 / 12.2 |   0.5 / 0.9 |   0.5 / 1.0 |   0.5 / 0.9 |   0.5 / 0.8 |   0.5 / 0.9|
| shell, 45 %   |  8.4 / 19.3 |   0.5 / 1.1 |   0.5 / 1.1 |   0.5 / 1.1 |   0.6 / 1.2 |  4.5 / 14.6|
| far, 10 %     | 60.6 / 81.4 |   0.5 / 1.0 |   0.5 / 1.0 |   0.5 / 1.2 |   0.4 / 0.8 |   0.4 / 0.6|
| far, 30 %     | 64.0 / 82.8 |   0.4 / 0.8 |   0.4 / 0.9 |   0.4 / 0.9 |   0.4 / 0.7 |   0.4 / 0.7|
| far, 45 %     | 63.5 / 82.9 |   0.5 / 0.8 |   0.5 / 0.8 |   0.5 / 0.8 |   0.5 / 0.8 |   0.5 / 0.8|

The published starts of DetMCD, DetS and DetMM look along the coordinate axes, and a cluster can
draw them all. Where FastMCD fails it has found a smaller determinant than the plane's: 22 points in
one place and five others. ``planes`` is :func:`fit_detmcd` with ``starts="planes"``.
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
