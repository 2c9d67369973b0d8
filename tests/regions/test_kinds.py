"""Classes of planes are the same through every door, and another up axis is a warning."""

import gc
import pickle
import warnings
import weakref

import pytest
import torch

from torchrg import segment_planes
from torchrg.scenes import make_room

POINTS = make_room(4000, noise=0.003, seed=0).points
TURNED = torch.stack([POINTS[:, 0], POINTS[:, 2], -POINTS[:, 1]], dim=1)
YAWED = TURNED @ torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])


def test_points_are_held_no_longer_than_needed():
    points = POINTS.clone()
    planes, held = segment_planes(points, "classic").planes, weakref.ref(points)
    del points
    assert len(pickle.dumps(planes)) < 8000
    gc.collect()
    assert held() is None


def test_another_axis_that_is_up_is_told():
    with pytest.warns(UserWarning, match=r"largest floor and ceiling face y.*--up y .*up='y'"):
        assert segment_planes(TURNED, "classic").planes.kind is not None
    with pytest.warns(UserWarning, match="face y"):
        assert segment_planes(YAWED, "classic").planes.kind is not None
    with pytest.warns(UserWarning, match="face z"):
        segment_planes(POINTS, "classic", **{"planes.up": "y"})


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", [(6, 5, 2.7), (2, 12, 3), (12, 2.2, 2.5)])
def test_rooms_and_corridors_with_z_up_are_not_told(seed, size):
    generator = torch.Generator().manual_seed(seed)
    points, faces = torch.rand(12_000, 3, generator=generator), torch.tensor([*size]).double()
    areas = faces.prod() / faces
    face = torch.multinomial(areas.repeat(2), len(points), True, generator=generator)
    points[torch.arange(len(points)), face % 3] = (face // 3).float()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert segment_planes(points * faces.float(), "classic").planes.kind is not None
