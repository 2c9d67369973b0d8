"""Clouds of a batch are set along their axes each by itself."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrg.errors import ConfigError
from torchrg.scenes import make_room
from torchrg.transforms import AlignAxes


def turned(seed, degrees):
    room = make_room(num_points=4000, noise=0.002, seed=seed)
    turn = torch.from_numpy(Rotation.from_euler("zx", [degrees, 2], True).as_matrix()).float()
    return room.points.float() @ turn.T + 3, room.normals.float() @ turn.T, turn


def test_each_cloud_of_a_batch_has_its_own_motion():
    (one, first, a), (other, second, b) = turned(1, 20), turned(2, -35)
    offset = torch.tensor([len(one), len(one) + len(other)])
    sample = {"coord": torch.cat([one, other]), "normal": torch.cat([first, second])}
    sample |= {"offset": offset, "name": ["a", "b"]}
    found = AlignAxes("classic")(sample)
    motions = found["axis_align_matrix"]
    assert motions.shape == (2, 4, 4)
    for motion, turn in zip(motions, (a, b), strict=True):
        assert torch.allclose(motion[:3, :3].float() @ turn, torch.eye(3), atol=0.01)
    expected = other.double() @ motions[1, :3, :3].T + motions[1, :3, 3]
    assert torch.allclose(found["coord"][len(one) :], expected.float(), atol=1e-5)
    upright = found["normal"][:, 2].abs()
    assert ((upright < 0.02) | (upright > 0.999)).float().mean() > 0.9
    assert torch.equal(sample["coord"][: len(one)], one)
    assert torch.equal(found["offset"], offset)


def test_arrays_stay_arrays_and_keys_are_renamed():
    points, _, _ = turned(3, 10)
    align = AlignAxes("classic", keys={"coord": "xyz"})
    found = align({"xyz": points.numpy()})
    assert isinstance(found["xyz"], np.ndarray)
    assert found["xyz"].dtype == np.float32
    with pytest.raises(ConfigError, match="expected a floor, a ceiling, or walls"):
        align({"xyz": np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)})
