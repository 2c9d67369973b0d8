"""Angles and chords between directions."""

import numpy as np
import pytest
import torch

from torchrg.linalg import unsigned_angle_deg
from torchrg.linalg.angles import (
    at_most,
    deg_to_sq_chord,
    sq_chord_to_deg,
    sq_chords,
    unit_direction,
)


def test_angles_are_those_of_the_arc_cosine():
    angles = torch.linspace(0, 180, 1801, dtype=torch.float64)
    a = torch.tensor([1.0, 0, 0], dtype=torch.float64).expand(len(angles), 3)
    radians = torch.deg2rad(angles)
    b = torch.stack([radians.cos(), radians.sin(), torch.zeros_like(radians)], dim=-1)
    expected = torch.minimum(angles, 180 - angles)
    assert (unsigned_angle_deg(a, b) - expected).abs().max() < 1e-7
    assert (unsigned_angle_deg(a.float(), b.float()) - expected).abs().max() < 2e-5


def test_small_angles_keep_their_digits_in_float32():
    for degrees in (1e-4, 1e-3, 1e-2):
        sq_chord = torch.tensor((2 * np.sin(np.radians(degrees) / 2)) ** 2, dtype=torch.float32)
        assert sq_chord_to_deg(sq_chord).item() == pytest.approx(degrees, rel=1e-6)


def test_chords_are_those_of_the_angles(rng):
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 3, generator=rng).double(), dim=-1)
    chords = sq_chords(a[:, :, None].unbind(dim=1), b[:, :, None].unbind(dim=1)).squeeze(1)
    assert torch.allclose(sq_chord_to_deg(chords), unsigned_angle_deg(a, b), atol=1e-6)
    limits = torch.tensor([deg_to_sq_chord(float(angle)) for angle in unsigned_angle_deg(a, b)])
    assert torch.allclose(chords, limits.double(), atol=1e-7)


def test_unit_direction_by_example():
    assert (unit_direction("f", "-y").tolist(), unit_direction("f", (0, 0, 1e-300)).tolist()) == (
        [0.0, -1.0, 0.0],
        [0.0, 0.0, 1.0],
    )


def test_deg_to_sq_chord_by_example():
    assert round(deg_to_sq_chord(60.0), 6) == 1.0


def test_sq_chords_by_example():
    a = torch.tensor([0.0, 0.0, 1.0])[:, None, None]
    assert (
        repr((sq_chords(a, -a), sq_chords(a, -a, signed=True)))
        == "(tensor([[0.]]), tensor([[4.]]))"
    )


def test_at_most_by_example():
    assert repr(at_most(torch.tensor([1.0, 2.0, 3.0]), 2.0)) == "tensor([1., 1., 0.])"
