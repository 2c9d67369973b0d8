"""Time the robust estimators on real and made neighbourhoods, beside other implementations.

Examples:
    python scripts/bench_robust.py --scan scan.pcd
    python scripts/bench_robust.py --patches 10000 --breakdown
"""

import argparse
import platform
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchrg
from torchrg.linalg import covariance, eigh3
from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve, qn, qn_exceeds

K = 50
R_SCRIPT = """
library(robustbase)
points <- as.matrix(read.csv("{file}", header = FALSE))
starts <- seq(1, nrow(points), by = {k})
seconds <- system.time(for (s in starts)
  try(covMcd(points[s:(s + {k} - 1), ], nsamp = "deterministic", alpha = 0.5), silent = TRUE))[3]
cat(seconds / length(starts) * 1e6)
"""


def edge_rich_patches(points: Tensor, count: int) -> Tensor:
    """Neighbourhoods with the largest surface variation, shape ``(count, 50, 3)``."""
    neighbors = torchrg.search_knn(points, k=K).indices.long()
    variation = torch.empty(len(points))
    for rows in torch.arange(len(points)).split(65536):
        values, _ = eigh3(covariance(points[neighbors[rows]] - points[rows, None])[1])
        variation[rows] = values[:, 0] / values.sum(dim=1)
    chosen = variation.nan_to_num(0).argsort(descending=True, stable=True)[:count]
    chosen = chosen.repeat(-(-count // len(chosen)))[:count].sort().values
    return (points[neighbors[chosen]] - points[chosen, None]).contiguous()


def patch_sets(scan: Path | None, count: int) -> dict[str, Tensor]:
    """Patches by name: a scan, a made room, the same with ties, and exact edges."""
    sets = {}
    if scan is not None:
        sets[f"edges of {scan.stem}"] = edge_rich_patches(torchrg.read_cloud(scan).points, count)
    room = torchrg.scenes.make_room(num_points=max(4 * count, 2000), seed=0)
    sets["edges of a made room"] = edge_rich_patches(torch.as_tensor(room.points).float(), count)
    few = sets["edges of a made room"][: max(count // 4, 1)]
    step = few.abs().amax() / 64
    sets["the same on a grid (ties)"] = (few / step).round() * step
    clean = torchrg.scenes.make_room(num_points=max(count, 2000), noise=0.0, seed=0)
    sets["edges of an exact room"] = edge_rich_patches(
        torch.as_tensor(clean.points).float(), max(count // 4, 1)
    )
    return sets


def microseconds(work: Callable[[], object], count: int, repeats: int = 3) -> float:
    """Best time of a few runs, for each of ``count`` items."""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best / count * 1e6


def time_torchrg(patches: Tensor) -> None:
    """Print the time of each estimator for each patch."""
    rows = patches.transpose(1, 2).reshape(-1, K).contiguous()
    report("Qn, a row of 50", microseconds(lambda: qn(rows), len(rows)))
    report("Qn above a threshold, a row", microseconds(lambda: qn_exceeds(rows, 0.01), len(rows)))
    some, few = patches[: max(len(patches) // 10, 1)], patches[: max(len(patches) // 100, 1)]
    for name, fit, batch in (
        ("DetMCD, published starts", fit_detmcd, patches),
        ("DetMCD, starts from planes", lambda p: fit_detmcd(p, starts="planes"), patches),
        ("DetMCD, more starts", lambda p: fit_detmcd(p, starts="more"), some),
        ("DetS", fit_dets, some),
        ("DetMM", fit_detmm, some),
        ("FastMCD, 500 starts", fit_fastmcd, few),
        ("MVE, 500 starts", fit_mve, few),
    ):
        report(name, microseconds(lambda f=fit, b=batch: f(b), len(batch), 2))


def time_others(patches: Tensor) -> None:
    """Print the time of other implementations on a sample, where they are installed."""
    sample = patches.double().numpy()
    try:
        from sklearn.covariance import MinCovDet
    except ImportError:
        pass
    else:
        run = attempts(lambda x: MinCovDet(random_state=0).fit(x), sample)
        report("scikit-learn MinCovDet", microseconds(run, len(sample), 1))
    try:
        from statsmodels.robust.covariance import CovDetMCD
    except ImportError:
        pass
    else:
        run = attempts(lambda x: CovDetMCD(x).fit(27), sample)
        report("statsmodels CovDetMCD", microseconds(run, len(sample), 1))
    if shutil.which("Rscript"):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "points.csv"
            np.savetxt(file, sample.reshape(-1, 3), delimiter=",")
            done = subprocess.run(
                ["Rscript", "-e", R_SCRIPT.format(file=file, k=K)],
                capture_output=True,
                text=True,
                check=False,
            )
        if done.returncode == 0:
            report("R robustbase covMcd", float(done.stdout.split()[-1]))


def attempts(fit: Callable[[np.ndarray], object], sample: np.ndarray) -> Callable[[], None]:
    """Fit each patch of a sample; patches that the implementation refuses count as tried."""

    def run() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for patch in sample:
                try:
                    fit(patch)
                except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
                    continue

    return run


def report(name: str, value: float) -> None:
    """Print one line of the table."""
    print(f"  {name:32s} {value:12.2f} us")


def contaminate(kind: str, share: float, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Noisy planes of 50 points, turned at random, a share of them outliers; their normals."""
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


def print_breakdown(count: int) -> None:
    """Print the median and the 90th percentile of the angle of the fitted plane's normal."""
    fits = {
        "PCA": lambda p: covariance(p)[1],
        "DetMCD": lambda p: fit_detmcd(p).covariance,
        "planes": lambda p: fit_detmcd(p, starts="planes").covariance,
        "more": lambda p: fit_detmcd(p, starts="more").covariance,
        "FastMCD": lambda p: fit_fastmcd(p).covariance,
        "MVE": lambda p: fit_mve(p).covariance,
        "DetS": lambda p: fit_dets(p).covariance,
        "DetMM": lambda p: fit_detmm(p).covariance,
    }
    print("Angle of the normal, degrees: median / 90th percentile")
    print("outliers      " + "".join(f"{name:>14s}" for name in fits))
    for kind in ("cluster", "shell", "far"):
        for share in (0.0, 0.1, 0.3, 0.45):
            patches, truth = contaminate(kind, share, count)
            cells = []
            for fit in fits.values():
                normals = eigh3(fit(patches).double())[1][..., 0]
                cosine = (normals * truth).sum(dim=1).abs().clamp(max=1)
                angle = torch.rad2deg(cosine.acos())
                cells.append(f"{angle.median():.1f} / {angle.quantile(0.9):.1f}")
            print(f"{kind:8s} {share:4.0%} " + "".join(f"{cell:>14s}" for cell in cells))


def main() -> None:
    """Run the benchmark from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scan", type=Path, help="a scan to take neighbourhoods from")
    parser.add_argument("--patches", type=int, default=100_000)
    parser.add_argument("--sample", type=int, default=200, help="patches for the others")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--breakdown", action="store_true", help="angles under contamination")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(
        f"{platform.machine()}, {arguments.threads} threads, torch {torch.__version__}, "
        f"numpy {np.__version__}, float32"
    )
    if arguments.breakdown:
        print_breakdown(200)
        return
    for name, patches in patch_sets(arguments.scan, arguments.patches).items():
        print(f"{name}: {len(patches)} patches of {K} points")
        time_torchrg(patches)
        time_others(patches[:: max(len(patches) // arguments.sample, 1)][: arguments.sample])


if __name__ == "__main__":
    main()
