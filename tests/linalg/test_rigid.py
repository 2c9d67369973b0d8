"""Matrices that are no rigid motions are refused with what they are."""

import pytest
import torch

from torchrg.depth import depth_to_points, segment_depth
from torchrg.errors import ShapeError
from torchrg.linalg.rigid import check_rigid
from torchrg.transforms import SegmentDepth

TURN = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]).double()


def pose(rotation=TURN, shift=(1.0, 2.0, 3.0), row=(0.0, 0.0, 0.0, 1.0)):
    """Return a matrix of a rotation, a translation and a last row."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3], matrix[3] = rotation, torch.tensor(shift), torch.tensor(row)
    return matrix


SHEAR = torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]).double()
FAULTS = {
    "scaled": (pose(5 * TURN), "a rotation scaled by 5; divide it by 5"),
    "smaller": (pose(0.001 * TURN), "a rotation scaled by 0.001; divide"),
    "mirrored": (pose(TURN @ torch.diag(torch.tensor([1.0, -1, 1])).double()), "a mirror; negate"),
    "mirrored and scaled": (pose(-2 * TURN), "a mirror; negate"),
    "sheared": (pose(SHEAR), "sheared or unevenly scaled axes"),
    "stretched": (pose(TURN * torch.tensor([1.0, 1, 2])), "sheared or unevenly scaled axes"),
    "zero": (torch.zeros(4, 4), "a rotation of zeros"),
    "flat": (pose(torch.diag(torch.tensor([1.0, 1, 0])).double()), "sheared or unevenly"),
    "transposed": (pose().T, "a transposed matrix, with the translation in its last row; trans"),
    "last row": (pose(row=(0.0, 0.0, 0.0, 2.0)), "a last row of 0 0 0 2, not 0 0 0 1"),
    "nan": (torch.full((4, 4), torch.nan), "values that are not finite"),
    "inf": (pose(shift=(0.0, torch.inf, 0.0)), "values that are not finite"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_every_door_of_poses_says_what_is_no_motion(name):
    matrix, message = FAULTS[name]
    depth, camera = torch.full((30, 40), 2.0), torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    doors = (
        lambda: check_rigid("f", "pose", torch.stack([pose(), matrix.double()])),
        lambda: segment_depth(depth, camera, pose=matrix),
        lambda: segment_depth(depth, camera, pose=matrix.numpy()),
        lambda: SegmentDepth()({"depth": depth[None], "intrinsics": camera, "pose": matrix}),
        lambda: depth_to_points(depth[None], camera[None], matrix[None]),
    )
    for door in doors:
        with pytest.raises(ShapeError, match=f": expected poses? to be rigid, got {message}"):
            door()


def test_rigid_motions_pass_with_the_digits_of_files():
    check_rigid("f", "pose", None)
    check_rigid("f", "pose", torch.empty(0, 4, 4))
    check_rigid("f", "pose", pose())
    check_rigid("f", "pose", pose().float())
    check_rigid("f", "pose", pose((TURN * 1e4).round() / 1e4 + 1e-4))
    check_rigid("f", "pose", pose(1.0004 * TURN))
    with pytest.raises(ShapeError, match=r"scaled by 1\.001"):
        check_rigid("f", "pose", pose(1.001 * TURN))
