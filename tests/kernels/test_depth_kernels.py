"""What kernels find at the pixels of depth images is what the definitions find."""

import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from tests.made import cameras_around, render_depth
from torchrg.config import DepthConfig
from torchrg.depth import segment_depth
from torchrg.depth.camera import has_depth, make_intrinsics
from torchrg.depth.faces import hidden_contacts
from torchrg.depth.growth import (
    assign_unlabeled_pixels,
    connect_pixels,
    fit_inverse_planes,
    move_to_creases,
)
from torchrg.depth.normals import fit_pixels
from torchrg.depth.pixels import describe_pixels
from torchrg.depth.segment import _inverse_cloud
from torchrg.depth.windows import Image
from torchrg.linalg.moments import Segments
from torchrg.regions.extents import hull_candidates
from torchrg.regions.growth import rank_by_size
from torchrg.scenes import build_room

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
ROUNDING = 1e-11


@pytest.fixture(params=FRAMES)
def depth(request):
    return FRAMES[request.param]


def image_of(depth):
    inverse = torch.where(has_depth(depth), 1 / depth.double(), 0.0)
    u, v = (torch.arange(n).double() - n / 2 + 0.5 for n in depth.T.shape)
    return Image(inverse, has_depth(depth), u, v)


FOCAL = (140.0, -150.0)


def stages_of(depth):
    """Return what each step of growing makes of an image."""
    image, config = image_of(depth), DepthConfig()
    x, y = image.u / FOCAL[0], image.v / FOCAL[1]
    planes = fit_pixels(image, focal=FOCAL, noise=None, dtype=depth.dtype)
    pixels = describe_pixels(image, planes, FOCAL, config)
    labels = rank_by_size(connect_pixels(planes.choice.flat, pixels.right, pixels.down), 20)
    cloud = _inverse_cloud(image, pixels, x, y)
    found = [*planes.squares.values(), planes.narrow, planes.pixels, *planes.choice, *pixels]
    found += [labels]
    if bool((labels >= 0).any()):
        fit = fit_inverse_planes(cloud, labels, max_pixels=500)
        reach = fit.scale_thickness(3.0)
        absorbed = assign_unlabeled_pixels(cloud, labels, fit, reach)
        found += [*fit, absorbed, *hidden_contacts(cloud.points, cloud.seen, labels, fit, reach)]
        found += [move_to_creases(cloud, absorbed, fit, reach)]
    return found


def assert_same(found, expected, tolerance=0.0):
    """Compare numbers up to a share of the largest of them, and choices exactly."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype
        finite = other[other.isfinite()]
        atol = (
            tolerance * float(finite.abs().max())
            if finite.is_floating_point() and len(finite)
            else 0
        )
        torch.testing.assert_close(one, other, rtol=tolerance, atol=atol, equal_nan=True)


def test_each_step_is_that_of_the_definition(depth):
    found = stages_of(depth)
    with definitions():
        # Roots in torch may be off by their last bit.
        assert_same(found, stages_of(depth), ROUNDING)


def test_threads_do_not_matter(depth, set_threads):
    found = []
    for threads in (1, 3):
        set_threads(threads)
        found.append(stages_of(depth))
    assert_same(*found)


@pytest.mark.filterwarnings("ignore:.*a field of view of", "ignore:.*expected a median depth")
def test_images_are_segmented_as_by_definition(depth):
    camera = make_intrinsics(*FOCAL, depth.shape[1] / 2, depth.shape[0] / 2)
    found = segment_depth(depth, camera, DepthConfig(min_size=20))
    with definitions():
        expected = segment_depth(depth, camera, DepthConfig(min_size=20))
    assert torch.equal(found.labels, expected.labels)
    torch.testing.assert_close(found.normals, expected.normals, equal_nan=True)


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
