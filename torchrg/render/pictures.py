"""Pictures of clouds, and the PNG files that hold them."""

import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_choices, check_floating, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.io.files import atomic_path, refusing
from torchrg.linalg import unit_direction
from torchrg.metrics.contingency import INTEGERS, check_labels
from torchrg.render.cameras import Projection, fit_camera, projection_of, sensor_camera, view_axes
from torchrg.render.cutaway import View, choose_viewpoint, find_sides
from torchrg.render.raster import (
    DepthBuffer,
    Discs,
    close_gaps,
    depth_and_colors,
    light_colors,
    shade_hollows,
)
from torchrg.render.surface import Surface, sample_surface

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_POINTS_AT_ONCE = 131_072
"""Points that are drawn together, which bounds the memory."""
_RADIUS = 1.3
"""Radius of a disc in units of the local spacing. Such discs close a surface but for a few gaps."""
_LARGEST = 4
"""Largest radius of a disc in a plane in units of the usual one, which elsewhere is the largest."""
_WIDEST = 0.02
"""Largest radius of a disc in widths of the picture, which bounds the time of drawing it."""
_ALWAYS, _MAX_RADIUS = 8.0, 64.0
"""Radii in pixels of the picture: one that a disc may always have, however small the picture is,
and the largest, however wide it is, as time grows with the square."""
_MAX_SIDE, _MAX_SUPERSAMPLING = 2**13, 16
"""Most pixels along a side, those of a screen of 8K, and within a pixel: memory holds them."""
_GAP = 0.6
"""Half the width of the gaps that are closed, in radii of a disc."""
_STEEPEST = 0.05
"""Least cosine of the angle under which a disc is seen: 87 degrees. Beyond, slopes get infinite."""
_FAR_APART = 6
"""Units of the usual spacing. Points farther from their neighbours are stray ones, and do not
decide what the picture shows."""


def draw_picture(
    camera: "PinholeCamera",
    surface: Surface,
    is_shown: Tensor,
    colors: Tensor,
    normals: Tensor | None,
    *,
    labels: Tensor | None = None,
    supersampling: int,
) -> Tensor:
    """Draw points of a cloud as discs, close gaps, shade, and average pixels.

    Args:
        camera: A batch of one, with the size of the picture.
        surface: The cloud, of at least one finite point.
        is_shown: Which of its n points to draw, shape ``(n,)``, bool.
        colors: Colours of all points, shape ``(N, 3)``, uint8.
        normals: Normals of all points, shape ``(N, 3)``. Default: those of the voxels.
        labels: Plane of each of the n points, shape ``(n,)``, or negative.
        supersampling: Pixels along the side of each pixel of the picture.

    Returns:
        Shape ``(H, W, 3)``, uint8.
    """
    width, height = int(camera.width), int(camera.height)
    project = projection_of(camera, surface.origin, finer=supersampling)
    lengths = _RADIUS * surface.disc_spacing(_LARGEST, labels)
    places = is_shown.nonzero().squeeze(-1)
    radius, length = _usual_radius(project, surface.points, lengths, places)
    widest = supersampling * min(max(_ALWAYS, _WIDEST * width), _MAX_RADIUS)
    buffer = DepthBuffer(
        width * supersampling, height * supersampling, max_radius=widest, device=places.device
    )

    def discs_of(chunk: Tensor) -> Discs:
        rows = surface.rows[chunk]
        slant = surface.normals_at(chunk) if normals is None else normals[rows]
        place, least = surface.points[chunk], supersampling / 2
        return _discs(project, place, colors[rows], slant.float(), lengths[chunk], least=least)

    parts = torch.split(places, _POINTS_AT_ONCE)
    for chunk in parts:
        buffer.draw(discs_of(chunk))
    buffer.end_drawing()
    for chunk in parts:
        buffer.paint(discs_of(chunk))
    reach = max(1, round(_GAP * min(radius, widest)))
    depth, paint = depth_and_colors(close_gaps(buffer.keys(), reach=reach, thickness=length))
    brightness = shade_hollows(
        _reduce(depth, supersampling, torch.maximum),
        focal=project.focal / supersampling,
        radius=max(1.0, radius / supersampling),
    )
    total = _reduce(paint.to(torch.int32), supersampling, torch.add)
    return (total * (brightness / supersampling**2)[..., None]).round_().to(torch.uint8)


