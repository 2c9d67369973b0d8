"""Classes of planes are the same through every door, and another up axis is a warning."""

import gc
import pickle
import warnings
import weakref

import pytest
import torch

from torchrg import Cloud, segment_planes, select_planes, write_cloud
from torchrg.io.plane_table import describe_planes
from torchrg.io.result import read_result
from torchrg.scenes import make_room
from torchrg.structures import PLANE_KINDS

POINTS = make_room(4000, noise=0.003, seed=0).points
TURNED = torch.stack([POINTS[:, 0], POINTS[:, 2], -POINTS[:, 1]], dim=1)
YAWED = TURNED @ torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
ANSWER = segment_planes(POINTS, "classic", **{"planes.up": "z"}).planes.kind


def segment():
    return segment_planes(POINTS, "classic", orient="none")


def names(kind):
    return [PLANE_KINDS[i] for i in kind]


def written(seg, tmp_path):
    write_cloud(tmp_path / "a.npz", Cloud(POINTS), seg)
    return read_result(tmp_path / "a.npz").planes.kind


DOORS = {
    "column": lambda seg, _: seg.planes.kind,
    "rows": lambda seg, _: torch.tensor([PLANE_KINDS.index(plane.kind) for plane in seg.planes]),
    "select": lambda seg, _: select_planes(seg).planes.kind,
    "table": lambda seg, _: torch.tensor(
        [PLANE_KINDS.index(row["kind"]) for row in describe_planes(seg.planes)["planes"]]
    ),
    "file": written,
}


@pytest.mark.parametrize("door", DOORS)
def test_every_door_has_one_answer(door, tmp_path):
    assert "wall" in names(ANSWER)
    assert names(DOORS[door](segment(), tmp_path)) == names(ANSWER)


def test_a_selected_wall_stays_a_wall():
    seg = select_planes(segment(), kinds="wall")
    assert {plane.kind for plane in seg.planes} == {"wall"}
    seg = segment_planes(POINTS, "classic", kinds="wall")
    assert len(seg.planes) == names(ANSWER).count("wall")


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
