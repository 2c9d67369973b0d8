import pytest
import torch

from tests.made import contaminated
from torchrg.linalg import eigh3
from torchrg.robust import fit_detmcd, fit_detmm, fit_fastmcd


def angles_deg(covariance, normals):
    found = eigh3(covariance.double())[1][..., 0]
    return torch.rad2deg((found * normals).sum(dim=1).abs().clamp(max=1).acos())


# The largest fraction of each kind that an estimator withstands in every patch.
WITHSTOOD = {
    "paper": (fit_detmcd, {"cluster": 0.1, "shell": 0.45, "far": 0.45}),
    "planes": (
        lambda p: fit_detmcd(p, starts="planes"),
        {"cluster": 0.45, "shell": 0.45, "far": 0.45},
    ),
    "fastmcd": (
        lambda p: fit_fastmcd(p, num_starts=200),
        {"cluster": 0.3, "shell": 0.45, "far": 0.45},
    ),
    "detmm": (fit_detmm, {"cluster": 0.1, "shell": 0.3, "far": 0.45}),
}


LEVELS = [
    (name, kind, fraction)
    for name, (_, withstood) in WITHSTOOD.items()
    for kind, largest in withstood.items()
    for fraction in (0.0, 0.1, 0.3, 0.45)
    if fraction <= largest
]


@pytest.mark.parametrize(("name", "kind", "fraction"), LEVELS)
def test_normal_stays_within_two_degrees(name, kind, fraction, rng):
    patches, normals = contaminated(kind, fraction, rng)
    angles = angles_deg(WITHSTOOD[name][0](patches).covariance, normals)
    assert angles.median() < 1
    assert angles.quantile(0.9) < 2
