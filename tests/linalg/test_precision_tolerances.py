"""Tolerances of a dtype."""

from pathlib import Path

import torch

from torchrg.linalg.precision import flatness_tolerance

PACKAGE = Path(__file__).parents[2] / "torchrg"
# The largest number that a file can hold.
MAY_ASK_FOR_PRECISION = {"datasets/s3dis.py"}


def test_tolerance_of_a_plane_grows_with_the_distance_from_the_origin(dtype):
    near = flatness_tolerance(torch.ones(1, 5, 3, dtype=dtype), torch.ones(1, dtype=dtype))
    far = flatness_tolerance(torch.full((1, 5, 3), 1e4, dtype=dtype), torch.ones(1, dtype=dtype))
    assert 9 < near / torch.finfo(dtype).eps < 11
    assert 1e3 < far / near < 1e4


def test_tolerances_stand_here_alone():
    asking = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if "finfo" in path.read_text() and path.parent.name != "linalg"
    }
    assert asking <= MAY_ASK_FOR_PRECISION
