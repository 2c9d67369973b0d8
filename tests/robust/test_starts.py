"""Starting subsets of deterministic estimators."""

import pytest
import torch

from tests.robust.oracle_cases import fit_all, load_oracles
from torchrg.robust import fit_detmcd, fit_fastmcd

# The cases include patches of fewer than six points.
pytestmark = pytest.mark.filterwarnings("ignore:.*too few to trust the covariance")


def test_plane_starts_do_not_depend_on_rotation(rng):
    patches = torch.randn(60, 50, 3, generator=rng, dtype=torch.float64)
    patches[..., 2] *= 0.05
    patches[:, :18, 2] += 0.4
    turn = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64)).Q
    for starts in ("planes", "more"):
        fit = fit_detmcd(patches, starts=starts)
        turned = fit_detmcd(patches @ turn.T, starts=starts)
        assert torch.equal(fit.raw_support, turned.raw_support)
        assert torch.equal(fit.support, turned.support)
        torch.testing.assert_close(turned.location, fit.location @ turn.T)
        torch.testing.assert_close(turned.covariance, turn @ fit.covariance @ turn.T)


def test_more_starts_withstand_a_cluster_that_draws_the_published_ones(rng):
    plane = 0.6 * torch.rand(40, 35, 3, generator=rng) - 0.3
    plane[..., 2] = 0.003 * torch.randn(40, 35, generator=rng)
    cluster = torch.tensor([0.1, 0.1, 0.25]) + 0.04 * torch.randn(40, 15, 3, generator=rng)
    turn = torch.linalg.qr(torch.randn(40, 3, 3, generator=rng)).Q
    patches = torch.cat([plane, cluster], dim=1) @ turn
    paper, planes, more = (fit_detmcd(patches, starts=s) for s in ("paper", "planes", "more"))
    assert paper.support[:, 35:].any(dim=1).double().mean() > 0.2
    assert not planes.support[:, 35:].any()
    assert not more.support[:, 35:].any()
    assert (more.log_det <= planes.log_det + 1e-4).all()
    assert more.log_det.mean() < paper.log_det.mean() - 0.5


def test_more_starts_reach_most_of_the_best_known_minima(oracles_folder):
    patches, cases, best = load_oracles(oracles_folder, "best_known_mcd")
    known = {
        name: points
        for name, points in patches.items()
        if "__" not in name and not cases[name]["exact_fit_50"]
    }
    fits = fit_all(known, lambda batch: fit_detmcd(batch, starts="more"))
    reached = [
        name for name, fit in fits.items() if fit.log_det - best[name]["a50"]["logdet"] < 1e-6
    ]
    assert len(fits) == 53
    assert len(reached) >= 45, set(fits) - set(reached)


def test_starts_are_the_same_each_time(rng):
    patches = torch.randn(12, 50, 3, generator=rng)
    assert torch.equal(fit_fastmcd(patches).log_det, fit_fastmcd(patches).log_det)
