"""What kernels find at the pixels of depth images is what the definitions find."""

import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from tests.made import cameras_around, render_depth
from torchrg.config import DepthConfig
from torchrg.depth import segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.linalg.moments import Segments
from torchrg.regions.extents import hull_candidates
from torchrg.scenes import build_room
from torchrg.structures.planes import PLANE_COLUMNS

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


def frames():
    """Depth images by name: made, noisy, exact, with holes, random, tiny, huge and thin ones."""
    generator = torch.Generator().manual_seed(0)
    model = build_room(3)
    camera = cameras_around(model, 1, seed=3, width=150, height=113)[0]
    made = {kind: render_depth(model, camera, sensor=kind).depth for kind in ("exact", "kinect")}
    broken = made["kinect"].clone()
    broken[::7, ::3], broken[20:40, 30:50], broken[5] = torch.nan, 0.0, torch.inf
    stairs = 2.0 + 0.1 * (torch.arange(150) // 30) + torch.zeros(113, 1)
    random = 1 + 3 * torch.rand(41, 67, generator=generator)
    shapes = [(1, 1), (1, 60), (60, 1), (2, 2), (5, 5), (9, 64), (65, 33)]
    return {
        **made,
        "broken": broken,
        "stairs": stairs,
        "random": random,
        "double": made["kinect"].double() * 1e-3,
        "near": made["exact"] * 1e-30,
        "far": made["exact"].double() * 1e150,
        "unequal": made["exact"].double() ** 90,
        "none": torch.zeros(30, 40),
        **{f"{h} x {w}": random[:1, :1].expand(h, w) + torch.zeros(h, w) for h, w in shapes},
        "narrow": made["kinect"][:, ::16].contiguous(),
    }


FRAMES = frames()


@pytest.fixture(params=FRAMES)
def depth(request):
    return FRAMES[request.param]


FOCAL = (140.0, -150.0)
ROUNDING = 1e-9


def assert_same(found, expected, tolerance=0.0):
    """Compare numbers up to a share of the largest of them, and choices exactly."""
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        finite = other[other.isfinite()]
        atol = 0.0
        if finite.is_floating_point() and len(finite):
            atol = tolerance * float(finite.abs().max())
        torch.testing.assert_close(one, other, rtol=tolerance, atol=atol, equal_nan=True)


def parts_of(depth):
    """Return all that is found in an image: labels, normals, and the table."""
    camera = make_intrinsics(*FOCAL, depth.shape[1] / 2, depth.shape[0] / 2)
    found = segment_depth(depth, camera, DepthConfig(min_size=20))
    columns = [getattr(found.planes, name) for name in PLANE_COLUMNS]
    return [found.labels, found.normals, found.curvature, *columns]


@pytest.mark.filterwarnings("ignore:.*a field of view of", "ignore:.*expected a median depth")
def test_images_are_segmented_as_by_definition_on_any_number_of_threads(depth, set_threads):
    found = parts_of(depth)
    set_threads(3)
    assert_same(parts_of(depth), found)
    with definitions():
        # Roots in torch may be off by their last bit.
        assert_same(found, parts_of(depth), ROUNDING)


@pytest.mark.parametrize("size", [1, 7, 8, 9, 128, 129, 130, 137, 300, 5000])
def test_moments_and_weights_of_regions_are_those_of_the_definition(size, rng):
    labels = torch.arange(3 * size) % 3
    segments, columns = Segments(labels), torch.randn(3, 3 * size, generator=rng).double()
    columns[:, ::3] += 1e3
    columns[0, : size // 2] = columns[0, 0]
    weights, order = (
        torch.rand(3 * size, generator=rng).double(),
        torch.randperm(3 * size, generator=rng),
    )
    axes, least = torch.eye(3).double(), torch.tensor([0.0, 1e-3, 1.0]).double()

    def stages():
        mean, covariance = segments.moments(list(columns), weights)
        _, about_zero = segments.moments(list(columns), weights, centered=False)
        periodic, mixed = (
            segments.reweigh(list(values), mean, axes, least, (1.48, 4.7))
            for values in (columns, columns[:, order])
        )
        return [mean, covariance, about_zero, *periodic, *mixed]

    found = stages()
    with definitions():
        assert_same(found, stages())


@pytest.mark.parametrize("most", [None, 1, 7])
def test_rows_and_outer_points_of_regions_are_those_of_the_definition(most, rng):
    places = torch.randn(900, 2, generator=rng).double()
    places[300:400, 1] = places[300:400, 0]
    places[400:410], places[500:600] = 1.0, places[500:600].round()
    labels = torch.arange(900).div(100, rounding_mode="floor") - 1
    labels = labels[torch.randperm(900, generator=rng)]

    def stages():
        segments = Segments(labels, max_points=most)
        columns = [segments.gather(column) for column in places.T]
        return [
            segments.rows,
            segments.counts,
            *map(torch.tensor, hull_candidates(segments, *columns)),
        ]

    found = stages()
    with definitions():
        assert_same(found, stages())
