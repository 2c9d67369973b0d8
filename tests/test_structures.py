"""Results are shown in one line."""

import numpy as np
import pytest
import torch

import torchrg
from torchrg.config import DepthConfig, NormalsConfig, SuperpointsConfig, load_config
from torchrg.depth import segment_depth


@pytest.fixture(scope="module")
def seg():
    floor = torch.cartesian_prod(torch.arange(40.0), torch.arange(40.0), torch.zeros(1))
    far = torch.tensor([[0.0, 0.0, 99.0], [torch.nan, 0, 0]])
    return torchrg.segment_planes(torch.cat([floor, far]), "classic", **{"planes.up": "z"})


def test_results_are_shown_in_one_line(seg):
    assert repr(seg) == "Segmentation(1,602 points, 1 planes, 99.9 % labeled)"
    assert repr(seg.planes) == "Planes(1 planes: 1 floor)"
    parts = torchrg.make_superpoints(seg.points, seg, counts=(10, 2))
    assert repr(parts).startswith("Superpoints(1,602 points, ")
    assert "\n" not in repr(parts)
    plane = "Plane(0, floor, 1,600 points, area 1521, normal (0.000, 0.000, 1.000), offset 0)"
    assert repr(seg.planes[0]) == plane
    cloud = torchrg.Cloud(np.zeros((3, 3)), {"intensity": np.zeros(3)})
    assert repr(cloud) == "Cloud(3 points, intensity)"


def test_images_are_shown_by_their_size():
    camera = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    seg = segment_depth(torch.full((30, 40), 2.0), camera)
    assert repr(seg) == "Segmentation(30 x 40 pixels, 1 planes, 100.0 % labeled)"


def test_a_segmentation_is_no_tuple(seg):
    assert seg == seg
    assert seg != torchrg.segment_planes(seg.points, "classic")
    for name in ("count", "index", "__len__", "__iter__"):
        assert not hasattr(seg, name)


@pytest.mark.parametrize(
    "config",
    [
        load_config(),
        load_config("classic", **{"growing.min_size": 7}),
        NormalsConfig(method="pca", k=9),
        SuperpointsConfig(counts=(30,)),
        DepthConfig(max_depth=4.0),
    ],
)
def test_settings_are_shown_as_the_call_that_makes_them(config):
    names = (load_config, NormalsConfig, SuperpointsConfig, DepthConfig)
    assert eval(repr(config), {name.__name__: name for name in names}) == config
    assert len(repr(config)) < 100
