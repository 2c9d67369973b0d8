"""Patches with the answers of other implementations, and what is known to be wrong with them."""

import functools
import json

import numpy as np
import torch

from torchrg.robust import fit_detmcd, fit_detmm, fit_dets, fit_fastmcd, fit_mve

FRACTIONS = {"50": 0.5, "75": 0.75}

# What MATLAB's LIBRA calls DetMCD, but for what it trusts by default (0.75).
LIBRA = {"scaling": "quantile", "inliers": "reweighted"}

ESTIMATORS = {
    "paper": fit_detmcd,
    "libra": lambda patches, **k: fit_detmcd(patches, **LIBRA, **k),
    "planes": lambda patches, **k: fit_detmcd(patches, starts="planes", **k),
    "more": lambda patches, **k: fit_detmcd(patches, starts="more", **k),
    "fastmcd": lambda patches, **k: fit_fastmcd(patches, num_starts=20, **k),
    "mve": lambda patches, **k: fit_mve(patches, num_starts=20, **k),
    "dets": fit_dets,
    "detmm": fit_detmm,
}

# Listed in the notes next to the reference values: QR tolerance, false exact fits, cut iterations.
WRONG_RRCOV = {"planar_very_fine", "planar_tilt__aniso_units"}

# Columns of extent 1e3, 1 and 1e-3: flat to the rounding of float32.
FLAT_IN_FLOAT32 = {"planar_tilt__aniso_units"}


@functools.cache
def read_patches(folder):
    with np.load(folder / "inputs.npz") as archive:
        return {name: archive[name] for name in archive.files}


@functools.cache
def read_answers(folder, family):
    content = json.loads((folder / f"{family}.json").read_text())
    return content.get("cases", content)


def load_oracles(folder, *families):
    """Patches, their descriptions, and the answers of the named families."""
    answers = [read_answers(folder, family) for family in ("cases", *families)]
    return dict(read_patches(folder)), *answers


def fit_all(patches, fit):
    """Fit patches by name, those of one size in one batch; returns one fit for each name."""
    sizes = {}
    for name, points in patches.items():
        sizes.setdefault(len(points), []).append(name)
    fits = {}
    for names in sizes.values():
        batch = fit(torch.stack([torch.as_tensor(patches[name]) for name in names]))
        for row, name in enumerate(names):
            fits[name] = batch._replace(**{k: v[row] for k, v in batch._asdict().items()})
    return fits


def local_float32(patch):
    """The patch about its first point, in float32."""
    return torch.from_numpy(patch - patch[0]).float()


def points_of(flags):
    return set(torch.nonzero(flags).squeeze(1).tolist())


def normal_of(covariance):
    return np.linalg.eigh(np.asarray(covariance, dtype=np.float64).reshape(3, 3))[1][:, 0]


def angle_deg(first, second):
    """Angle between two directions without sign."""
    return np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(first, second)))))


def eigenvalue_error(found, expected, dtype):
    """Largest relative error of the eigenvalues, beyond what rounding a matrix entry costs."""
    ours = np.linalg.eigvalsh(np.asarray(found, dtype=np.float64))
    theirs = np.linalg.eigvalsh(np.asarray(expected, dtype=np.float64).reshape(3, 3))
    rounding = 4 * torch.finfo(dtype).eps * theirs[-1]
    return (np.maximum(np.abs(ours - theirs) - rounding, 0) / theirs).max()
