"""Pinhole cameras: unprojection of depth images, and estimation from organized clouds."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes, is_concrete, is_tensor
from torchrg.depth.values import has_depth
from torchrg.errors import ConfigError, DepthWarning, warn
from torchrg.linalg.rigid import check_rigid
from torchrg.structures import FARTHEST

_MAX_ANGLE_DEG, _WIDE_ANGLE_DEG = 85.0, 75.0
"""Impossible and improbable angles from the optical axis to the farthest pixel, in degrees. A
pinhole camera cannot see 90, and lenses beyond 75 bend lines."""
_MIN_VIEW_DEG, _NARROW_VIEW_DEG = 0.001, 5.0
"""Impossible and improbable fields of view along the longer side, in degrees. Depth cameras see 40
to 120."""
_MAX_ASPECT = 1.25
"""Ratio of the focal lengths above which pixels are improbably far from square."""
_MAX_OFF_CENTER, _SLIGHTLY_OFF_CENTER = 0.15, 0.05
"""Maximum distances of the optical axis from the center, as fractions of a side. Depth cameras
reach 0.09. The smaller limit applies if exchanging ``cx`` and ``cy`` fits three times as well."""


def depth_to_points(depth: Tensor, intrinsics: Tensor, poses: Tensor | None = None) -> Tensor:
    """Unproject depth images to points in camera or world coordinates.

    Convention:
        Camera axes are x to the right, y down, z forward; ``depth`` is z, not the length of the
        ray. The center of the first pixel is at (0, 0). Negative focal lengths flip an axis.

    Args:
        depth: Shape ``(B, H, W)``, floating point, in any unit.
        intrinsics: Camera matrices, shape ``(B, 3, 3)``; see :func:`read_intrinsics`.
        poses: Camera-to-world matrices, shape ``(B, 4, 4)``. Default: camera coordinates.

    Returns:
        Points, shape ``(B, H, W, 3)``, in the unit of ``depth`` and in its dtype, or in that of the
        poses; NaN for missing depth, see :func:`torchrg.depth.values.has_depth`.

    Raises:
        ShapeError: If a shape or dtype is not as above, or a pose is no rigid motion.
        ConfigError: If a camera matrix is invalid, or impossible for such images.

    Warns:
        DepthWarning: If a camera is improbable; see :func:`check_view`.

    Example:
        >>> camera = torch.tensor([[2.0, 0, 0.5], [0, 2, 0.5], [0, 0, 1]])
        >>> depth_to_points(torch.tensor([[[4.0, 0], [4, 4]]]), camera[None])[0, :, :, 0]
        tensor([[-1., nan],
                [-1.,  1.]])
    """
    intrinsics = read_intrinsics("depth_to_points", intrinsics, depth)
    poses = None if poses is None else poses.to(depth.device)
    check_shapes(
        "depth_to_points",
        depth=(depth, "B H W"),
        intrinsics=(intrinsics, "B 3 3"),
        poses=(poses, "B 4 4"),
    )
    check_floating("depth_to_points", depth=depth)
    check_rigid("depth_to_points", "poses", poses)
    if is_concrete(intrinsics):
        check_view("depth_to_points", intrinsics, (depth.shape[2], depth.shape[1]))
    return _unproject(depth, intrinsics, poses)


def _unproject(depth: Tensor, intrinsics: Tensor, poses: Tensor | None) -> Tensor:
    """Implement :func:`depth_to_points`."""
    from kornia.geometry.depth import depth_to_3d_v2

    seen = has_depth(depth)
    points: Tensor = depth_to_3d_v2(torch.where(seen, depth, 1.0), intrinsics.to(depth))
    points = torch.where(seen[..., None], points, torch.nan)
    if poses is None:
        return points
    return points.to(poses.dtype) @ poses[:, None, :3, :3].mT + poses[:, None, None, :3, 3]


def read_intrinsics(caller: str, source: Any, depth: Tensor) -> Tensor:  # noqa: ANN401
    """Return camera matrices ``(3, 3)`` or ``(B, 3, 3)`` of pinhole cameras without skew.

    ``source`` is a tensor or array of such matrices, or of kornia's 4 x 4 matrices. It may also be
    a kornia ``PinholeCamera`` with the image size of ``depth`` ``(*, H, W)``.

    Raises:
        ShapeError: If it is not a tensor, array or camera.
        ConfigError: If it is not such a matrix.

    Warns:
        DepthWarning: If a ``PinholeCamera`` has another image size.
    """
    tensor = as_tensor(caller, "intrinsics", getattr(source, "camera_matrix", source))
    tensor = tensor[..., :3, :3] if tensor.shape[-2:] == (4, 4) else tensor
    if tensor.shape[-2:] == (3, 3) and is_concrete(tensor):
        check_camera(caller, tensor)
    sides = [getattr(source, side, None) for side in ("height", "width")]
    if all(is_tensor(side) and is_concrete(side) for side in sides):
        height, width = (int(side.flatten()[0]) for side in sides if side is not None)
        if (height, width) != tuple(depth.shape[-2:]):
            warn(
                f"{caller}: expected intrinsics of images of {depth.shape[-1]} x "
                f"{depth.shape[-2]} pixels, got a PinholeCamera of {width} x {height}; scale it.",
                DepthWarning,
            )
    return tensor.to(depth.device)


def check_camera(caller: str, intrinsics: Tensor) -> None:
    """Raise ConfigError if one of the matrices ``(*, 3, 3)`` is not a camera matrix."""
    matrices = intrinsics.detach().reshape(-1, 3, 3).double().cpu()
    focal = matrices.diagonal(dim1=1, dim2=2)[:, :2]
    constants = matrices[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
    is_camera = (matrices.abs() <= FARTHEST).all() and focal.reciprocal().isfinite().all()
    if not (is_camera and (constants == constants.new_tensor([0, 0, 0, 0, 1])).all()):
        raise ConfigError(
            f"{caller}: expected intrinsics of rows (fx, 0, cx), (0, fy, cy), (0, 0, 1), finite, "
            f"with fx and fy not 0, got {intrinsics.tolist()}."
        )


def check_view(caller: str, intrinsics: Tensor, size: tuple[int, int]) -> None:
    """Check that cameras ``(*, 3, 3)`` are plausible for images of ``size`` (width, height).

    Raises:
        ConfigError: If a camera is impossible.

    Warns:
        DepthWarning: If a camera is improbable, as for crops and stretched images.
    """
    rows = intrinsics.detach().reshape(-1, 9)[:, [0, 4, 2, 5]].double().cpu().tolist()
    for row in dict.fromkeys(map(tuple, rows)):
        if doubt := describe_improbable_view(caller, Pinhole(*row), size):
            warn(doubt, DepthWarning)


def describe_improbable_view(
    caller: str, camera: "Pinhole", size: tuple[int, int], *, name: str = "intrinsics"
) -> str:
    """Return a warning if a camera is improbable for an image size, otherwise "".

    ``name`` is the argument or flag that specifies the camera.

    Raises:
        ConfigError: If it is impossible.
    """
    if 0 in size:
        return ""
    focal, axis = (abs(camera.fx), abs(camera.fy)), (camera.cx, camera.cy)
    rows = list(zip(focal, axis, size, strict=True))
    angle = math.degrees(math.atan(max(max(c + 0.5, side - 0.5 - c) / f for f, c, side in rows)))
    view = math.degrees(2 * math.atan(max(side / (2 * f) for f, _, side in rows)))
    error = _off_center(axis, size)
    if angle > _WIDE_ANGLE_DEG:
        doubt = f"with pixels {angle:.3g} degrees off the optical axis; use pixels, not fractions"
    elif view < _NARROW_VIEW_DEG:
        doubt = f"with a field of view of {view:.2g} degrees; use focal lengths in pixels"
    elif max(focal) > _MAX_ASPECT * min(focal):
        doubt = "with non-square pixels; check the order of the numbers"
    elif error > _MAX_OFF_CENTER:
        doubt = "with an optical axis off the center; pass the camera of images of this size"
    elif error > max(_SLIGHTLY_OFF_CENTER, 3 * _off_center(axis[::-1], size)):
        doubt = "which fit better with cx and cy exchanged; swap them"
    elif 2 < size[0] == 2 * size[1]:
        doubt = "of a panorama, by its ratio of 2:1; project it to perspective images"
    else:
        return ""
    numbers = ",".join(f"{value:g}" for value in camera[:4])
    text = (
        f"{caller}: expected {name} fx,fy,cx,cy of images of {size[0]} x {size[1]} pixels, got "
        f"{numbers}, {doubt}."
    )
    if angle > _MAX_ANGLE_DEG or view < _MIN_VIEW_DEG:
        raise ConfigError(text)
    return text


def _off_center(axis: tuple[float, ...], size: tuple[int, int]) -> float:
    """Return the distance of an optical axis from the image center, as a fraction of a side.

    Half a pixel is tolerated, because programs differ in the center of the first pixel.
    """
    return max((abs(c + 0.5 - side / 2) - 0.5) / side for c, side in zip(axis, size, strict=True))


def unproject_image(depth: Tensor, intrinsics: Tensor, pose: Tensor | None = None) -> Tensor:
    """Apply :func:`depth_to_points` to one image ``(H, W)`` in float64: ``(H, W, 3)``.

    The camera must already be checked.
    """
    poses = None if pose is None else pose[None]
    return _unproject(depth[None].double(), intrinsics[None].double(), poses)[0]


def make_intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """Return a camera matrix ``(3, 3)``, float64, from focal lengths and optical axis in pixels.

    ``fx`` and ``cx`` are along rows, ``fy`` and ``cy`` along columns; the first center is 0.

    Raises:
        ConfigError: If a focal length is 0, or a value is not within 1e12.

    Example:
        >>> make_intrinsics(525, 525, 319.5, 239.5)[0].tolist()
        [525.0, 0.0, 319.5]
    """
    rows = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    matrix = torch.tensor(rows, dtype=torch.float64, device="cpu")
    check_camera("make_intrinsics", matrix)
    return matrix


def format_intrinsics(intrinsics: Tensor) -> str:
    """Return a camera matrix ``(3, 3)`` as ``fx,fy,cx,cy``."""
    values = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return ",".join(f"{value:.15g}" for value in values)


class Pinhole(NamedTuple):
    """A pinhole camera in pixels, with its image size (width, height) if known.

    ``depth_scale`` is the number of depth units per meter in its images, if known.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int] | None = None
    depth_scale: float | None = None

    def matrix(self, size: tuple[int, int] | None = None, caller: str = "Pinhole") -> Tensor:
        """Return the camera matrix ``(3, 3)``, float64, for images resized to ``size``.

        Convention:
            The center of the first pixel is 0. Resizing keeps the outer edges of the image, half a
            pixel outside the centers of the outermost pixels: ``cx + 0.5`` scales with ``fx``.

        Raises:
            ConfigError: If the aspect ratio differs by over a pixel, or the axis is outside.
        """
        fx, fy, cx, cy, calibrated, _ = self
        if size is None:
            return make_intrinsics(fx, fy, cx, cy)
        (width, height), (old_width, old_height) = size, calibrated or size
        if abs(width * old_height - height * old_width) > max(old_width, old_height):
            is_rotated = abs(height * old_height - width * old_width) <= max(old_width, old_height)
            repair = "rotate the images back, or " if is_rotated else ""
            raise ConfigError(
                f"{caller}: expected images of {old_width} x {old_height} pixels, as its camera's, "
                f"or in their ratio, got {width} x {height}; {repair}pass the camera of the depth "
                "images."
            )
        if size != (old_width, old_height):
            across, down = width / old_width, height / old_height
            fx, fy = fx * across, fy * down
            cx, cy = (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5
        if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
            raise ConfigError(
                f"{caller}: expected an optical axis within images of {width} x {height} pixels, "
                f"got {cx:g},{cy:g}; pass the camera of the depth images, or a file with its width "
                "and height."
            )
        return make_intrinsics(fx, fy, cx, cy)


def find_intrinsics(points: Tensor) -> Tensor | None:
    """Estimate the camera of an organized cloud.

    ``points`` ``(H, W, 3)`` are the points of the pixels in camera coordinates, NaN where missing.

    Returns:
        The camera matrix, shape ``(3, 3)``, float64. None if no pinhole camera projects nearly all
        points to within a tenth of a pixel: clouds of rotating scanners, or in world coordinates.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.

    Example:
        >>> camera = make_intrinsics(50.0, 50.0, 3.5, 2.5)
        >>> depth = torch.linspace(1, 2, 48, dtype=torch.float64).view(1, 6, 8)
        >>> matrix = find_intrinsics(depth_to_points(depth, camera[None])[0])
        >>> bool((matrix - camera).abs().max() < 1e-9)
        True
    """
    check_shapes("find_intrinsics", points=(points, "H W 3"))
    check_floating("find_intrinsics", points=points)
    seen = points.isfinite().all(dim=-1) & (points[..., 2] > 0)
    rows, columns = (indices.double() for indices in seen.nonzero().unbind(dim=1))
    x, y, z = points[seen].double().unbind(dim=1)
    across, down = _fit_line(x / z, columns), _fit_line(y / z, rows)
    if across is None or down is None:
        return None
    return make_intrinsics(across[0], down[0], across[1], down[1])


def reprojection_error(points: Tensor, intrinsics: Tensor) -> float:
    """Return the median reprojection error of points, in pixels.

    ``points`` ``(H, W, 3)`` are in camera coordinates. It is 0 if no point is in front.
    """
    seen = points.isfinite().all(dim=-1) & (points[..., 2] > 0)
    rows, columns = (indices.double() for indices in seen.nonzero().unbind(dim=1))
    projected = points[seen].double() @ intrinsics.to(points.device, torch.float64).T
    across, down = (projected[:, axis] / projected[:, 2] for axis in (0, 1))
    error = torch.hypot(across - columns, down - rows)
    return float(error.median()) if len(error) else 0.0


def _fit_line(slopes: Tensor, positions: Tensor) -> tuple[float, float] | None:
    """Return the line ``position = focal * slope + center`` through nearly all points, or None."""
    if len(slopes) < 2:
        return None
    mean_slope, mean_position = slopes.mean(), positions.mean()
    spread = ((slopes - mean_slope) ** 2).sum()
    focal = ((slopes - mean_slope) * (positions - mean_position)).sum() / spread
    center = mean_position - focal * mean_slope
    error = (focal * slopes + center - positions).abs() > 0.1
    if not bool(focal.isfinite()) or float(focal) == 0 or float(error.double().mean()) > 0.01:
        return None
    return float(focal), float(center)
