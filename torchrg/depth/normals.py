"""The plane at each pixel of a depth image: that of the largest flat window around it."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import map_rows
from torchrg.depth.windows import (
    CELL_SIZES,
    NARROW,
    REACH,
    SIDE,
    WindowNoise,
    WindowPlanes,
    find_jitter,
    fit_narrow_windows,
    fit_windows,
    noise_at,
    noise_by_size,
)

_FLAT = 1.35
"""A flat window deviates from its plane by at most this many times the tolerance."""
_OWN_REACH = 3.5
"""A pixel is on the plane of a window within this many times the noise."""
_SAME_NOISE = 2.0
"""A flat window deviates from its plane at most by a factor of 1 plus this over its side in pixels
more than its quarters do from planes of their own."""
_LEAST_QUARTERS = 0.7
"""Least deviation of the quarters of a window that is counted, in units of the tolerance."""
_BEND = 0.005
"""Share of half its side by which a flat window may bend, however little noise there is."""
_MOST_BEND = 0.03
"""Share of half its side by which a window of the smallest size may bend where none is flat. Twice
as much would hide creases of 20 degrees."""
_STEEPEST = 4.0
"""Inverse of the cosine of the steepest angle at which a surface may bend. Seen at a steeper angle,
a step looks like a bend."""
_STEEP_SIZE = 2
"""Width of the cells of the windows that jitter is read from, in pixels."""
_PIXELS_AT_ONCE = 2**14
"""Pixels whose narrow windows are fitted at once."""


class PixelPlanes(NamedTuple):
    """A plane in inverse depth for each pixel, that of a window, in columns and rows from the axis.

    ``window`` tells pixels of one window from those of others, ``sides`` ``(2, H, W)`` are its rows
    and columns, and ``middle`` ``(2, H, W)`` row and column of its middle. ``valid`` tells which
    pixels have a plane, ``flat`` whether their window is flat, ``edge`` whether it is but could not
    lie around the pixel; ``noise`` is that of inverse depth, as large windows see it, ``tolerance``
    what a flat window may deviate by. All others are of shape ``(H, W)``.
    """

    planes: WindowPlanes
    window: Tensor
    sides: Tensor
    middle: Tensor
    valid: Tensor
    flat: Tensor
    edge: Tensor
    noise: Tensor
    tolerance: Tensor


class _Tolerances(NamedTuple):
    """Limits of deviation ``(h, w)``: noise, noise or a slight bend, the strongest bend."""

    noise: Tensor
    flat: Tensor
    most: Tensor


def fit_pixels(
    inverse: Tensor,
    seen: Tensor,
    u: Tensor,
    v: Tensor,
    *,
    focal: tuple[float, float],
    noise: tuple[float, float] | None,
    dtype: torch.dtype,
) -> PixelPlanes:
    r"""Choose for each pixel the largest flat window that holds it.

    In inverse depth ``w = 1 / z`` a plane of space is a plane over the image [1],
    ``w = (n_x x + n_y y + n_z) / d`` with the ray ``(x, y, 1)``, and the noise of a triangulating
    sensor is the same everywhere, so that plain least squares is right. A window is flat when it
    deviates from its plane by hardly more than the noise, or than a slight bend, and than its four
    quarters do from planes of their own; one across a step or an edge is not. For each size, the
    largest first, a pixel takes the window around its cell if that is flat; else the flattest
    window that holds it [2]; in both cases only if the pixel itself is on the plane. Where none is
    flat but the smallest is smooth, as on a column without noise, it takes that. What is left then,
    on faces seen at a grazing angle or a few pixels wide, is seen again by itself, with narrow
    windows. Pixels in no flat window have the smallest square around them.

    ``inverse`` ``(H, W)``, float64, is anything finite where not ``seen``; columns ``u`` ``(W,)``
    and rows ``v`` ``(H, 1)`` count from the optical axis; ``focal`` are the focal lengths along
    both, ``noise`` is that of :class:`torchrg.config.DepthConfig`, ``dtype`` that of the depth.

    References:
        [1] D. Gallup, J.-M. Frahm, M. Pollefeys. Piecewise planar and non-planar stereo for urban
        scene reconstruction. CVPR, 2010.
        [2] M. Kuwahara et al. Processing of RI-angiocardiographic images. Digital Processing of
        Biomedical Images, 1976.
    """
    planes = fit_windows(inverse, seen, u, v)
    noises = noise_by_size(planes, noise, dtype)
    windows, first = dict[int, _SquareWindows](), 0
    for size, of_size in planes.items():
        limit = _tolerances(of_size, noises[size], size, focal)
        windows[size] = _SquareWindows(size, first, of_size, noises[size], limit)
        first += of_size.mean.numel()
    choice = _Choice(inverse, seen, u, v)
    for size in CELL_SIZES:
        _offer_windows(choice, windows[size], windows.get(size // 2))
    limits = partial(
        _tolerances, noise=noises[1], size=1, focal=focal, jitter=find_jitter(planes[_STEEP_SIZE])
    )
    narrow = _NarrowWindows(first, *_flat_narrow_windows(choice, limits))
    if len(narrow.pixel):
        _offer_narrow_windows(choice, narrow)
    every: list[_SquareWindows | _NarrowWindows] = [*windows.values(), narrow]
    return _pixel_planes(choice, seen, every, noises[CELL_SIZES[0]].at(inverse))


class _SquareWindows(NamedTuple):
    """The windows of one size; they are numbered through all sizes, these from ``first`` on."""

    size: int
    first: int
    planes: WindowPlanes
    noise: WindowNoise
    limit: _Tolerances

    @property
    def sides(self) -> tuple[Tensor, Tensor]:
        """Rows and columns of each window, each ``(h, w)``."""
        side = torch.full_like(self.planes.mean, SIDE * self.size)
        return side, side

    @property
    def middles(self) -> tuple[Tensor, Tensor]:
        """Row and column of the middle pixel of each window, each ``(h, w)``."""
        mean, size = self.planes.mean, self.size
        row, column = (
            torch.arange(length, device=mean.device, dtype=mean.dtype) * size + (size - 1) / 2
            for length in mean.shape
        )
        return row[:, None].expand_as(mean), column.expand_as(mean)


class _NarrowWindows(NamedTuple):
    """Flat narrow windows ``(k,)`` by middle pixel, and what they hold ``(k, 27)``, or -1."""

    first: int
    planes: WindowPlanes
    limit: _Tolerances
    shape: Tensor
    pixel: Tensor
    held: Tensor
    width: int
    size: int = 1

    @property
    def sides(self) -> tuple[Tensor, Tensor]:
        """Rows and columns of each window, each ``(k,)``."""
        sides = self.planes.mean.new_tensor(NARROW)[self.shape]
        return sides[:, 0], sides[:, 1]

    @property
    def middles(self) -> tuple[Tensor, Tensor]:
        """Row and column of the middle pixel of each window, each ``(k,)``."""
        pixel = self.pixel.to(self.planes.mean.dtype)
        return (pixel / self.width).floor(), pixel % self.width


def _offer_windows(
    choice: "_Choice", windows: _SquareWindows, quarters: _SquareWindows | None
) -> None:
    """Offer pixels the flat windows of a size; the smallest has no ``quarters``."""
    limit, deviation = windows.limit, windows.planes.deviation
    relative = _flatness(windows, quarters)
    own = torch.arange(relative.numel(), device=relative.device).view(relative.shape)
    choice.offer(windows, torch.where(relative <= _FLAT, own, -1), _OWN_REACH * limit.flat)
    if quarters is None:
        smooth = torch.where(deviation <= limit.most, own, -1)
        choice.offer(windows, smooth, torch.full_like(deviation, torch.inf))
    least, places = least_in_windows(relative, REACH)
    reach = torch.maximum(_OWN_REACH * limit.noise, limit.flat)
    choice.offer(windows, torch.where(least <= _FLAT, places, -1), reach, beside=True)


def _flat_narrow_windows(
    choice: "_Choice", limits: Callable[[WindowPlanes], _Tolerances]
) -> tuple[WindowPlanes, _Tolerances, Tensor, Tensor, Tensor, int]:
    """Return the flat ones among the narrow windows around pixels that have none, and of them."""
    pixels, parts = choice.waiting, []
    left = torch.zeros_like(choice.flat).index_fill(0, pixels, value=True)
    for some in torch.split(pixels, _PIXELS_AT_ONCE):
        planes, held = fit_narrow_windows(choice.values, left, choice.u, choice.v, some)
        limit = limits(planes)
        shape, place = (planes.deviation <= _FLAT * limit.flat).nonzero().unbind(dim=1)
        at = shape * len(some) + place
        held = held.flatten(0, 1)[at]
        parts.append([*planes.take(at), *(part.flatten()[at] for part in limit), shape])
        parts[-1] += [some[place], held]
    *numbers, shape, pixel, held = (torch.cat(part) for part in zip(*parts, strict=True))
    planes, limit = WindowPlanes(*numbers[:5]), _Tolerances(*numbers[5:])
    return planes, limit, shape, pixel, held, choice.shape[1]


def _offer_narrow_windows(choice: "_Choice", narrow: _NarrowWindows) -> None:
    """Offer pixels the flatter narrow window around them, then the flattest that holds them."""
    relative = narrow.planes.deviation / narrow.limit.flat
    reach = torch.maximum(_OWN_REACH * narrow.limit.noise, narrow.limit.flat)
    window = torch.arange(len(relative), device=relative.device)
    choice.offer(narrow, _least_by_pixel(choice, narrow.pixel, window, relative), reach)
    held, beside = narrow.held.flatten(), window.repeat_interleave(narrow.held.shape[1])
    tables = _tables(narrow.planes, reach)
    on_plane = (held >= 0) & _are_near(held.clamp(min=0), beside, tables, choice.image)
    held, beside = held[on_plane], beside[on_plane]
    places = _least_by_pixel(choice, held, beside, relative[beside])
    choice.offer(narrow, places, reach, beside=True)


def _least_by_pixel(choice: "_Choice", pixels: Tensor, windows: Tensor, cost: Tensor) -> Tensor:
    """Return the window of the least cost for each pixel ``(H, W)``, of equal ones the first."""
    none = len(windows)
    least = cost.new_full((choice.window.numel(),), torch.inf)
    least = least.scatter_reduce(0, pixels, cost, "amin")
    ranked = torch.where(cost == least[pixels], windows, none)
    first = torch.full_like(choice.window, none).scatter_reduce(0, pixels, ranked, "amin")
    return torch.where(first < none, first, -1).view(choice.shape)


def _flatness(windows: _SquareWindows, quarters: _SquareWindows | None) -> Tensor:
    """Return what windows deviate by in units of the tolerance; inf if their quarters do less."""
    limit, deviation = windows.limit, windows.planes.deviation
    relative = deviation / limit.flat
    if quarters is None:
        return relative
    usual = _deviation_of_quarters(quarters.planes.deviation, relative.shape)
    # Neighbouring pixels err alike, so that parts of a flat window deviate less too.
    usual = usual * (limit.noise / quarters.noise.at(windows.planes.mean))
    usual = torch.maximum(usual, _LEAST_QUARTERS * limit.flat)
    same = deviation <= (1 + _SAME_NOISE / (SIDE * windows.size)) * usual
    return torch.where(same, relative, torch.inf)


class _Choice:
    """The window that each pixel takes, numbered through all sizes: the first that it is on."""

    def __init__(self, inverse: Tensor, seen: Tensor, u: Tensor, v: Tensor) -> None:
        self.shape = inverse.shape
        self.values, self.u, self.v = inverse, u, v
        self.window = torch.arange(inverse.numel(), device=inverse.device)
        self.flat = torch.zeros_like(self.window, dtype=torch.bool)
        self.edge = torch.zeros_like(self.flat)
        self.waiting = seen.flatten().nonzero().squeeze(1)

    def take(self, images: Sequence[Tensor]) -> Tensor:
        """Return the values of the pixels' windows ``(H, W)`` from those of each size."""
        return torch.cat([part.flatten() for part in images])[self.window].view(self.shape)

    @property
    def image(self) -> tuple[Tensor, Tensor, Tensor]:
        """Inverse depth by row-major place, columns and rows."""
        return self.values.flatten(), self.u, self.v.flatten()

    def offer(
        self,
        windows: _SquareWindows | _NarrowWindows,
        places: Tensor,
        reach: Tensor,
        *,
        beside: bool = False,
    ) -> None:
        """Offer each cell of a size a window, by its row-major place ``(h, w)``; -1 for none.

        A pixel takes it if it is within reach ``(h, w)`` of the window's plane; the windows are
        around the cells unless ``beside``.
        """
        waiting, sizes = self.waiting, (windows.size, places.shape[1])
        (chosen,) = map_rows(
            _chosen_windows,
            [waiting],
            places.flatten(),
            *_tables(windows.planes, reach),
            *self.image,
            waiting.new_tensor(sizes),
        )
        is_taken = chosen >= 0
        taken = waiting[is_taken]
        self.window[taken] = chosen[is_taken] + windows.first
        self.flat[taken] = True
        self.edge[taken] = beside
        self.waiting = waiting[~is_taken]