def _usual_radius(
    project: Projection, points: Tensor, lengths: Tensor, places: Tensor
) -> tuple[float, float]:
    """Return the median radius of the discs, in pixels and in the unit of the cloud."""
    sample = places[:: max(1, len(places) // _POINTS_AT_ONCE)]
    depth = project(points[sample])[0][:, 2]
    sample, depth = sample[depth > 0], depth[depth > 0]
    if len(sample) == 0:
        return 1.0, 0.0
    return float((lengths[sample] / depth).median()) * project.focal, float(
        lengths[sample].median()
    )


def _discs(
    project: Projection,
    points: Tensor,
    colors: Tensor,
    normals: Tensor,
    lengths: Tensor,
    *,
    least: float,
) -> Discs:
    """Return lit discs of radii ``lengths`` in the unit of the cloud, at least ``least`` in pixels.

    Points behind the camera do not show.
    """
    positions, pixels = project(points)
    ahead = positions[:, 2] > 0
    if not bool(ahead.all()):
        positions, pixels, colors = positions[ahead], pixels[ahead], colors[ahead]
        normals, lengths = normals[ahead], lengths[ahead]
    normals = normals @ project.local_to_camera[0, :3, :3].T
    inverse = 1 / positions[:, 2]
    along = (normals * positions).sum(dim=-1) * inverse
    along = torch.where(
        along.abs() < _STEEPEST, torch.where(along < 0, -_STEEPEST, _STEEPEST), along
    )
    return Discs(
        pixels,
        inverse,
        light_colors(colors, normals, positions),
        (lengths * inverse * project.focal).clamp(min=least),
        # n . X = const gives 1 / z = n . ray / const, whose gradient in pixels is n_xy / focal.
        slopes=normals[:, :2] * (inverse / (along * project.focal))[:, None],
        max_change=lengths * inverse * inverse,
    )


def _reduce(image: Tensor, size: int, combine: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Combine the pixels of each square of ``size`` a side."""
    parts = [image[row::size, column::size] for row in range(size) for column in range(size)]
    return functools.reduce(combine, parts)


def render_cloud(
    points: Tensor | NDArray[np.floating],
    colors: Tensor | NDArray[np.uint8],
    *,
    normals: Tensor | NDArray[np.floating] | None = None,
    labels: Tensor | NDArray[np.integer] | None = None,
    view: View = "cutaway",
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
    width: int = 1400,
    height: int | None = None,
    supersampling: int = 2,
) -> Tensor:
    """Draw a cloud so that one sees at once what it is.

    ``"cutaway"`` looks from outside and leaves out the ceiling and the walls that face the viewer;
    ``"above"`` looks down and leaves out the ceiling; ``"outside"`` leaves out nothing;
    ``"sensor"`` looks from the origin along z, x to the right and y down, as a depth camera does.

    Convention:
        Points are drawn as discs as large as their distances, tilted by their normals. The picture
        does not depend on the order of the points nor, but for rounding, on unit and origin.

    Args:
        points: Points, shape ``(N, 3)``; those with NaN or Inf are left out.
        colors: Shape ``(N, 3)``, uint8.
        normals: For tilt and light, of arbitrary sign, shape ``(N, 3)``; zero where unknown.
            Default: those of voxels of the cloud.
        labels: Plane of each point, shape ``(N,)``, integers, negative for none, to tell walls and
            ceilings. Default: the voxels of the cloud are segmented.
        view: See above.
        up: Upward direction; not used from the sensor.
        azimuth_deg: Angle of the viewer about ``up``, from the direction along or across the
            largest wall that is nearest to x; clouds of one room are seen from one place.
            Default: of eight, the one from which most surface is seen.
        elevation_deg: Angle of the viewer over the horizon. Default: 35, from above 90.
        width: In pixels, at most 8,192.
        height: In pixels, at most 8,192. Default: what the cloud needs, from a quarter of the width
            to all of it.
        supersampling: Each pixel is the mean of the square of this many pixels a side.

    Returns:
        The picture, shape ``(height, width, 3)``, uint8. White if no point is finite.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If a setting is not as above.

    Example:
        >>> plane = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.zeros(1))
        >>> picture = render_cloud(plane, torch.zeros(81, 3, dtype=torch.uint8), width=40)
        >>> picture.shape[1:], picture.amin().item() < 100, picture[0, 0].tolist()
        (torch.Size([40, 3]), True, [255, 255, 255])
    """
    cloud, paint, slant = _check_cloud("render_cloud", points, colors, normals)
    planes = None
    if labels is not None:
        (planes,) = check_labels("render_cloud", labels=labels)
        check_shapes("render_cloud", points=(cloud, "N 3"), labels=(planes, "N"))
    check_choices("render_cloud", view=(view, View))
    upward = unit_direction("render_cloud", up)
    _check_sizes("render_cloud", _MAX_SIDE, width=width, height=height)
    _check_sizes("render_cloud", _MAX_SUPERSAMPLING, supersampling=supersampling)
    surface = sample_surface(cloud)
    if len(surface.rows) == 0:
        return _white(height or round(0.75 * width), width, cloud.device)
    planes = None if planes is None else planes[surface.rows]
    near = surface.spacing <= _FAR_APART * surface.spacing.median()
    is_shown = torch.ones_like(near)
    if view == "sensor":
        camera = sensor_camera(cloud[surface.rows[near]], width=width, height=height)
    else:
        upward = upward.to(surface.points)
        sides = find_sides(surface, planes, upward)
        viewpoint = choose_viewpoint(
            surface, sides, view, upward, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg
        )
        is_shown = (sides.of_points & viewpoint.cut) == 0
        shown = surface.points[is_shown & near].double() + surface.origin
        axes = view_axes(viewpoint.toward, viewpoint.up)
        camera = fit_camera(shown, axes, width=width, height=height)
    return draw_picture(
        camera, surface, is_shown, paint, slant, labels=planes, supersampling=supersampling
    )


def render_points(
    points: Tensor | NDArray[np.floating],
    colors: Tensor | NDArray[np.uint8],
    camera: "PinholeCamera",
    *,
    normals: Tensor | NDArray[np.floating] | None = None,
    supersampling: int = 2,
) -> Tensor:
    """Draw a cloud as a given camera sees it; see :func:`render_cloud`.

    Args:
        points: Points, shape ``(N, 3)``; those with NaN or Inf, or behind the camera, do not show.
        colors: Shape ``(N, 3)``, uint8.
        camera: A batch of one camera of kornia, with the size of the picture; for example from
            :func:`torchrg.render.make_camera`.
        normals: See :func:`render_cloud`.
        supersampling: See :func:`render_cloud`.

    Returns:
        The picture, shape ``(height, width, 3)``, uint8.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``supersampling`` is not from 1 to 16.

    Example:
        >>> from torchrg.render import make_camera
        >>> camera = make_camera(torch.eye(4), 10.0, (2.0, 1.0), 5, 3)
        >>> red = torch.tensor([[255, 0, 0]], dtype=torch.uint8)
        >>> picture = render_points(torch.tensor([[0.1, 0.0, 1.0]]), red, camera, supersampling=1)
        >>> picture[1, 2:4].tolist()
        [[255, 255, 255], [207, 0, 0]]
    """
    cloud, paint, slant = _check_cloud("render_points", points, colors, normals)
    _check_sizes("render_points", _MAX_SUPERSAMPLING, supersampling=supersampling)
    surface = sample_surface(cloud)
    if len(surface.rows) == 0:
        return _white(int(camera.height), int(camera.width), cloud.device)
    is_shown = torch.ones_like(surface.rows, dtype=torch.bool)
    return draw_picture(camera, surface, is_shown, paint, slant, supersampling=supersampling)


def _white(height: int, width: int, device: torch.device) -> Tensor:
    """Return a picture of nothing."""
    return torch.full((height, width, 3), 255, dtype=torch.uint8, device=device)


def write_png(path: str | os.PathLike[str], image: Tensor | NDArray[np.generic]) -> None:
    """Write a picture, or an image of labels, as a PNG file.

    Args:
        path: Where; the file appears whole or not at all.
        image: A picture of shape ``(H, W, 3)``, uint8, for 8 bits a channel; or whole numbers from
            0 to 65535 of shape ``(H, W)``, for 16 bits of gray.

    Raises:
        ShapeError: If the image is neither.
        FormatError: If the file cannot be written.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_png(f"{folder}/black.png", torch.zeros(4, 6, 3, dtype=torch.uint8))
        >>> sorted(os.listdir(folder))
        ['black.png']
    """
    tensor = as_tensor("write_png", "image", image).detach().cpu()
    is_picture = tensor.ndim == 3 and tensor.shape[2] == 3 and tensor.dtype == torch.uint8
    is_gray = tensor.ndim == 2 and tensor.dtype in INTEGERS
    if not (is_picture or is_gray) or tensor.numel() == 0:
        dtype = str(tensor.dtype).removeprefix("torch.")
        raise ShapeError(
            "write_png: expected image of shape (H, W, 3) and uint8, or (H, W) and integers, got "
            f"{tuple(tensor.shape)} and {dtype}."
        )
    values = tensor.numpy()
    if is_gray and not (values.min() >= 0 and values.max() <= 65535):
        raise ShapeError(
            f"write_png: expected image of values from 0 to 65535, got {values.min()} to "
            f"{values.max()}; add 1 to labels, so that UNLABELED becomes 0."
        )
    from kornia_rs import io

    repair = "; rename it, as pictures need a name in UTF-8"
    with atomic_path(path) as beside, refusing(f"{path}: ", UnicodeEncodeError, repair=repair):
        if is_picture:
            io.write_image_png_u8(str(beside), np.ascontiguousarray(values), "rgb")
        else:
            io.write_image_png_u16(str(beside), values.astype(np.uint16)[..., None], "mono")


def _check_cloud(
    caller: str,
    points: Tensor | NDArray[np.floating],
    colors: Tensor | NDArray[np.uint8],
    normals: Tensor | NDArray[np.floating] | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the arguments as tensors of agreeing shapes and right dtypes."""
    cloud, paint = as_tensor(caller, "points", points), as_tensor(caller, "colors", colors)
    slant = None if normals is None else as_tensor(caller, "normals", normals)
    check_shapes(caller, points=(cloud, "N 3"), colors=(paint, "N 3"), normals=(slant, "N 3"))
    check_floating(caller, points=cloud)
    check_floating(caller, normals=slant)
    if paint.dtype != torch.uint8:
        dtype = str(paint.dtype).removeprefix("torch.")
        raise ShapeError(f"{caller}: expected colors of uint8, got {dtype}; scale them to 0..255.")
    return cloud, paint, None if slant is None else slant.detach()


def _check_sizes(caller: str, most: int, **settings: int | None) -> None:
    """Raise ConfigError unless numbers of pixels are from 1 to ``most``."""
    for name, value in settings.items():
        if value is not None and not 1 <= value <= most:
            raise ConfigError(f"{caller}: expected {name} from 1 to {most:,}, got {value!r}.")
