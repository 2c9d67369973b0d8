"""Plane of each depth pixel, from the largest flat window around it."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import nonzero_rows
from torchrg.depth.passes import has_kernels, pass_over_rows
from torchrg.depth.windows import (
    CELL_SIZES,
    NARROW,
    NUM_PLANE,
    REACH,
    SIDE,
    Image,
    WindowNoise,
    Windows,
    find_jitter,
    fit_narrow_windows,
    fit_windows,
    noise_by_size,
    window_pixels,
)

FLAT = 1.35
"""Maximum deviation of a flat window from its plane, in tolerances."""
_MAX_PIXEL_NOISE = 3.5
"""Maximum distance of a pixel on the plane of a window, in units of the noise."""
_QUARTER_MARGIN = 2.0
"""Maximum ratio of the deviations of a flat window and its quarters, minus 1, times its side, in
pixels."""
_MIN_QUARTERS = 0.7
"""Minimum counted deviation of the quarters of a window, in units of the tolerance."""
_BEND_FRACTION = 0.005
"""Maximum bend of a flat window as a fraction of half its side, regardless of the noise."""
_MAX_BEND_FRACTION = 0.03
"""Maximum bend of a smallest window as a fraction of half its side, if none is flat. Twice this
value would hide creases of 20 degrees."""
_MAX_STEEPNESS = 4.0
"""Inverse cosine of the maximum angle at which a surface may bend; beyond it, steps look bent."""
_STEEP_SIZE = 2
"""Cell width of the windows used to measure jitter, in pixels."""


class PixelPlanes(NamedTuple):
    """Windows of an image, and the window chosen by each pixel ``(H, W)``.

    Windows are numbered from the smallest squares to the largest, then the horizontal narrow ones
    around ``pixels`` ``(n,)``, then the vertical ones. ``window`` is the number of each pixel's
    window; pixels without a flat one have the smallest square around them. ``flat`` marks pixels
    with a flat window, ``edge`` flat windows that are not centered on the pixel. ``squares`` are
    tables of :class:`Windows` by cell size, ``narrow`` is one ``(9, 2, n)``; ``noise`` is the noise
    of the largest windows.
    """

    window: Tensor
    flat: Tensor
    edge: Tensor
    squares: dict[int, Tensor]
    narrow: Tensor
    pixels: Tensor
    noise: WindowNoise

    def select(self, index: Tensor) -> tuple[Windows, Tensor, Tensor]:
        """Return the windows of pixels at row-major indices, their sides and their centers.

        Sides (rows, columns) and centers (row, column) have the shape ``(2, n)``.
        """
        width, like, parts = self.window.shape[1], self.narrow, []
        for size, table in self.squares.items():
            numbers = (torch.arange(n, device=like.device) for n in table.shape[1:])
            grid = torch.cartesian_prod(*numbers).T.to(like) * size + (size - 1) / 2
            parts.append(torch.cat([table.flatten(1), torch.full_like(grid, SIDE * size), grid]))
        middles = torch.stack([self.pixels // width, self.pixels % width]).to(like)
        for sides, table in zip(NARROW, like.unbind(dim=1), strict=True):
            lengths = middles.new_tensor(sides)[:, None].expand_as(middles)
            parts.append(torch.cat([table, lengths, middles]))
        *windows, high, wide, row, column = torch.cat(parts, dim=1)[:, self.window.flatten()[index]]
        return Windows(*windows), torch.stack([high, wide]), torch.stack([row, column])


def fit_pixels(
    image: Image,
    *,
    focal: tuple[float, float],
    noise: tuple[float, float] | None,
    dtype: torch.dtype,
) -> PixelPlanes:
    """Select for each pixel the largest flat window that contains it.

    In inverse depth ``w = 1 / z`` a plane in space is a plane over the image [1], ``w = (n_x x +
    n_y y + n_z) / d`` with the ray ``(x, y, 1)``. The noise of a triangulating sensor is uniform in
    ``w``, so ordinary least squares applies. A window is flat if its deviation is hardly above the
    noise (or a slight bend) and the deviation of its four quarters. A window across a step or an
    edge is not. For each size, largest first, a pixel takes the window around its cell if it is
    flat, otherwise the flattest window that contains it [2]. The pixel itself must be on the plane.
    If none is flat but the smallest is smooth, as on a noise-free column, it is taken. The
    remaining pixels, on surfaces at a grazing angle or a few pixels wide, are processed separately
    with narrow windows. Pixels in no flat window have the smallest square around them.

    ``focal`` are the focal lengths along columns and rows, ``noise`` is from
    :class:`torchrg.config.DepthConfig`, ``dtype`` is the dtype of the depth.

    References:
        [1] D. Gallup, J.-M. Frahm, M. Pollefeys. Piecewise planar and non-planar stereo for urban
        scene reconstruction. CVPR, 2010.
        [2] M. Kuwahara et al. Processing of RI-angiocardiographic images. Digital Processing of
        Biomedical Images, 1976.
    """
    squares = fit_windows(image)
    noises = noise_by_size(squares, noise, dtype)
    jitter = find_jitter(squares[_STEEP_SIZE], _STEEP_SIZE)
    window = torch.arange(image.seen.numel(), device=image.seen.device).view(image.seen.shape)
    flat, edge = torch.zeros_like(image.seen), torch.zeros_like(image.seen)
    choice = window, flat, edge
    first = sum(math.prod(table.shape[1:]) for table in squares.values())
    num_squares = first
    for size in CELL_SIZES:
        quarters = size // 2 if size // 2 in squares else None
        masks = (image.seen, flat) if size == 1 else (None, None)
        rate_windows(squares, size, noises, focal, masks, quarters=quarters)
        first -= math.prod(squares[size].shape[1:])
        offer_windows(choice, image, squares[size], size, first)
    pixels = nonzero_rows(image.seen & ~flat)
    indices = torch.full_like(window, -1)
    indices.view(-1)[pixels] = torch.arange(len(pixels), device=pixels.device)
    narrow = fit_narrow_windows(image, indices, pixels)
    rate_windows({1: narrow}, 1, noises, focal, jitter=jitter)
    chosen, off_center = choose_narrow(image, indices, pixels, narrow)
    is_taken = chosen >= 0
    pixel = pixels[is_taken]
    window.view(-1)[pixel] = num_squares + chosen[is_taken]
    flat.view(-1)[pixel] = True
    edge.view(-1)[pixel] = off_center[is_taken]
    return PixelPlanes(*choice, squares, narrow, pixels, noises[CELL_SIZES[0]])


def rate_windows(
    tables: Mapping[int, Tensor],
    size: int,
    noises: Mapping[int, WindowNoise],
    focal: tuple[float, float],
    masks: tuple[Tensor | None, Tensor | None] = (None, None),
    *,
    quarters: int | None = None,
    jitter: float = 0.0,
) -> None:
    """Compute the deviation limits of windows of a size; ``jitter`` of the rays is in pixels.

    A bend is a fraction of half a window's side on the surface. On a plane at distance d from the
    camera, a pixel at depth z is up to ``z^2 / (f d)`` long. A deviation e of inverse depth equals
    a distance of ``d z e`` to the plane. Windows that deviate by more than their ``quarters``, the
    windows of half the size, are not flat. With ``masks`` of seen pixels and of pixels in flat
    windows, kernels skip windows that contain no other seen pixel; their limits are undefined.
    """
    table, noise, half = tables[size], noises[size], SIDE * size / 2 / max(map(abs, focal))
    if has_kernels(table):
        finer = tables[size][0, :0] if quarters is None else tables[quarters][3]
        parameters = *noise, noises[quarters or size].factor, *focal, half, jitter
        pass_over_rows("rate_windows", table.shape[1], table, finer, *masks, *parameters, size)
        return
    u_slope, v_slope, origin, deviation, mean = table[:NUM_PLANE]
    sq_blur = jitter * jitter * (u_slope.square() + v_slope.square())
    by_noise = (noise.evaluate(mean).square() + sq_blur).sqrt()
    sq_nearness = (u_slope * focal[0]).square() + (v_slope * focal[1]).square() + origin.square()
    is_steep = sq_nearness > (_MAX_STEEPNESS * mean).square()
    bend = half * torch.where(is_steep, 0.0, sq_nearness) / mean
    bend = torch.where(mean > 0, bend, 0.0)
    tolerance = torch.maximum(by_noise, _BEND_FRACTION * bend)
    relative = deviation / tolerance
    is_flat = relative <= FLAT
    if quarters is not None:
        typical = _deviation_of_quarters(tables[quarters][3], relative.shape)
        # Errors of adjacent pixels are correlated, so parts of a flat window deviate less, too.
        typical = typical * (by_noise / noises[quarters].evaluate(mean))
        typical = torch.maximum(typical, _MIN_QUARTERS * tolerance)
        is_flat &= deviation <= (1 + _QUARTER_MARGIN / (SIDE * size)) * typical
    relative = torch.where(is_flat, relative, torch.inf)
    table[NUM_PLANE:] = torch.stack([by_noise, tolerance, _MAX_BEND_FRACTION * bend, relative])


def _deviation_of_quarters(deviation: Tensor, shape: torch.Size) -> Tensor:
    """Return the RMS deviation of the half-size windows that cover each window."""
    height, width = shape
    padded = deviation.new_full((2 * height + SIDE, 2 * width + SIDE), torch.inf)
    padded[REACH : REACH + deviation.shape[0], REACH : REACH + deviation.shape[1]] = deviation
    squares, count = deviation.new_zeros(shape), deviation.new_zeros(shape)
    for row in (0, SIDE):
        for column in (0, SIDE):
            quarter = padded[row : row + 2 * height : 2, column : column + 2 * width : 2]
            counted = quarter.isfinite()
            squares += torch.where(counted, quarter * quarter, 0.0)
            count += counted
    return torch.where(count > 0, squares / count, torch.inf).sqrt()


def offer_windows(
    choice: tuple[Tensor, Tensor, Tensor], image: Image, table: Tensor, size: int, first: int
) -> None:
    """Offer windows of a size, numbered from ``first``, to pixels without a window.

    A pixel takes the window around its cell if it is flat (or, for the smallest size, smooth),
    otherwise the flattest window that contains it. ``choice`` is written to: the window, flat and
    edge of :class:`PixelPlanes`.
    """
    windows, (window, flat, edge) = Windows(*table), choice
    if has_kernels(table):
        pass_over_rows("offer_windows", table.shape[1], *image, table, *choice, size, first)
        return
    itself = torch.arange(windows.mean.numel(), device=table.device).view_as(windows.mean)
    minimum, flattest = min_in_windows(windows.relative, REACH)
    off_center = torch.where(minimum.isfinite(), flattest, -1)
    reach = torch.maximum(_MAX_PIXEL_NOISE * windows.noise, windows.tolerance)
    centered = torch.where(windows.relative.isfinite(), itself, -1)
    offers = [(centered, _MAX_PIXEL_NOISE * windows.tolerance), (off_center, reach)]
    if size == 1:
        smooth = torch.where(windows.deviation <= windows.max_bend, itself, -1)
        offers.insert(1, (smooth, torch.full_like(reach, torch.inf)))
    for index, reach in offers:
        pixels = nonzero_rows(image.seen & ~flat)
        row, column = pixels // len(image.u), pixels % len(image.u)
        offered = index[row // size, column // size]
        is_taken = (offered >= 0) & _are_near(image, pixels, offered, table, reach)
        pixels = pixels[is_taken]
        window.view(-1)[pixels] = first + offered[is_taken]
        flat.view(-1)[pixels] = True
        edge.view(-1)[pixels] = index is off_center


def choose_narrow(
    image: Image, indices: Tensor, pixels: Tensor, table: Tensor
) -> tuple[Tensor, Tensor]:
    """Select the flatter narrow window around each pixel, otherwise the flattest containing it.

    A pixel must also be on its plane. For the arguments see :func:`fit_narrow_windows`. Returns
    row-major indices into the table, -1 for none, and a mask of the latter case.
    """
    if has_kernels(table):
        chosen, off_center = torch.empty_like(pixels), torch.empty_like(pixels, dtype=torch.bool)
        fixed = image.values, image.u, image.v, indices, pixels, table, chosen, off_center
        pass_over_rows("choose_narrow", len(pixels), *fixed)
        return chosen, off_center
    windows, count = Windows(*table), len(pixels)
    relative = windows.relative.flatten()
    reach = torch.maximum(_MAX_PIXEL_NOISE * windows.noise, windows.tolerance)

    def cost_in_reach(window: Tensor) -> Tensor:
        near = (window >= 0) & _are_near(image, pixels, window, table, reach)
        cost: Tensor = torch.where(near, relative[window], torch.inf)
        return cost

    centered = torch.arange(count, device=pixels.device)
    centered = torch.where(windows.relative[1] < windows.relative[0], centered + count, centered)
    takes_centered = cost_in_reach(centered).isfinite()
    minimum, flattest = torch.full_like(relative[:count], torch.inf), torch.full_like(pixels, -1)
    for shape, sides in enumerate(NARROW):
        for _, number in window_pixels(indices, pixels, *sides):
            window = torch.where(number >= 0, shape * count + number, -1)
            cost = cost_in_reach(window)
            flattest = torch.where(cost < minimum, window, flattest)
            minimum = torch.minimum(minimum, cost)
    return torch.where(takes_centered, centered, flattest), ~takes_centered & (flattest >= 0)


def _are_near(image: Image, pixels: Tensor, index: Tensor, table: Tensor, reach: Tensor) -> Tensor:
    """Return a mask of pixels within reach of windows, both by index."""
    u_slope, v_slope, origin = (values.flatten()[index] for values in table[:3])
    row, column = pixels // len(image.u), pixels % len(image.u)
    on_plane = u_slope * image.u[column] + v_slope * image.v[row]
    distance = (image.values[row, column] - (on_plane + origin)).abs()
    is_near: Tensor = distance <= reach.flatten()[index]
    return is_near


def min_in_windows(image: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return the minimum within reach of each cell along both axes, and its row-major index."""
    best, index = -image[None, None], torch.arange(image.numel(), device=image.device)
    for axis in (1, 0):
        size, pad = [1, 1], [0, 0]
        size[axis], pad[axis] = 2 * reach + 1, reach
        best, chosen = torch.nn.functional.max_pool2d(best, size, 1, pad, return_indices=True)
        index = index[chosen.flatten()]
    return -best[0, 0], index.view(image.shape)
