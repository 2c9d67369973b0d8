"""Clouds and segmentations to write, the same for all formats."""

import numpy as np
import pytest
import torch

from torchrg.structures import Planes, Segmentation
from torchrg.structures.planes import PLANE_COLUMNS


@pytest.fixture
def make_segmentation():
    """A segmentation of so many points with three planes, about an origin of its own."""

    def make(num_points):
        rng = torch.Generator().manual_seed(0)
        normal = torch.nn.functional.normalize(torch.randn(3, 3, generator=rng), dim=1)
        centroid = torch.randn(3, 3, generator=rng)
        columns = {name: torch.zeros(3, *shape) for name, (_, shape) in PLANE_COLUMNS.items()}
        columns |= {
            "normal": normal,
            "offset": (normal * centroid).sum(dim=1),
            "centroid": centroid,
            "area": torch.rand(3, generator=rng),
            "count": torch.tensor([30, 20, 10]),
            "rms": torch.rand(3, generator=rng),
            "extent": torch.rand(3, 2, generator=rng),
            "axes": torch.randn(3, 2, 3, generator=rng),
            "center": torch.randn(3, 3, generator=rng),
            "curved": torch.zeros(3, dtype=torch.bool),
        }
        return Segmentation(
            labels=torch.randint(-1, 3, (num_points,), generator=rng),
            normals=torch.randn(num_points, 3, generator=rng),
            curvature=torch.rand(num_points, generator=rng) / 3,
            sharp=torch.rand(num_points, generator=rng) > 0.5,
            valid=torch.rand(num_points, generator=rng) > 0.1,
            planes=Planes(**columns),
        )

    return make


def needs(suffix):
    """Skip a test without the package that reads a format."""
    package = {".e57": "pye57", ".las": "laspy", ".laz": "lazrs"}.get(suffix, "numpy")
    pytest.importorskip(package, reason=f"needs the extra {suffix[1:]}")


def assert_same(found, expected):
    """Check that two clouds hold the same points and fields, to the last bit."""
    np.testing.assert_array_equal(found.coordinates, expected.coordinates)
    assert found.fields.keys() == expected.fields.keys()
    for name, values in expected.fields.items():
        np.testing.assert_array_equal(found.fields[name], values, err_msg=name)


@pytest.fixture(name="assert_same")
def assert_same_fixture():
    return assert_same


@pytest.fixture
def write_scan():
    """Write coordinates and colors of a cloud as an E57 file, which torchrg only reads."""
    pye57 = pytest.importorskip("pye57")

    def write(path, cloud, **about):
        columns = {f"cartesian{axis}": cloud.coordinates[:, i] for i, axis in enumerate("XYZ")}
        for i, name in enumerate(("Red", "Green", "Blue") if "color" in cloud.fields else ()):
            columns[f"color{name}"] = cloud.fields["color"][:, i]
        with pye57.E57(str(path), "w") as file:
            file.write_scan_raw(columns, **about)
        return path

    return write
