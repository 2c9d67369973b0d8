from math import log

import pytest
import torch

from tests.robust.oracle_cases import FRACTIONS, load_oracles, points_of
from torchrg.errors import ConfigError
from torchrg.robust import fit_mve


def test_exhaustive_search_finds_the_least_volume(oracles_folder):
    patches, cases, ours, mass = load_oracles(oracles_folder, "ref_numpy", "r_mass")
    compared = compared_with_mass = 0
    for name in (f"small_n{n:02d}" for n in (7, 8, 9, 10, 11, 12, 13, 15)):
        for level, fraction in FRACTIONS.items():
            answer = ours[name].get(f"mve_exhaustive_{level}")
            if cases[name][f"exact_fit_{level}"] or not answer:
                continue
            fit = fit_mve(
                torch.from_numpy(patches[name]), support_fraction=fraction, exhaustive=True
            )
            assert abs(fit.log_det.item() - answer["log_objective"]) < 1e-7, name
            # Only points at the distance of the h-th may be exchanged.
            exchanged = points_of(fit.raw_support) ^ set(answer["covered"])
            farthest = fit.sq_distances[fit.raw_support].max().item()
            for point in exchanged:
                assert fit.sq_distances[point].item() == pytest.approx(farthest, rel=1e-9), name
            theirs = mass[name].get("mve", {})
            if level == "50" and mass[name].get("mve_exact") and "crit" in theirs:
                assert abs(fit.log_det.item() - theirs["crit"] + 3 * log(3)) < 1e-7, name
                compared_with_mass += 1
            compared += 1
    assert (compared, compared_with_mass) == (16, 8)


def test_random_search_comes_near(oracles_folder):
    patches, cases, ours = load_oracles(oracles_folder, "ref_numpy")
    compared = 0
    for name, patch in patches.items():
        answer = ours[name].get("mve_exhaustive_50")
        if cases[name]["group"] not in ("planar", "edge", "curved") or not answer:
            continue
        fit = fit_mve(torch.from_numpy(patch), num_starts=3000)
        assert -1e-7 < fit.log_det.item() - answer["log_objective"] < 1.0, name
        compared += 1
    assert compared == 20


def test_covers_h_points_and_leaves_out_a_cluster(dtype, rng):
    patches = torch.randn(8, 50, 3, generator=rng, dtype=dtype)
    patches[:, :12] += 9
    fit = fit_mve(patches, generator=torch.Generator().manual_seed(3))
    assert (fit.raw_support.sum(dim=1) == 27).all()
    assert not fit.support[:, :12].any()
    whole = fit_mve(patches, support_fraction=1.0)
    assert whole.raw_support.all()
    assert whole.support.all()


def test_refusals():
    with pytest.raises(ConfigError, match="fit_mve: expected num_starts of at least 1, got -1"):
        fit_mve(torch.zeros(5, 3), num_starts=-1)
    # 250 points have 250 * 249 * 248 * 247 / 24 sets of 4.
    with pytest.raises(ConfigError, match=r"at most 33,554,432 sets .*, got 158,882,750"):
        fit_mve(torch.rand(250, 3), exhaustive=True)
