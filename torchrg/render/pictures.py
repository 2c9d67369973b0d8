"""Images of clouds, and PNG files."""

import functools
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_choices, check_floating, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.io.files import atomic_path, wrap_errors
from torchrg.linalg.angles import unit_direction
from torchrg.metrics.contingency import INTEGERS, check_labels
from torchrg.render import raster
from torchrg.render.cameras import fit_camera, local_camera, project, sensor_camera, view_axes
from torchrg.render.creases import find_creases, segment_surface
from torchrg.render.cutaway import View, choose_viewpoint, find_sides
from torchrg.render.legend import Legend, add_legend
from torchrg.render.surface import VisibleSurface, sample_rows, sample_surface
from torchrg.structures import AnyCloud
from torchrg.structures.points import Labels, Points

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_RADIUS = 1.3
"""Radius of a disc, in local spacings; leaves only a few gaps in a surface."""
_CREASE_REACH = 1.7
"""Factor for the radius of discs that end at a crease, up to which no gaps remain."""
_RADIUS_FRACTION = 0.02
"""Maximum radius of a disc, as a fraction of the image width; bounds the drawing time."""
_SMALL_RADIUS, _MAX_RADIUS = 8.0, 64.0
"""Maximum radii of a disc in pixels, for small and for any images; their squares bound the time."""
_MAX_SIDE, _MAX_SUPERSAMPLING = 2**13, 16
"""Maximum pixels per side (an 8K screen), and subpixels per pixel and axis; bound the memory."""
_MAX_SUBPIXELS = 2**26
"""Maximum number of subpixels of an image, 70 bytes each while it is drawn."""
_GAP_RADIUS = 0.6
"""Half the width of the gaps that are closed, in radii of a disc."""
_MIN_COSINE = 0.05
"""Minimum cosine of the viewing angle of a disc (87 degrees), beyond which slopes diverge."""
_OUTLIER_SPACING = 6
"""Distance to the neighbors, in median spacings, beyond which points do not affect the section."""


