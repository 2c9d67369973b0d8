"""Time of robust estimators per neighborhood, compared with other implementations.

python scripts/bench.py robust --scan scan.pcd
python scripts/bench.py robust --patches 10000
"""

import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from torch import Tensor, empty

import torchrg
from benchmarks.harness import Benchmark, Figures
from torchrg.linalg import covariance, eigh3
from torchrg.neighbors.knn import gather_patches
from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve, qn, qn_exceeds

K = 50
CHUNK = 65_536
"""Number of neighborhoods per eigenvalue computation."""
QN_LIMIT = 0.01
"""Threshold of the Qn test, in meters."""
R_SCRIPT = """
library(robustbase)
points <- as.matrix(read.csv("{file}", header = FALSE))
starts <- seq(1, nrow(points), by = {k})
seconds <- system.time(for (s in starts)
  try(covMcd(points[s:(s + {k} - 1), ], nsamp = "deterministic", alpha = 0.5), silent = TRUE))[3]
cat(seconds / length(starts) * 1e6)
"""


@dataclass(frozen=True)
class Case(Benchmark):
    rounds: int = 3
    scan: Path | None = None
    """Additional scan with neighborhoods."""
    patches: int = 100_000
    sample: int = 200
    """Number of neighborhoods for other implementations."""

    def clouds(self) -> Mapping[str, Callable[[], Tensor]]:
        few = max(self.patches // 4, 1)
        sets = {
            "edges of a synthetic room": lambda: edge_rich_patches(self._room(0.003), self.patches),
            "the same on a grid (ties)": lambda: _on_grid(
                edge_rich_patches(self._room(0.003), self.patches)[:few]
            ),
            "edges of an exact room": lambda: edge_rich_patches(self._room(0.0), few),
        }
        if self.scan is not None:
            scan, count = self.scan, self.patches
            sets[f"edges of {scan.stem}"] = lambda: edge_rich_patches(
                torchrg.read_cloud(scan).points, count
            )
        return sets

    def _room(self, noise: float) -> Tensor:
        num_points = max((4 if noise else 1) * self.patches, 2000)
        return torchrg.scenes.make_room(num_points, noise, seed=0).points

    def contenders(self) -> Mapping[str, Callable[[Tensor], Figures]]:
        runs: dict[str, Callable[[Tensor], Figures]] = {
            "Qn, a row of 50": lambda patches: _time(qn, _rows(patches)),
            "Qn above a threshold, a row": lambda patches: _time(
                lambda rows: qn_exceeds(rows, QN_LIMIT), _rows(patches)
            ),
        }
        for name, fit, part in (
            ("DetMCD, published starts", fit_detmcd, 1),
            ("DetMCD, starts from planes", partial(fit_detmcd, starts="planes"), 1),
            ("DetMCD, more starts", partial(fit_detmcd, starts="more"), 10),
            ("DetS", fit_dets, 10),
            ("DetMM", fit_detmm, 10),
            ("FastMCD, 500 starts", fit_fastmcd, 100),
            ("MVE, 500 starts", fit_mve, 100),
        ):
            runs[name] = lambda patches, fit=fit, part=part: _time(
                fit, patches[: max(len(patches) // part, 1)]
            )
        for name, fit_one in _other_implementations().items():
            runs[name] = lambda patches, fit=fit_one: _time(
                partial(_try_each, fit), self._subset(patches)
            )
        if shutil.which("Rscript"):
            runs["R robustbase covMcd"] = lambda patches: _time_r(self._subset(patches))
        return runs

    def _subset(self, patches: Tensor) -> Tensor:
        return patches[:: max(len(patches) // self.sample, 1)][: self.sample]


def edge_rich_patches(points: Tensor, count: int) -> Tensor:
    """Return the neighborhoods with the largest surface variation, shape ``(count, 50, 3)``."""
    neighbors = torchrg.search_knn(points, k=K).indices.long()
    variation = empty(len(points))
    for start in range(0, len(points), CHUNK):
        rows = slice(start, start + CHUNK)
        patches = gather_patches(points, neighbors[rows])
        values, _ = eigh3(covariance(patches)[1])
        variation[rows] = values[:, 0] / values.sum(dim=1)
    chosen = variation.nan_to_num(0).argsort(descending=True, stable=True)[:count]
    chosen = chosen.repeat(-(-count // len(chosen)))[:count].sort().values
    return (points[neighbors[chosen]] - points[chosen, None]).contiguous()


def _rows(patches: Tensor) -> Tensor:
    return patches.transpose(1, 2).reshape(-1, K).contiguous()


def _on_grid(patches: Tensor) -> Tensor:
    """Round neighborhoods to a 64th of their largest coordinate."""
    step = patches.abs().amax() / 64
    return (patches / step).round() * step


def _time(fit: Callable[[Tensor], object], batch: Tensor) -> Figures:
    begin = time.perf_counter()
    fit(batch)
    return {"us": 1e6 * (time.perf_counter() - begin) / len(batch), "of": len(batch)}


def _other_implementations() -> dict[str, Callable[[np.ndarray], object]]:
    """Return the installed Python implementations."""
    found: dict[str, Callable[[np.ndarray], object]] = {}
    if find_spec("sklearn"):
        from sklearn.covariance import MinCovDet

        found["scikit-learn MinCovDet"] = lambda patch: MinCovDet(random_state=0).fit(patch)
    if find_spec("statsmodels"):
        from statsmodels.robust.covariance import CovDetMCD

        found["statsmodels CovDetMCD"] = lambda patch: CovDetMCD(patch).fit(27)
    return found


def _try_each(fit: Callable[[np.ndarray], object], patches: Tensor) -> None:
    """Fit each neighborhood; failures are ignored, but their time counts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for patch in patches.double().numpy():
            try:
                fit(patch)
            except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
                continue


def _time_r(patches: Tensor) -> Figures | None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.csv"
        np.savetxt(file, patches.double().numpy().reshape(-1, 3), delimiter=",")
        command = ["Rscript", "-e", R_SCRIPT.format(file=file, k=K)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    return None if done.returncode else {"us": float(done.stdout.split()[-1]), "of": len(patches)}
