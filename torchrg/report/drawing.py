"""From points and a camera to a picture."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrg.report.cameras import Projection, projection_of
from torchrg.report.grid import CloudGrid, surface_cells
from torchrg.report.raster import DepthBuffer, close_gaps, depth_and_colors
from torchrg.report.shading import light_colors, shade_hollows

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_BLOCK = 131_072  # points in work at a time
_RADIUS = 1.3  # of a disc, in units of the local spacing: closes surfaces but for a few gaps
_LARGEST = 4  # times the usual radius, for stray points
_WIDEST, _ALWAYS = 0.02, 8.0  # largest radius of a disc, in widths of the picture or in pixels
_GAP = 0.6  # half the width of the gaps that are closed, in disc radii
_STEEPEST = 0.05  # least cosine of the angle under which a disc is seen


def draw_picture(
    camera: "PinholeCamera",
    grid: CloudGrid,
    spacing: Tensor,
    kept: Tensor,
    colors: Tensor,
    normals: Tensor | None,
    *,
    supersampling: int,
) -> Tensor:
    """Draw the kept points of a cloud as discs, close gaps, shade, and average pixels.

    Args:
        camera: A batch of one, with the size of the picture.
        grid: The cloud, of at least one finite point.
        spacing: Of its finite points, shape ``(n,)``.
        kept: Which of them to draw, shape ``(n,)``, bool.
        colors: Of all points, shape ``(N, 3)``, uint8.
        normals: Of all points, shape ``(N, 3)``. Default: those of small cubes of the cloud.
        supersampling: Pixels along the side of each pixel of the picture.

    Returns:
        Shape ``(H, W, 3)``, uint8.
    """
    width, height = int(camera.width), int(camera.height)
    project = projection_of(camera, grid.origin, finer=supersampling)
    lengths = _RADIUS * spacing.clamp(max=_LARGEST * float(spacing.median()))
    places = kept.nonzero().squeeze(-1)
    radius, length = _usual_radius(project, grid.points, lengths, places)
    widest = supersampling * max(_ALWAYS, _WIDEST * width)
    buffer = DepthBuffer(
        width * supersampling, height * supersampling, max_radius=widest, device=places.device
    )
    cells = surface_cells(grid) if normals is None else None
    for block in torch.split(places, _BLOCK):
        rows = grid.rows[block]
        if cells is not None:
            slant = cells.normals[cells.cell_of[block]]
        elif normals is not None:
            slant = normals[rows].float()
        _draw_block(
            buffer,
            project,
            grid.points[block],
            colors[rows],
            slant,
            lengths[block],
            least=supersampling / 2,
        )
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
    sample = places[:: max(1, len(places) // _BLOCK)]
    depth = project(points[sample])[0][:, 2]
    sample, depth = sample[depth > 0], depth[depth > 0]
    if len(sample) == 0:
        return 1.0, 0.0
    return float((lengths[sample] / depth).median()) * project.focal, float(
        lengths[sample].median()
    )


def _draw_block(
    buffer: DepthBuffer,
    project: Projection,
    points: Tensor,
    colors: Tensor,
    normals: Tensor,
    lengths: Tensor,
    *,
    least: float,
) -> None:
    """Draw points as lit discs of radii ``lengths`` in the unit of the cloud, ``least`` in pixels.

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
    buffer.draw_discs(
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
