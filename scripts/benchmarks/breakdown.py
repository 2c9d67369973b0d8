"""What outliers do to robust fits: the angle of the fitted plane's normal under contamination.

python scripts/bench.py breakdown
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Figures, Results, markdown, medians
from torchrg.linalg import covariance, eigh3, unsigned_angle_deg
from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve

K = 50
SHARES = (0.0, 0.1, 0.3, 0.45)
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
"""Covariances; "planes" and "more" are starts of DetMCD."""


@dataclass(frozen=True)
class Case(Benchmark):
    """Measure the breakdown of robust fits."""

    patches: int = 200
    """Of each kind and share of outliers."""

    def clouds(self) -> Mapping[str, Callable[[], tuple[Tensor, Tensor]]]:
        """Return neighbourhoods by kind and share of their outliers."""
        return {
            f"{kind} {share:.0%}": partial(contaminate, kind, share, self.patches)
            for kind in ("cluster", "shell", "far")
            for share in SHARES
        }

    def contenders(self) -> Mapping[str, Callable[[tuple[Tensor, Tensor]], Figures]]:
        """Return the fits."""
        return {name: partial(_angles, fit) for name, fit in FITS.items()}

    def report(self, results: Results) -> str:
        """Return medians and 90th percentiles, a column for each fit."""
        rows = [
            [cloud, *("{median:.1f} / {p90:.1f}".format(**medians(runs)) for runs in by.values())]
            for cloud, by in results.items()
        ]
        names = next(iter(results.values()))
        title = "Angle of the normal, degrees: median / 90th percentile\n\n"
        return title + markdown(["outliers", *names], rows)


def contaminate(kind: str, share: float, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return noisy planes of 50 points, turned at random, a share outliers, and their normals."""
    draw = torch.Generator().manual_seed(seed)
    patches = torch.rand(count, K, 3, generator=draw) - 0.5
    patches[..., 2] = 0.01 * torch.randn(count, K, generator=draw)
    number = round(share * K)
    normal = torch.randn(count, number, 3, generator=draw)
    if kind == "cluster":
        outliers = torch.tensor([0.2, 0.1, 0.4]) + 0.05 * normal
    elif kind == "shell":
        outliers = 0.5 * normal / normal.norm(dim=-1, keepdim=True)
    else:
        outliers = torch.tensor([5.0, 5.0, 10.0]) + normal
    patches[:, :number] = outliers
    turn = torch.linalg.qr(torch.randn(count, 3, 3, generator=draw)).Q
    return patches @ turn, turn[:, 2]


def _angles(fit: Callable[[Tensor], Tensor], cloud: tuple[Tensor, Tensor]) -> Figures:
    patches, truth = cloud
    normals = eigh3(fit(patches).double())[1][..., 0]
    angles = unsigned_angle_deg(normals, truth.double())
    return {"median": float(angles.median()), "p90": float(angles.quantile(0.9))}
