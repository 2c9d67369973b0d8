"""The presets of the paper's methods state each of its numbers, with its place, and mean them."""

import math
import re

import pytest
import torch
import yaml

from tests.test_config import CONFIGS
from torchrg.config import load_config
from torchrg.regions.edges import coplanarity_limits
from torchrg.regions.shared_neighbors import min_shared_neighbors
from torchrg.robust import median, qn
from torchrg.robust.scale import QN_FACTOR
from torchrg.robust.weights import chi2_quantile, subset_size, within_quantile

GROWTH = {
    "growing.max_angle_deg": (5.0, "section IV"),
    "growing.curvature_quantile": (0.95, "section"),
    "growing.curvature_scope": ("cloud", "Algorithm 2"),
    "growing.seed_rule": ("increment", "section II.B"),
    "growing.min_size": (50, "section IV"),
}
CLASSIC = GROWTH | {
    "normals.k": (50, "section IV"),
    "growing.connectivity": (None, ""),
    "growing.coplanarity": (False, ""),
}
PRINTED = {
    "classic_increment": CLASSIC | {"normals.method": ("pca", "")},
    "detmm": CLASSIC
    | {"normals.method": ("detmm", ""), "normals.inlier_quantile": (0.975, "eq. 6")},
    "paper": GROWTH
    | {
        "normals.method": ("paper", ""),
        "normals.k": (50, "section IV"),
        "normals.sharp_rule": ("qn", "eq. 9"),
        "normals.sharp_angle_deg": (5.0, "eq. 9"),
        "normals.inlier_quantile": (0.975, "eq. 6"),
        "normals.support_fraction": (0.5, "section II.A"),
        "normals.mcd_scaling": ("consistency", ""),
        "normals.mcd_inliers": ("raw", ""),
        "growing.connectivity": (0.75, "eq. 10"),
        "growing.connectivity_scope": ("seed", "section I"),
        "growing.coplanarity": (True, "eq. 11"),
        "growing.coplanarity_scope": ("all", "eq. 11"),
        "growing.coplanarity_floor": (0.005, "not in the paper"),
    },
    "algorithm2": {
        "growing.connectivity_scope": ("region", ""),
        "growing.coplanarity_scope": ("connected", ""),
    },
}
"""What the paper prints, and where: all that each file says, and nothing else."""


@pytest.mark.parametrize("name", PRINTED)
def test_preset_states_every_number_of_the_paper_and_its_place(name):
    text = (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")
    stated = yaml.safe_load(text)
    stated.pop("base", None)
    flat = {f"{part}.{key}": value for part in stated for key, value in stated[part].items()}
    assert flat == {key: value for key, (value, _) in PRINTED[name].items()}
    config = load_config(name)
    for key, (value, place) in PRINTED[name].items():
        part, setting = key.split(".")
        assert getattr(getattr(config, part), setting) == value, key
        (line,) = re.findall(rf"^  {setting}: .*$", text, re.MULTILINE)
        assert place in line.partition("#")[2], line


def test_algorithm_2_is_the_paper_but_for_its_letter():
    paper, letter = load_config("paper"), load_config("algorithm2")
    assert letter.normals == paper.normals
    differing = {
        name for name, value in vars(paper.growing).items() if vars(letter.growing)[name] != value
    }
    assert differing == {"connectivity_scope", "coplanarity_scope"}


def test_numbers_of_the_paper_that_are_no_settings_are_those_of_the_code():
    settings = load_config("paper")
    k, quantile = settings.normals.k, settings.normals.inlier_quantile
    # Eq. 6: the squared distance; the printed 3.075 is that of the distance, misprinted.
    assert chi2_quantile(quantile, 3) == pytest.approx(9.348404, abs=1e-6)
    assert math.sqrt(chi2_quantile(quantile, 3)) == pytest.approx(3.0575, abs=1e-4)
    limits = torch.tensor([[9.3483], [9.3485]], dtype=torch.float64)
    assert within_quantile(limits, quantile, 3).squeeze(1).tolist() == [1, 0]
    # Section II.A: h is at least (k + p + 1) / 2. Eq. 10: 75 % of k, rounded up.
    assert subset_size(k, 3, settings.normals.support_fraction) == (k + 3 + 1) // 2
    assert min_shared_neighbors(settings.growing.connectivity, k) == 38
    # Eq. 7: 2.2219 times the C(h, 2)-th smallest difference, h = n // 2 + 1.
    residuals = torch.rand(1, k, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    differences = torch.pdist(residuals.T).sort().values
    h = k // 2 + 1
    assert QN_FACTOR == 2.2219
    torch.testing.assert_close(qn(residuals)[0], 2.2219 * differences[h * (h - 1) // 2 - 1])
    # Eq. 11: median + 2 Qn.
    limit = coplanarity_limits(residuals, torch.zeros(1, dtype=torch.float64))
    torch.testing.assert_close(limit, median(residuals) + 2 * qn(residuals))
