"""Point clouds of arrays and tensors."""

import numpy as np
import pytest
import torch

from torchrg.errors import ShapeError
from torchrg.structures import Cloud


def test_a_cloud_takes_tensors():
    front = torch.ones(3, 3)
    cloud = Cloud(torch.eye(3), {"labels": torch.arange(3)}, front=front)
    values = cloud.coordinates, cloud.fields["labels"], cloud.front
    assert all(isinstance(value, np.ndarray) for value in values)
    assert torch.equal(cloud.points, torch.eye(3))
    with pytest.raises(ShapeError, match=r"got list; use numpy\.array"):
        Cloud([[0.0, 0.0, 1.0]])


def test_a_cloud_of_other_columns_or_fields_is_refused():
    with pytest.raises(ShapeError, match=r"got \(5, 6\) and dict; pass Cloud\(points\[:, :3\]"):
        Cloud(np.zeros((5, 6)))
    with pytest.raises(ShapeError, match=r"got \(5, 3\) and ndarray; pass"):
        Cloud(np.zeros((5, 3)), np.zeros((5, 3)))
