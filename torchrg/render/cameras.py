"""Pinhole cameras that show a whole cloud, based on kornia."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

FIELD_OF_VIEW_DEG = 30.0
"""Field of view over the larger of width and height, in degrees."""
_MARGIN_FRACTION = 0.03
"""Margin on each side of the image, as a fraction of its size."""
_MIN_DISTANCE_FRACTION = 0.25
"""Minimum distance from the camera to the nearest point, as a fraction of the depth of the cloud. A
nearer camera would exaggerate the foreground."""
_MIN_ASPECT_RATIO = 0.25
"""Minimum aspect ratio (height to width) of an image without a given height."""


def make_camera(
    world_to_camera: Tensor, focal: float, center: tuple[float, float], width: int, height: int
) -> "PinholeCamera":
    """Create a camera with square pixels.

    Args:
        world_to_camera: Rigid transform to x right, y down, z forward, shape ``(4, 4)``.
        focal: Focal length, in pixels.
        center: Column and row of the principal point; integers are pixel centers.
        width: Width of the image, in pixels.
        height: Height of the image, in pixels.

    Returns:
        A batch of one camera, float64.

    Example:
        >>> camera = make_camera(torch.eye(4), 500.0, (319.5, 239.5), 640, 480)
        >>> camera.project(torch.tensor([[[0.5, 0.0, 1.0]]]).double()).round(decimals=3).tolist()
        [[[569.5, 239.5]]]
    """
    from kornia.geometry.camera import PinholeCamera

    intrinsics = torch.eye(4, dtype=torch.float64)
    intrinsics[0, 0] = intrinsics[1, 1] = focal
    intrinsics[0, 2], intrinsics[1, 2] = center
    size = torch.tensor([height]), torch.tensor([width])
    return PinholeCamera(intrinsics[None], world_to_camera.double()[None], *size)


def view_axes(toward: Tensor, up: Tensor) -> Tensor:
    """Return the right, down and forward axes of a camera.

    They are unit vectors as rows, ``(3, 3)``, float64. ``toward`` ``(3,)`` is the direction from
    the scene to the camera, and ``up`` ``(3,)`` that of the image, not parallel to it.
    """
    forward = -torch.nn.functional.normalize(toward.double(), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.double()), dim=0)
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


def fit_camera(
    points: Tensor, axes: Tensor, *, width: int, height: int | None = None
) -> "PinholeCamera":
    """Return the nearest camera with the given axes that has all points in its image.

    A point at ``(x, y, z)`` along the axes is in the image of a camera at ``(a, b, -d)`` if ``|x -
    a| <= t (d + z)``, where t is the tangent of half the field of view. The maximum of ``x - t z``
    and the minimum of ``x + t z`` determine a and d in closed form.

    Args:
        points: Points to show, shape ``(N, 3)``, finite.
        axes: Right, down and forward, shape ``(3, 3)``.
        width: Width of the image, in pixels.
        height: Height of the image. Default: fitted, from a quarter of the width to the width.
    """
    across = points.double() @ axes.to(points.device).T
    nearest, farthest = _bounds(across[:, 2])
    forward = across[:, 2] - nearest
    longer = max(width, height or width)
    half = math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
    distance = _MIN_DISTANCE_FRACTION * (farthest - nearest)
    midpoint = across.new_zeros(2)
    for axis, size in enumerate((width, height or width)):
        tangent = half * (1 - 2 * _MARGIN_FRACTION) * size / longer
        _, high = _bounds(across[:, axis] - tangent * forward)
        low, _ = _bounds(across[:, axis] + tangent * forward)
        midpoint[axis] = (low + high) / 2
        distance = max(distance, (high - low) / (2 * tangent))
    if bool((across == across[:1]).all()):  # Any distance shows a single point.
        distance = 1.0
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = axes
    matrix[:2, 3], matrix[2, 3] = -midpoint, distance - nearest
    focal = longer / 2 / half
    rays = (across[:, :2] - midpoint) / (forward + distance)[:, None]
    return _frame(matrix, focal, rays, width, height)


def sensor_camera(points: Tensor, *, width: int, height: int | None = None) -> "PinholeCamera":
    """Return a camera at the origin that looks along z, with x to the right and y down.

    For the arguments see :func:`fit_camera`; points behind the camera are ignored.
    """
    ahead = points[points[:, 2] > 0].double()
    rays = ahead[:, :2] / ahead[:, 2:]
    (left, right), (top, bottom) = _bounds(rays[:, 0]), _bounds(rays[:, 1])
    spans = (width, right - left), (height or width, bottom - top)
    scales = ((1 - 2 * _MARGIN_FRACTION) * size / span for size, span in spans if span > 0)
    return _frame(torch.eye(4), min(scales, default=float(width)), rays, width, height)


def _frame(
    world_to_camera: Tensor, focal: float, rays: Tensor, width: int, height: int | None
) -> "PinholeCamera":
    """Center the camera on rays ``(N, 2)``, and fit the height if None."""
    (left, right), (top, bottom) = _bounds(rays[:, 0]), _bounds(rays[:, 1])
    if height is None:
        needed = focal * (bottom - top) / (1 - 2 * _MARGIN_FRACTION)
        height = max(1, round(min(max(needed, _MIN_ASPECT_RATIO * width), width)))
    center = (
        (width - 1) / 2 - focal * (left + right) / 2,
        (height - 1) / 2 - focal * (top + bottom) / 2,
    )
    return make_camera(world_to_camera, focal, center, width, height)


def local_camera(camera: "PinholeCamera", origin: Tensor, *, finer: int) -> "PinholeCamera":
    """Return the float32 camera of points relative to an origin, with ``finer`` times the pixels.

    The origin, shape ``(3,)``, is applied in float64, so that clouds far from zero keep their
    precision.
    """
    intrinsics = camera.intrinsics[:1].double().clone()
    intrinsics[0, :2] *= finer
    intrinsics[0, :2, 2] += (finer - 1) / 2
    matrix = camera.extrinsics[:1].double().clone()
    matrix[0, :3, 3] += matrix[0, :3, :3] @ origin.to(matrix)
    size = (side[:1].to(origin.device) * finer for side in (camera.height, camera.width))
    return type(camera)(intrinsics.to(origin).float(), matrix.to(origin).float(), *size)


def project(camera: "PinholeCamera", points: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions ``(N, 3)`` in camera axes, and pixels ``(N, 2)``."""
    from kornia.geometry.camera import project_points
    from kornia.geometry.linalg import transform_points

    positions = transform_points(camera.extrinsics, points[None])[0]
    return positions, project_points(positions, camera.camera_matrix[0])


def _bounds(values: Tensor) -> tuple[float, float]:
    """Return the minimum and maximum, or zeros if empty."""
    if len(values) == 0:
        return 0.0, 0.0
    low, high = values.aminmax()
    return float(low), float(high)