def draw_picture(
    camera: "PinholeCamera",
    surface: VisibleSurface,
    is_shown: Tensor,
    colors: Tensor,
    normals: Tensor | None,
    *,
    labels: Tensor,
    supersampling: int,
) -> Tensor:
    """Draw points as shaded discs, close gaps, and average subpixels.

    ``is_shown`` ``(n,)`` masks the points of the surface to draw, and ``labels`` ``(n,)`` are their
    planes. Colors and normals cover all points. See :func:`render_cloud`.
    """
    width, height = int(camera.width), int(camera.height)
    if width * height * supersampling**2 > _MAX_SUBPIXELS:
        raise ConfigError(
            f"render_cloud: expected at most {_MAX_SUBPIXELS:,} subpixels, got {width:,} x "
            f"{height:,} pixels with supersampling {supersampling}; lower one of them."
        )
    camera = local_camera(camera, surface.origin, finer=supersampling)
    indices = is_shown.nonzero().squeeze(-1)
    lengths = _RADIUS * surface.disc_spacing(labels)[indices]
    rows, position = surface.rows[indices], surface.points[indices]
    voxel, creases = surface.voxel_of[indices], find_creases(surface, labels)
    slant = creases.normals_at(position, voxel) if normals is None else normals[rows].float()
    ends = creases.bounds_of(position, slant, voxel)
    # Larger discs fill the surface up to its end.
    ends = ends * (ends[:, :, 3:].abs() < _CREASE_REACH * lengths[:, None, None])
    lengths = torch.where((ends != 0).flatten(1).any(dim=1), _CREASE_REACH * lengths, lengths)
    floor = supersampling / 2
    discs = _discs(camera, position, colors[rows], slant, lengths, floor=floor, ends=ends)
    discs = discs.by_color()
    widest = supersampling * min(max(_SMALL_RADIUS, _RADIUS_FRACTION * width), _MAX_RADIUS)
    keys = raster.draw_discs(
        discs, width=width * supersampling, height=height * supersampling, max_radius=widest
    )
    radius = float(discs.radii.clamp(max=widest).median()) if len(discs.radii) else 1.0
    reach = max(1, round(_GAP_RADIUS * radius / supersampling))
    steps = range(supersampling)
    parts = [keys[row::supersampling, column::supersampling] for row in steps for column in steps]
    # Edges of surfaces are partly covered pixels, which no closing of covered pixels extends.
    closed = raster.close_gaps(functools.reduce(torch.minimum, parts), reach=reach)
    thickness = float(lengths.median()) if len(lengths) else 0.0
    paint = torch.cat([colors.new_full((1, 3), 255), discs.colors])
    total = closed.new_zeros(height, width, 3, dtype=torch.int32)
    nearest = raster.split_keys(closed)[0]
    for part in parts:
        depth = raster.split_keys(part)[0]
        shown = torch.where(nearest > depth + thickness * depth * nearest, closed, part)
        total += paint[raster.split_keys(shown)[1]]
    return (total // supersampling**2).to(torch.uint8)


def _discs(
    camera: "PinholeCamera",
    points: Tensor,
    colors: Tensor,
    normals: Tensor,
    lengths: Tensor,
    *,
    floor: float,
    ends: Tensor,
) -> raster.Discs:
    """Return shaded discs of radii ``lengths``, in units of the cloud, at least ``floor`` pixels.

    Points behind the camera are dropped.
    """
    positions, pixels = project(camera, points)
    ahead = positions[:, 2] > 0
    if not bool(ahead.all()):
        positions, pixels, colors = positions[ahead], pixels[ahead], colors[ahead]
        normals, lengths, ends = normals[ahead], lengths[ahead], ends[ahead]
    rotation, focal = camera.extrinsics[0, :3, :3], float(camera.fx)
    normals, across = normals @ rotation.T, ends[:, :, :3] @ rotation.T
    inverse = 1 / positions[:, 2]
    along = (normals * positions).sum(dim=-1) * inverse
    min_cosine = torch.where(along < 0, -_MIN_COSINE, _MIN_COSINE)
    along = torch.where(along.abs() < _MIN_COSINE, min_cosine, along)
    # n . X = const gives 1 / z = n . ray / const, with the gradient n_xy / focal in pixels.
    slopes = normals[:, :2] * (inverse / (along * focal))[:, None]
    # On the disc, m . X - e = z (m . ray - e / z), of which the factor of z is linear, too.
    offset = (across * positions[:, None]).sum(dim=2) - ends[:, :, 3]
    bounds = across[:, :, :2] / focal - offset[:, :, None] * slopes[:, None]
    return raster.Discs(
        pixels,
        inverse,
        raster.light_colors(colors, normals, positions),
        (lengths * inverse * focal).clamp(min=floor),
        slopes=slopes,
        max_change=lengths * inverse * inverse,
        bounds=torch.cat([ends[:, :, 3:] * inverse[:, None, None], bounds], dim=2),
    )


def render_cloud(
    points: AnyCloud,
    colors: Tensor | NDArray[np.uint8],
    *,
    normals: Points | None = None,
    labels: Labels | None = None,
    view: View | "PinholeCamera" = "cutaway",
    up: Sequence[float] | str = "z",
    azimuth_deg: float | None = None,
    elevation_deg: float | None = None,
    width: int = 1400,
    height: int | None = None,
    supersampling: int = 2,
    legend: Legend | None = None,
) -> Tensor:
    """Render a cloud from a camera, chosen automatically or given.

    ``"cutaway"`` looks from outside, without the ceiling and the walls that face the viewer;
    ``"above"`` looks down, without the ceiling; ``"outside"`` shows everything; ``"sensor"`` looks
    from the origin along z, with x to the right and y down, like a depth camera.

    Convention:
        Points are drawn as discs with the radius of the local spacing, tilted by their normals. The
        image depends neither on the order of the points nor, but for rounding, on unit and origin.
        Of more than half a million points, a sample is drawn that is even on the surfaces.

    Args:
        points: Points, shape ``(N, 3)``; points with NaN or Inf are omitted.
        colors: Shape ``(N, 3)``, uint8.
        normals: Normals of any sign, shape ``(N, 3)``; zero if unknown. Default: voxel normals.
        labels: Plane of each point, shape ``(N,)``, integers, negative for none, from which walls
            and ceilings are found. Default: the voxels are segmented.
        view: See above; or a batch of one kornia camera, with the size of the image, such as from
            :func:`torchrg.render.make_camera`. Points behind a camera are omitted.
        up: Up direction, three numbers or the name of an axis. It and the angles are ignored for
            ``"sensor"`` and for a given camera.
        azimuth_deg: Azimuth of the camera about ``up``, in degrees, from the direction of
            most walls nearest to x, so that clouds of one room share a camera.
            Default: the one of eight with the most visible surface.
        elevation_deg: Elevation of the camera, in degrees. Default: 35, from above 90.
        width: Width in pixels, at most 8,192; about 4,800 at the default supersampling.
        height: Height in pixels, at most 8,192. Default: fitted, from a quarter of the width on.
        supersampling: Subpixels per pixel and axis, which are averaged.
        legend: Title, colors and unit to add below the image, with a scale bar. Default: none.

    Returns:
        The image, shape ``(height, width, 3)``, uint8; higher with a legend. White if no point is
        finite.

    Raises:
        ShapeError: If a shape or dtype is invalid.
        ConfigError: If a setting is invalid.

    Example:
        >>> plane = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.zeros(1))
        >>> picture = render_cloud(plane, torch.zeros(81, 3, dtype=torch.uint8), width=40)
        >>> picture.shape[1:], picture.amin().item() < 100, picture[0, 0].tolist()
        (torch.Size([40, 3]), True, [255, 255, 255])
    """
    cloud, paint, slant = _check_cloud(points, colors, normals)
    planes = None
    if labels is not None:
        (planes,) = check_labels("render_cloud", labels=labels)
        check_shapes("render_cloud", points=(cloud, "N 3"), labels=(planes, "N"))
    if isinstance(view, str):
        check_choices("render_cloud", view=(view, View))
    else:
        width, height = int(view.width), int(view.height)
    upward = unit_direction("render_cloud", up)
    limits = {"width": _MAX_SIDE, "height": _MAX_SIDE, "supersampling": _MAX_SUPERSAMPLING}
    for (name, limit), value in zip(limits.items(), (width, height, supersampling), strict=True):
        if value is not None and not 1 <= value <= limit:
            raise ConfigError(f"render_cloud: expected {name} from 1 to {limit:,}, got {value!r}.")
    sampled = sample_rows(cloud)
    cloud, paint = cloud[sampled], paint[sampled]
    slant = None if slant is None else slant[sampled]
    planes = None if planes is None else planes[sampled]
    surface = sample_surface(cloud)
    if len(surface.rows) == 0:
        shape = (height or round(0.75 * width), width, 3)
        return torch.full(shape, 255, dtype=torch.uint8, device=cloud.device)
    planes = segment_surface(surface) if planes is None else planes[surface.rows]
    near = surface.spacing <= _OUTLIER_SPACING * surface.spacing.median()
    is_shown = torch.ones_like(near)
    if not isinstance(view, str):
        camera = view
    elif view == "sensor":
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
    image = draw_picture(
        camera, surface, is_shown, paint, slant, labels=planes, supersampling=supersampling
    )
    if legend is None:
        return image
    camera = local_camera(camera, surface.origin, finer=1)
    depth = float(project(camera, surface.points[near].mean(dim=0, keepdim=True))[0][0, 2])
    return add_legend(image, legend, float(camera.fx) / abs(depth or 1.0))


def write_png(path: str | os.PathLike[str], image: Tensor | NDArray[np.generic]) -> None:
    """Write an RGB or label image as a PNG file.

    Args:
        path: Output path, written atomically.
        image: An RGB image of shape ``(H, W, 3)``, uint8, for 8 bits per channel; or integers from
            0 to 65535 of shape ``(H, W)``, for 16-bit grayscale.

    Raises:
        ShapeError: If the image has another shape or dtype.
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

    repair = "; rename it, image file names must be valid UTF-8"
    with (
        atomic_path(path) as temporary,
        wrap_errors(f"{path}: ", UnicodeEncodeError, repair=repair),
    ):
        if is_picture:
            io.write_image_png_u8(str(temporary), np.ascontiguousarray(values), "rgb")
        else:
            io.write_image_png_u16(str(temporary), values.astype(np.uint16)[..., None], "mono")


def _check_cloud(
    points: AnyCloud, colors: Tensor | NDArray[np.uint8], normals: Points | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the arguments as tensors, after checking shapes and dtypes."""
    caller = "render_cloud"
    cloud, paint = as_tensor(caller, "points", points), as_tensor(caller, "colors", colors)
    slant = None if normals is None else as_tensor(caller, "normals", normals)
    check_shapes(caller, points=(cloud, "N 3"), colors=(paint, "N 3"), normals=(slant, "N 3"))
    check_floating(caller, points=cloud)
    check_floating(caller, normals=slant)
    if paint.dtype != torch.uint8:
        dtype = str(paint.dtype).removeprefix("torch.")
        raise ShapeError(f"{caller}: expected colors of uint8, got {dtype}; scale them to 0..255.")
    return cloud, paint, None if slant is None else slant.detach()
