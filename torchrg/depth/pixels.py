"""Per-pixel normals, curvature and noise, and connectivity of adjacent pixels."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import nonzero_rows
from torchrg.config import DepthConfig
from torchrg.depth.normals import FLAT, PixelPlanes
from torchrg.depth.passes import has_kernels, pass_over_rows
from torchrg.depth.windows import Image, Windows
from torchrg.linalg.angles import deg_to_sq_chord, sq_chords

_WIDE_ANGLE_FACTOR = 1.75
"""Factor of the maximum angle between the normals of two windows that both contain both pixels. On
a column, large windows turn by more than the angle from one cell to the next."""
_MAX_SLOPE_NOISE = 1.0
"""Maximum slope difference, in standard deviations, of two windows that both contain both pixels,
at any angle. The small windows of a narrow surface turn by noise alone."""


class Pixels(NamedTuple):
    """Per-pixel measurements ``(H, W)``; normals are unit vectors ``(H, W, 3)``.

    ``curvature`` is the fraction of a window's variance perpendicular to its plane; ``noise`` is
    the noise of inverse depth in large windows. ``valid`` marks pixels that have a plane; normals
    and curvature are 0 otherwise. ``right`` and ``down`` mark pixels on one surface with the next.
    """

    normals: Tensor
    curvature: Tensor
    noise: Tensor
    valid: Tensor
    right: Tensor
    down: Tensor


class InverseCloud(NamedTuple):
    """A depth image as a cloud in which planes stay planes and noise does not depend on depth.

    Its coordinates are the slopes of the ray and the inverse depth, ``(x / z, y / z, c / z)`` with
    the median depth ``c``: a projective map of space. ``values`` ``(H, W)`` are the last coordinate
    and ``noise`` is its noise, ``x`` ``(W,)`` and ``y`` ``(H,)`` are slopes, in float64; ``seen``
    masks depth.
    """

    values: Tensor
    x: Tensor
    y: Tensor
    noise: Tensor
    seen: Tensor

    @property
    def points(self) -> Tensor:
        """All points ``(H * W, 3)``."""
        rays = self.x.expand_as(self.values), self.y[:, None].expand_as(self.values)
        return torch.stack([column.flatten() for column in (*rays, self.values)]).T


def describe_pixels(
    image: Image, planes: PixelPlanes, focal: tuple[float, float], config: DepthConfig
) -> Pixels:
    """Return normals towards the camera, curvature, noise, and surface connectivity.

    A deviation e of inverse depth equals a distance of ``distance * z * e`` to the plane; a column
    step equals ``(x_step - x_slope * z * ray) z`` along it.

    Two pixels are on one surface if both have a flat window and their normals in space are within
    the angle. At both pixels, their planes must differ by at most ``max_step`` times the allowed
    deviation of a flat window: no region crosses a step. If both windows contain both pixels the
    angle may be larger: a crease between the pixels would lie within two flat windows.
    """
    values, seen, flat = image.values, image.seen, planes.flat
    x, y = image.u / focal[0], image.v / focal[1]
    wider = min(_WIDE_ANGLE_FACTOR * config.max_angle_deg, 90.0)
    limits = config.max_step, deg_to_sq_chord(config.max_angle_deg), deg_to_sq_chord(wider)
    if has_kernels(values):
        curvature, noise = torch.empty_like(values), torch.empty_like(values)
        valid, right, down = (torch.empty_like(seen) for _ in range(3))
        normals = values.new_empty(*values.shape, 3)
        found = Pixels(normals, curvature, noise, valid, right, down)
        size = sum(table.numel() for table in planes.squares.values())
        windows = planes.squares[1].as_strided((size,), (1,)), planes.narrow.flatten()
        fixed = *image, x, y, planes.window, flat, *windows, planes.pixels
        parameters = *focal, *planes.noise, *limits
        pass_over_rows("describe_pixels", len(y), *fixed, *found, *parameters)
        return found
    index = torch.arange(values.numel(), device=values.device)
    flattened, sides, _ = planes.select(index)
    chosen = Windows(*(column.view(values.shape) for column in flattened))
    noise = planes.noise.evaluate(values)
    valid = flat | (seen & chosen.deviation.isfinite())
    is_smooth = chosen.deviation > FLAT * chosen.tolerance
    limit = torch.maximum(chosen.tolerance, noise)
    tolerance = torch.where(is_smooth, chosen.deviation, limit)
    scaled = chosen.u_slope * focal[0], chosen.v_slope * focal[1], chosen.origin
    length = (scaled[0].square() + scaled[1].square() + scaled[2].square()).sqrt()
    length = torch.where(length > 0, length, 1.0)
    z = 1 / torch.where(values > 0, values, 1.0)
    across = (z * torch.where(valid, chosen.deviation, 0.0) / length).square()
    rays, y = x * x + (y * y)[:, None] + 1, y[:, None]
    along = torch.zeros_like(z)
    slopes = (chosen.u_slope, chosen.v_slope)
    for side, slope, f, coordinate in zip(
        sides.view(2, *z.shape).flip(0), slopes, focal, (x, y), strict=True
    ):
        step, spread = slope * z, (side * side - 1) / 12
        along = along + spread * (step * step * rays - 2 / f * step * coordinate + 1 / (f * f))
    total = across + along * z * z
    variation = (across / torch.where(total > 0, total, 1.0)).clamp(max=1 / 3)
    normals = torch.stack([-column / length for column in scaled], dim=-1)
    joins = [_join(image, planes, normals, tolerance, limits, axis) for axis in (1, 0)]
    return Pixels(
        torch.where(valid[..., None], normals, 0.0),
        torch.where(valid, variation, 0.0),
        noise,
        valid,
        *joins,
    )


def _join(
    image: Image,
    planes: PixelPlanes,
    normals: Tensor,
    tolerance: Tensor,
    limits: tuple[float, float, float],
    axis: int,
) -> Tensor:
    """Return a mask of pixels on one surface with the next along an axis, ``(H, W)``.

    ``tolerance`` ``(H, W)`` is the allowed deviation of the windows; ``limits`` are the step, the
    angle and the wider angle.
    """
    max_step, max_sq_chord, wider_sq_chord = limits
    flat, indices, width = planes.flat, planes.window.flatten(), len(image.u)
    length, joined = flat.shape[axis] - 1, torch.zeros_like(flat)
    both = flat.narrow(axis, 0, length) & flat.narrow(axis, 1, length)
    here = nonzero_rows(torch.nn.functional.pad(both, (0, axis, 0, 1 - axis)))
    there = here + (width, 1)[axis]
    row, column = here // width, here % width
    ours, sides, middles = planes.select(here)
    theirs, their_sides, their_middles = planes.select(there)
    u_slope, v_slope = ours.u_slope - theirs.u_slope, ours.v_slope - theirs.v_slope
    step = u_slope * image.u[column] + v_slope * image.v[row] + ours.origin - theirs.origin
    next_step = step + (v_slope, u_slope)[axis]
    tolerance, normals = tolerance.flatten(), normals.view(-1, 3)
    limit = max_step * torch.maximum(tolerance[here], tolerance[there])
    turned = sq_chords(*(normals[at][:, :, None].unbind(dim=1) for at in (here, there))).squeeze(1)
    sq_noise = _sq_slope_noise(sides, tolerance[here])
    sq_noise = sq_noise + _sq_slope_noise(their_sides, tolerance[there])
    similar = u_slope.square() + v_slope.square() <= _MAX_SLOPE_NOISE**2 * sq_noise
    both_hold = contain(sides, middles, there, width) & contain(
        their_sides, their_middles, here, width
    )
    accepted = (turned <= max_sq_chord) | ((similar | (turned <= wider_sq_chord)) & both_hold)
    accepted &= (step.abs() <= limit) & (next_step.abs() <= limit)
    joined.view(-1)[here] = accepted | (indices[here] == indices[there])
    return joined


def _sq_slope_noise(sides: Tensor, tolerance: Tensor) -> Tensor:
    """Return the slope variance of windows with the given rows and columns, ``(2, n)``.

    For least squares over m n pixels of variance (n^2 - 1) / 12 along an axis, their mean.
    """
    rows, columns = sides.unbind()
    count = rows * columns
    return 6 * tolerance.square() * (1 / (rows * rows) + 1 / (columns * columns)) / count


def contain(sides: Tensor, middles: Tensor, pixels: Tensor, width: int) -> Tensor:
    """Return a mask of windows that contain pixels, by row-major index; ``width`` is in pixels.

    ``sides`` ``(2, n)`` are their rows and columns, ``middles`` row and column of centers.
    """
    (rows, columns), (row, column) = sides.unbind(), middles.unbind()
    down, right = (pixels // width - row).abs(), (pixels % width - column).abs()
    return (down <= rows / 2) & (right <= columns / 2)