def _tables(planes: WindowPlanes, reach: Tensor) -> list[Tensor]:
    """Return the planes of windows and how far from them a pixel may be, each ``(T,)``."""
    parts = planes.u_slope, planes.v_slope, planes.origin, reach
    return [part.flatten() for part in parts]


def _chosen_windows(
    pixels: Tensor,
    places: Tensor,
    u_slope: Tensor,
    v_slope: Tensor,
    origin: Tensor,
    reach: Tensor,
    values: Tensor,
    u: Tensor,
    v: Tensor,
    sizes: Tensor,
) -> tuple[Tensor]:
    """Return the window that cells offer pixels near it, or -1; ``sizes`` are width and columns."""
    size, num_columns = sizes.unbind()
    width = u.shape[0]
    row, column = pixels // width, pixels % width
    offered = places[row // size * num_columns + column // size]
    tables, image = (u_slope, v_slope, origin, reach), (values, u, v)
    is_near = _are_near(pixels, offered.clamp(min=0), tables, image)
    return (torch.where(is_near, offered, -1),)


def _are_near(
    pixels: Tensor,
    windows: Tensor,
    tables: Sequence[Tensor],
    image: tuple[Tensor, Tensor, Tensor],
) -> Tensor:
    """Tell which pixels are within the reach of windows, both by place; see :func:`_tables`."""
    u_slope, v_slope, origin, reach = tables
    values, u, v = image
    width = u.shape[0]
    on_plane = u_slope[windows] * u[pixels % width] + v_slope[windows] * v[pixels // width]
    away = values[pixels] - (on_plane + origin[windows])
    return away.abs() <= reach[windows]


def _pixel_planes(
    choice: _Choice,
    seen: Tensor,
    windows: Sequence[_SquareWindows | _NarrowWindows],
    noise: Tensor,
) -> PixelPlanes:
    """Return the planes of the windows that pixels chose."""
    table = zip(*(part.planes for part in windows), strict=True)
    planes = WindowPlanes(*(choice.take(part) for part in table))
    tolerance = choice.take([part.limit.flat for part in windows])
    sides, middles = (
        torch.stack([choice.take(part) for part in zip(*pairs, strict=True)])
        for pairs in ([part.sides for part in windows], [part.middles for part in windows])
    )
    flat = choice.flat.view(choice.shape)
    is_smooth = flat & (planes.deviation > _FLAT * tolerance)
    tolerance = torch.where(is_smooth, planes.deviation, torch.maximum(tolerance, noise))
    return PixelPlanes(
        planes,
        choice.window.view(choice.shape),
        sides,
        middles,
        flat | (seen & planes.deviation.isfinite()),
        flat,
        choice.edge.view(choice.shape),
        noise,
        tolerance,
    )


def _tolerances(
    planes: WindowPlanes,
    noise: WindowNoise,
    size: int,
    focal: tuple[float, float],
    *,
    jitter: float = 0.0,
) -> _Tolerances:
    """Return what windows of a size may deviate by; jitter is that of the rays, in pixels.

    A bend is a share of half a window's side on the surface. On a plane at a distance d from the
    camera, seen at a depth z, a pixel is up to ``z^2 / (f d)`` long, and a deviation e of inverse
    depth is one of ``d z e`` from the plane.
    """
    half = SIDE * size / 2 / max(map(abs, focal))
    columns = [planes.u_slope, planes.v_slope, planes.origin, planes.mean]
    limits = map_rows(
        _tolerances_of_planes,
        [part.flatten() for part in columns],
        planes.mean.new_tensor(noise),
        planes.mean.new_tensor([*focal, half, jitter]),
    )
    return _Tolerances(*(part.view(planes.mean.shape) for part in limits))


def _tolerances_of_planes(
    u_slope: Tensor, v_slope: Tensor, origin: Tensor, mean: Tensor, noise: Tensor, view: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return :class:`_Tolerances`; ``view`` is focal lengths, half a window's side, and jitter."""
    fx, fy, half, jitter = view.unbind()
    sq_blur = jitter.square() * (u_slope.square() + v_slope.square())
    by_noise = (noise_at(mean, *noise.unbind()).square() + sq_blur).sqrt()
    sq_nearness = (u_slope * fx).square() + (v_slope * fy).square() + origin.square()
    is_steep = sq_nearness > (_STEEPEST * mean).square()
    bend = half * torch.where(is_steep, 0.0, sq_nearness) / mean
    bend = torch.where(mean > 0, bend, 0.0)
    return by_noise, torch.maximum(by_noise, _BEND * bend), _MOST_BEND * bend


def _deviation_of_quarters(deviation: Tensor, shape: torch.Size) -> Tensor:
    """Return the root mean square deviation of the windows of half the size that cover windows."""
    height, width = shape
    corner = SIDE
    padded = deviation.new_full((2 * height + corner, 2 * width + corner), torch.inf)
    padded[REACH : REACH + deviation.shape[0], REACH : REACH + deviation.shape[1]] = deviation
    squares, count = deviation.new_zeros(shape), deviation.new_zeros(shape)
    for row in (0, corner):
        for column in (0, corner):
            part = padded[row : row + 2 * height : 2, column : column + 2 * width : 2]
            counted = part.isfinite()
            squares += torch.where(counted, part * part, 0.0)
            count += counted
    return torch.where(count > 0, squares / count, torch.inf).sqrt()


def least_in_windows(image: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return the least value within reach of each cell along both axes, and its row-major place."""
    best, place = -image[None, None], torch.arange(image.numel(), device=image.device)
    for axis in (1, 0):
        size, pad = [1, 1], [0, 0]
        size[axis], pad[axis] = 2 * reach + 1, reach
        best, chosen = torch.nn.functional.max_pool2d(best, size, 1, pad, return_indices=True)
        place = place[chosen.flatten()]
    return -best[0, 0], place.view(image.shape)
