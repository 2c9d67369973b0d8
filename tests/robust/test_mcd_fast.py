import pytest
import torch

from tests.robust.oracle_cases import FRACTIONS, fit_all, load_oracles, local_float32, points_of
from torchrg.errors import ConfigError
from torchrg.robust import fit_fastmcd
from torchrg.robust.mcd import _Concentrated, _distinct_best

# The cases include patches of fewer than six points.
pytestmark = pytest.mark.filterwarnings("ignore:.*too few to trust the covariance")


def gaps(folder, convert, chosen):
    """How far above the best known objective the fits of the chosen cases are."""
    patches, cases, best = load_oracles(folder, "best_known_mcd")
    for level, fraction in FRACTIONS.items():
        known = {
            name: convert(points)
            for name, points in patches.items()
            if isinstance(best.get(name, {}).get(f"a{level}", {}).get("logdet"), float)
            and chosen(cases[name])
        }
        fits = fit_all(known, lambda batch, a=fraction: fit_fastmcd(batch, support_fraction=a))
        for name, fit in fits.items():
            answer = best[name][f"a{level}"]
            yield name, fit.log_det.item() - answer["logdet"], answer["proven_global"]


def test_objective_reaches_the_best_known(oracles_folder):
    seen = 0
    for name, gap, proven in gaps(oracles_folder, torch.from_numpy, lambda case: case["n"] <= 51):
        assert -1e-8 <= gap <= (1e-8 if proven else 0.05), name
        seen += 1
    assert seen > 110


def test_objective_of_float32_reaches_the_best_known(oracles_folder):
    groups = ("edge", "corner", "outliers", "curved")
    seen = 0
    for name, gap, _ in gaps(oracles_folder, local_float32, lambda c: c["group"] in groups):
        assert -1e-3 <= gap <= 0.051, name
        seen += 1
    assert seen == 42


def test_finds_the_subset_of_robustbase_where_the_objectives_agree(oracles_folder):
    patches, _, robustbase = load_oracles(oracles_folder, "r_robustbase")
    agreed = 0
    for name in ("planar_tilt", "edge120_60", "out30_cluster", "corner_56", "curved_saddle"):
        answer = robustbase[name]["fastmcd500_50"]
        fit = fit_fastmcd(torch.from_numpy(patches[name]))
        if abs(fit.log_det.item() - answer["crit"]) < 1e-9:
            assert points_of(fit.raw_support) == set(answer["best"])
            agreed += 1
    assert agreed >= 4


def test_objective_is_affine_equivariant(rng):
    patches = torch.randn(4, 30, 3, generator=rng, dtype=torch.float64)
    patches[:, :10] += 3
    matrix = torch.tensor([[2.0, 0.3, 0.0], [0.1, 0.5, -0.2], [0.0, 0.4, 1.5]]).double()
    fit = fit_fastmcd(patches, num_starts=100)
    moved = fit_fastmcd(patches @ matrix.T + 7, num_starts=100)
    assert torch.equal(fit.raw_support, moved.raw_support)
    expected = fit.log_det + 2 * matrix.det().abs().log()
    torch.testing.assert_close(moved.log_det, expected)
    torch.testing.assert_close(moved.covariance, matrix @ fit.covariance @ matrix.T)


def test_equal_sets_are_kept_once():
    determinants = torch.tensor([[3.0], [1.0], [2.0], [1.0], [2.0]], dtype=torch.float64)
    members = torch.arange(5.0).reshape(1, 5, 1)
    kept = _distinct_best(_Concentrated(members, determinants), 3)
    assert kept.members.flatten().tolist() == [1, 2, 0]
    assert kept.determinants.flatten().tolist() == [1, 2, 3]


def test_parts_of_the_starts_change_nothing(rng, monkeypatch):
    patches = torch.randn(3, 20, 3, generator=rng)
    whole = fit_fastmcd(patches, num_starts=300)
    monkeypatch.setattr("torchrg.robust.mcd._LANES_IN_CACHE", 30)
    monkeypatch.setattr("torchrg.robust.starts.ROWS_IN_CACHE", 7)
    for one, other in zip(whole, fit_fastmcd(patches, num_starts=300), strict=True):
        assert torch.equal(one, other)


def test_refusals():
    with pytest.raises(ConfigError, match="fit_fastmcd: expected num_starts of at least 1, got 0"):
        fit_fastmcd(torch.zeros(5, 3), num_starts=0)
