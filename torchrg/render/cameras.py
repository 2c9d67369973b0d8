"""Pinhole cameras that show a whole cloud; kornia holds them and projects."""

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_MARGIN = 0.03
"""Share of the picture that stays free on each side."""
_NEAREST = 0.25
"""Least distance from the camera to the nearest point, in depths of the cloud. A nearer camera
would show what is in front much larger than what is behind."""
_FLATTEST = 0.25
"""Least ratio of height to width of a picture whose height is not given."""


def make_camera(
    world_to_camera: Tensor, focal: float, center: tuple[float, float], width: int, height: int
) -> "PinholeCamera":
    """Return a camera of square pixels.

    Args:
        world_to_camera: Rigid transform to x right, y down, z forward, shape ``(4, 4)``.
        focal: Focal length in pixels.
        center: Column and row of the principal point; whole numbers are pixel centres.
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.

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
    """Return the axes right, down, forward of a camera.

    Args:
        toward: Direction from the scene to the camera, shape ``(3,)``.
        up: Direction that is up in the picture, not parallel to ``toward``, shape ``(3,)``.

    Returns:
        Unit vectors as rows, shape ``(3, 3)``, float64.

    Example:
        >>> view_axes(torch.tensor([0.0, -1, 0]), torch.tensor([0.0, 0, 1])).abs().tolist()
        [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    """
    forward = -torch.nn.functional.normalize(toward.double(), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.double()), dim=0)
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


def fit_camera(
    points: Tensor,
    axes: Tensor,
    *,
    width: int,
    height: int | None = None,
    field_of_view_deg: float = 30.0,
) -> "PinholeCamera":
    """Return the nearest camera of given axes that has all points in its picture.

    A point at ``(x, y, z)`` along the axes is in the picture of a camera at ``(a, b, -d)`` if
    ``|x - a| <= t (d + z)`` with t the tangent of half the angle of view: the largest ``x - t z``
    and the smallest ``x + t z`` give a and d in closed form.

    Args:
        points: What to show, shape ``(N, 3)``, finite.
        axes: Right, down and forward, shape ``(3, 3)``.
        width: Width of the picture, in pixels.
        height: Height of the picture. Default: what the points need, from a quarter of the width
            to all of it.
        field_of_view_deg: Angle over the width; or over the height, if that is larger.

    Returns:
        The camera. If all points are in one place, it looks at it from a distance of 1.
    """
    across = points.double() @ axes.to(points.device).T
    nearest, farthest = _bounds(across[:, 2])
    forward = across[:, 2] - nearest
    longer = max(width, height or width)
    half = math.tan(math.radians(field_of_view_deg) / 2)
    distance = _NEAREST * (farthest - nearest)
    middle = across.new_zeros(2)
    for axis, size in enumerate((width, height or width)):
        tangent = half * (1 - 2 * _MARGIN) * size / longer
        _, high = _bounds(across[:, axis] - tangent * forward)
        low, _ = _bounds(across[:, axis] + tangent * forward)
        middle[axis] = (low + high) / 2
        distance = max(distance, (high - low) / (2 * tangent))
    if bool((across == across[:1]).all()):
        distance = 1.0
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = axes
    matrix[:2, 3], matrix[2, 3] = -middle, distance - nearest
    focal = longer / 2 / half
    rays = (across[:, :2] - middle) / (forward + distance)[:, None]
    return _frame(matrix, focal, rays, width, height)


def sensor_camera(points: Tensor, *, width: int, height: int | None = None) -> "PinholeCamera":
    """Return a camera in the origin that looks along z, x to the right and y down.

    Args:
        points: What to show, shape ``(N, 3)``, finite; points behind the camera do not count.
        width: Width of the picture, in pixels.
        height: Height of the picture. Default: what the points need, from a quarter of the width
            to all of it.

    Returns:
        The camera.
    """
    ahead = points[points[:, 2] > 0].double()
    rays = ahead[:, :2] / ahead[:, 2:]
    (left, right), (top, bottom) = _bounds(rays[:, 0]), _bounds(rays[:, 1])
    room = (1 - 2 * _MARGIN) * width, (1 - 2 * _MARGIN) * (height or width)
    scales = [
        size / span
        for size, span in zip(room, (right - left, bottom - top), strict=True)
        if span > 0
    ]
    return _frame(torch.eye(4), min(scales, default=float(width)), rays, width, height)


def _frame(
    world_to_camera: Tensor, focal: float, rays: Tensor, width: int, height: int | None
) -> "PinholeCamera":
    """Return the camera that has rays ``(N, 2)`` in the middle, of the height that they need."""
    (left, right), (top, bottom) = _bounds(rays[:, 0]), _bounds(rays[:, 1])
    if height is None:
        needed = focal * (bottom - top) / (1 - 2 * _MARGIN)
        height = max(1, round(min(max(needed, _FLATTEST * width), width)))
    center = (
        (width - 1) / 2 - focal * (left + right) / 2,
        (height - 1) / 2 - focal * (top + bottom) / 2,
    )
    return make_camera(world_to_camera, focal, center, width, height)


class Projection(NamedTuple):
    """How a camera maps points about an origin to pixels.

    Attributes:
        local_to_camera: Shape ``(1, 4, 4)``.
        intrinsics: Shape ``(3, 3)``.
    """

    local_to_camera: Tensor
    intrinsics: Tensor

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return float(self.intrinsics[0, 0])

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions ``(N, 3)`` in the camera's axes, and pixels ``(N, 2)``."""
        from kornia.geometry.camera import project_points
        from kornia.geometry.linalg import transform_points

        positions = transform_points(self.local_to_camera, points[None])[0]
        return positions, project_points(positions, self.intrinsics)


def projection_of(camera: "PinholeCamera", origin: Tensor, *, finer: int) -> Projection:
    """Return the projection of a camera onto a picture of ``finer`` times as many pixels a side.

    Args:
        camera: A batch of one.
        origin: Origin of the points that will be projected, shape ``(3,)``; taken in float64, so
            that clouds far from zero keep their precision.
        finer: Pixels along the side of each pixel of the camera.

    Returns:
        The projection, float32.
    """
    intrinsics = camera.intrinsics[0, :3, :3].double().clone()
    intrinsics[:2] *= finer
    intrinsics[:2, 2] += (finer - 1) / 2
    matrix = camera.extrinsics[:1].double().clone()
    matrix[0, :3, 3] += matrix[0, :3, :3] @ origin.to(matrix)
    return Projection(matrix.to(origin.device).float(), intrinsics.to(origin.device).float())


def _bounds(values: Tensor) -> tuple[float, float]:
    """Return the smallest and the largest value, or zeros if there are none."""
    if len(values) == 0:
        return 0.0, 0.0
    low, high = values.aminmax()
    return float(low), float(high)
