"""Pictures of clouds."""

from typing import TYPE_CHECKING, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError, ShapeError
from torchrg.report.cameras import fit_camera, sensor_camera, view_axes
from torchrg.report.drawing import draw_picture
from torchrg.report.grid import build_grid, local_spacing, surface_cells
from torchrg.report.views import View, choose_viewpoint

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_FAR_APART = 6  # times the usual spacing: stray points, which do not decide what is shown


def render_cloud(
    points: Tensor | NDArray[np.floating],
    colors: Tensor | NDArray[np.uint8],
    *,
    normals: Tensor | NDArray[np.floating] | None = None,
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
            Default: those of small cubes of the cloud.
        view: See above.
        up: Upward direction; not used from the sensor.
        azimuth_deg: Angle of the viewer about ``up``, from the normal of the largest walls.
            Default: of eight, the one from which most surface is seen.
        elevation_deg: Angle of the viewer over the horizon. Default: 35, from above 90.
        width: In pixels.
        height: In pixels. Default: what the cloud needs, from a quarter of the width to all of it.
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
    if view not in get_args(View):
        names = ", ".join(get_args(View))
        raise ConfigError(f"render_cloud: expected view to be one of {names}, got {view!r}.")
    if not any(up):
        raise ConfigError("render_cloud: expected up to be a direction, got zeros.")
    _check_at_least_one("render_cloud", width=width, height=height, supersampling=supersampling)
    grid = build_grid(cloud)
    if len(grid.rows) == 0:
        shape = (height or round(0.75 * width), width, 3)
        return torch.full(shape, 255, dtype=torch.uint8, device=cloud.device)
    spacing = local_spacing(grid)
    near = spacing <= _FAR_APART * spacing.median()
    kept = torch.ones_like(near)
    if view == "sensor":
        camera = sensor_camera(cloud[grid.rows[near]], width=width, height=height)
    else:
        upward = functional.normalize(grid.points.new_tensor(up), dim=0)
        viewpoint = choose_viewpoint(
            surface_cells(grid), view, upward, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg
        )
        kept = viewpoint.keeps(grid.points)
        shown = grid.points[kept & near].double() + grid.origin
        axes = view_axes(viewpoint.toward, viewpoint.up)
        camera = fit_camera(shown, axes, width=width, height=height)
    return draw_picture(camera, grid, spacing, kept, paint, slant, supersampling=supersampling)


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
            :func:`torchrg.report.make_camera`.
        normals: As for :func:`render_cloud`.
        supersampling: As for :func:`render_cloud`.

    Returns:
        The picture, shape ``(height, width, 3)``, uint8.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``supersampling`` is below 1.

    Example:
        >>> from torchrg.report import make_camera
        >>> camera = make_camera(torch.eye(4), 10.0, (2.0, 1.0), 5, 3)
        >>> red = torch.tensor([[255, 0, 0]], dtype=torch.uint8)
        >>> picture = render_points(torch.tensor([[0.1, 0.0, 1.0]]), red, camera, supersampling=1)
        >>> picture[1, 2:4].tolist()
        [[255, 255, 255], [207, 0, 0]]
    """
    cloud, paint, slant = _check_cloud("render_points", points, colors, normals)
    _check_at_least_one("render_points", supersampling=supersampling)
    grid = build_grid(cloud)
    if len(grid.rows) == 0:
        shape = (int(camera.height), int(camera.width), 3)
        return torch.full(shape, 255, dtype=torch.uint8, device=cloud.device)
    kept = torch.ones_like(grid.rows, dtype=torch.bool)
    return draw_picture(
        camera, grid, local_spacing(grid), kept, paint, slant, supersampling=supersampling
    )


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


def _check_at_least_one(caller: str, **settings: int | None) -> None:
    for name, value in settings.items():
        if value is not None and value < 1:
            raise ConfigError(f"{caller}: expected {name} >= 1, got {value!r}.")
