"""Breakdown of robust fits: angle of the fitted normal under contamination.

python scripts/bench.py breakdown
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Figures, Results, markdown, medians
from tests.made import OUTLIERS, contaminated
from torchrg.linalg import covariance, eigh3, unsigned_angle_deg
from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve

SEED = 0
FRACTIONS = (0.0, 0.1, 0.3, 0.45)
FITS: dict[str, Callable[[Tensor], Tensor]] = {
    "PCA": lambda patches: covariance(patches)[1],
    "DetMCD": lambda patches: fit_detmcd(patches).covariance,
    "planes": lambda patches: fit_detmcd(patches, starts="planes").covariance,
    "more": lambda patches: fit_detmcd(patches, starts="more").covariance,
    "FastMCD": lambda patches: fit_fastmcd(patches).covariance,
    "MVE": lambda patches: fit_mve(patches).covariance,
    "DetS": lambda patches: fit_dets(patches).covariance,
    "DetMM": lambda patches: fit_detmm(patches).covariance,
}
"""Covariance estimators; "planes" and "more" are starts of DetMCD."""


@dataclass(frozen=True)
class Case(Benchmark):
    patches: int = 200
    """Number of patches per kind and fraction of outliers."""

    def clouds(self) -> Mapping[str, Callable[[], tuple[Tensor, Tensor]]]:
        return {
            f"{kind} {fraction:.0%}": lambda kind=kind, fraction=fraction: contaminated(
                kind, fraction, torch.Generator().manual_seed(SEED), self.patches
            )
            for kind in OUTLIERS
            for fraction in FRACTIONS
        }

    def contenders(self) -> Mapping[str, Callable[[tuple[Tensor, Tensor]], Figures]]:
        return {name: partial(_angles, fit) for name, fit in FITS.items()}

    def report(self, results: Results) -> str:
        """Return medians and 90th percentiles, one column per fit."""
        rows = [
            [cloud, *("{median:.1f} / {p90:.1f}".format(**medians(runs)) for runs in by.values())]
            for cloud, by in results.items()
        ]
        names = next(iter(results.values()))
        title = "Angle of the normal, degrees: median / 90th percentile\n\n"
        return title + markdown(["outliers", *names], rows)


def _angles(fit: Callable[[Tensor], Tensor], cloud: tuple[Tensor, Tensor]) -> Figures:
    patches, ground_truth = cloud
    normals = eigh3(fit(patches).double())[1][..., 0]
    angles = unsigned_angle_deg(normals, ground_truth.double())
    return {"median": float(angles.median()), "p90": float(angles.quantile(0.9))}
