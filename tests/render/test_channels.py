"""Color channels of a viewer."""

import numpy as np
import pytest
import torch

from tests.render.test_page import decode_directions, described, places, room, unpacked
from torchrg.io.result import Result
from torchrg.render import color_curvature, color_normals, color_planes, color_sharp
from torchrg.render.channels import encode_directions, point_outcomes
from torchrg.render.page import make_page


@pytest.mark.parametrize("mode", ["plane", "superpoint", "normal", "curvature", "sharp"])
def test_colours_are_those_of_pictures(mode):
    """Of a sample of the points, with another axis up, as far as the page's numbers are as fine."""
    cloud = room()
    fields = {name: torch.from_numpy(values) for name, values in cloud.fields.items()}
    colors = {
        "plane": color_planes(fields["labels"], cloud.points),
        "superpoint": color_planes(fields["superpoint"], cloud.points),
        "normal": color_normals(fields["normals"], up=(0.0, 1.0, 0.0)),
        "curvature": color_curvature(fields["curvature"]),
        "sharp": color_sharp(fields["sharp"]),
    }[mode]
    page = make_page(Result(cloud), max_points=700, up=(0.0, 1.0, 0.0))
    arrays, found = unpacked(page), places(page)
    rows = [np.abs(cloud.coordinates - place).max(axis=1).argmin() for place in found]
    shown = arrays[mode] if mode == "normal" else arrays[f"{mode} colors"][arrays[mode][:, 0]]
    differences = np.abs(shown.astype(int) - colors[rows].numpy())
    assert differences.max() <= {"normal": 1, "curvature": 12}.get(mode, 0)


def test_errors_are_shown_against_a_truth():
    cloud = room()
    wrong = cloud.fields["labels"].copy()
    wrong[:100] = -1
    page = make_page(Result(room(labels=wrong)), ground_truth=cloud, color="error")
    assert described(page)["mode"] == "error"
    assert (unpacked(page)["error"] == 3).sum() == 100
    assert (unpacked(page)["normal-error"] == 0).all()


def test_directions_survive_two_bytes():
    directions = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions, dim=1)
    found = decode_directions(encode_directions(directions))
    cosines = (found * directions.numpy()).sum(axis=1)
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).max() < 1.0


def test_point_outcomes_by_example():
    assert (
        repr(point_outcomes(torch.tensor([0, 0, 0, 1, 2, -1]), torch.tensor([5, 5, 5, 5, 6, 6])))
        == "tensor([0, 0, 0, 1, 0, 3])"
    )


def test_encode_directions_by_example():
    assert encode_directions(torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, 0]])).tolist() == [
        [127, 127],
        [254, 127],
        [255, 255],
    ]
