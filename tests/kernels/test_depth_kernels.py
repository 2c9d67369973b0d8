"""What kernels find at the pixels of depth images is what the definitions find."""

import pytest
import torch

from tests.kernels.clouds import definitions, needs_library
from tests.made import build_scanned_room, cameras_around, render_depth
from torchrg.config import DepthConfig
from torchrg.depth import segment_depth
from torchrg.depth.camera import make_intrinsics
from torchrg.depth.growth import PixelGrid, fit_inverse_planes
from torchrg.depth.pixels import InverseCloud
from torchrg.linalg.moments import Segments, kth_smallest
from torchrg.regions.extents import fit_rectangles
from torchrg.structures.planes import PLANE_COLUMNS

pytestmark = pytest.mark.skipif(not needs_library, reason="needs the library of kernels")


def frames():
    """Depth images by name: made, noisy, exact, with holes, random, tiny, huge and thin ones."""
    generator = torch.Generator().manual_seed(0)
    model = build_scanned_room(3)
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
            *fit_rectangles(segments, *columns),
        ]

    found = stages()
    with definitions():
        assert_same(found, stages())


def image_of_regions(rng):
    """Return a cloud of steps and slopes, and labels with strips, lines and single pixels."""
    height, width = 45, 70
    x, y = (torch.arange(n).double() / 100 - 0.3 for n in (width, height))
    labels = (torch.arange(width) // 9)[None] + 8 * (torch.arange(height) // 20)[:, None]
    labels[::7] = 3
    labels[:, 33:36] = 24
    labels[torch.rand(height, width, generator=rng) < 0.1] = -1
    labels[5, 5], labels[44, 60:] = 25, 26
    values = 1 + 0.1 * torch.rand(27, generator=rng).double()[labels] * x + 0.2 * y[:, None]
    values += 1e-4 * torch.randn(height, width, generator=rng)
    noise = 1e-4 * (1 + torch.rand(height, width, generator=rng).double())
    return InverseCloud(values, x, y, noise, labels >= 0), labels


def test_regions_of_an_image_meet_as_by_definition(rng):
    cloud, labels = image_of_regions(rng)

    def stages():
        fit = fit_inverse_planes(cloud, labels.flatten())
        return [*fit, *PixelGrid(labels.shape).contacts(labels.flatten())]

    found = stages()
    assert len(found[-1]) > 20
    assert found[1].isfinite().all()
    with definitions():
        assert_same(found, stages())


def test_a_line_of_pixels_has_the_plane_of_least_slope(rng):
    # Slopes across the line are unknown, and 0.
    x, y = torch.arange(40).double(), torch.arange(30).double()
    along, labels = (x + y[:, None]) / 2, torch.full((30, 40), -1)
    labels[torch.arange(30), torch.arange(30)] = 0
    labels[2, 10:], labels[20, 3] = 1, 2
    seen = labels >= 0
    fit = fit_inverse_planes(InverseCloud(along, x, y, 0 * along + 1e-3, seen), labels.flatten())
    slopes = -fit.normal[:, :2] / fit.normal[:, 2:]
    torch.testing.assert_close(slopes, torch.tensor([[0.5, 0.5], [0.5, 0], [0, 0]]).double())


@pytest.mark.parametrize("kind", ["random", "periodic", "equal", "with NaN"])
def test_a_value_of_a_rank_is_that_of_sorted_values(kind, rng):
    values = torch.randn(5000, generator=rng)
    if kind == "periodic":
        values = (torch.arange(5000) % 64) * 0.1
    elif kind == "equal":
        values[:4990] = 0.5
    elif kind == "with NaN":
        values[::3] = torch.nan
    for numbers in (values, values.double(), values[:7]):
        expected = numbers.sort().values
        for rank in {0, 1, len(numbers) // 2, len(numbers) - 1}:
            found = kth_smallest(numbers, rank)
            torch.testing.assert_close(found, expected[rank], rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("fraction", [0.0, 0.33, 0.5, 1.0])
def test_quantiles_of_regions_are_those_of_the_definition(fraction, rng):
    labels = torch.randint(-1, 40, (900,), generator=rng)
    labels[labels == 7] = 8  # A region without points.
    values = torch.randn(900, generator=rng)
    values[::50] = torch.nan
    segments = Segments(labels)
    for numbers in (values, values.double()):
        found = segments.quantile(segments.gather(numbers), fraction)
        with definitions():
            assert_same([found], [segments.quantile(segments.gather(numbers), fraction)])
        assert found[7].isnan()
