"""From one depth image to planes."""

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes, of_clouds
from torchrg._parallel import map_rows, sequential_operations
from torchrg.config import DepthConfig
from torchrg.depth.camera import has_depth, points_of_image, read_intrinsics
from torchrg.depth.growth import InverseCloud, grow_pixels
from torchrg.depth.normals import PixelPlanes, fit_pixels
from torchrg.regions import summarize_planes
from torchrg.structures import Segmentation


@of_clouds
@torch.no_grad()
@sequential_operations()
def segment_depth(
    depth: Tensor,
    intrinsics: Tensor,
    config: DepthConfig | None = None,
    *,
    pose: Tensor | None = None,
) -> Segmentation:
    """Segment a depth image into planes.

    All is decided in inverse depth, where planes stay planes and the noise of a sensor that
    triangulates does not depend on depth; see :func:`torchrg.depth.normals.fit_pixels`
    and :func:`torchrg.depth.growth.grow_pixels`.

    Convention:
        Pixels without depth (0, negative, not finite, beyond ``max_depth``) belong to nothing, and
        no neighbourhood crosses a step of the depth. The unit of the depth does not matter. Normals
        point towards the camera.

    Args:
        depth: Depth along the optical axis, shape ``(H, W)``, float32 or float64.
        intrinsics: Camera matrix, shape ``(3, 3)``, 4 x 4 or a kornia ``PinholeCamera``; see
            :func:`torchrg.depth.camera.depth_to_points`.
        config: Settings. Default: :class:`DepthConfig`.
        pose: Matrix from camera to world coordinates, shape ``(4, 4)``, for normals and planes in
            the world. Default: they are in camera coordinates.

    Returns:
        A segmentation whose fields are images, of ``(H, W)`` or ``(H, W, 3)``. Sharp are the pixels
        so near to an edge that no flat window lies around them.

    Raises:
        ShapeError: If a shape or dtype is not as above.
        ConfigError: If ``intrinsics`` is no matrix of a camera.

    Example:
        >>> intrinsics = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
        >>> depth = torch.full((30, 40), 2.0)
        >>> depth[:, 20:] = 3.0
        >>> seg = segment_depth(depth, intrinsics)
        >>> seg.labels[0, ::13].tolist(), seg.planes.offset.tolist()
        ([0, 0, 1, 1], [2.0, 3.0])
    """
    depth = as_tensor("segment_depth", "depth", depth)
    intrinsics = read_intrinsics("segment_depth", intrinsics)
    intrinsics = intrinsics[0] if intrinsics.shape[:-2] == (1,) else intrinsics
    check_shapes(
        "segment_depth",
        depth=(depth, "H W"),
        intrinsics=(intrinsics, "3 3"),
        pose=(pose, "4 4"),
    )
    check_floating("segment_depth", depth=depth)
    return _segment(depth, intrinsics, config or DepthConfig(), pose)


def _segment(
    depth: Tensor, intrinsics: Tensor, config: DepthConfig, pose: Tensor | None
) -> Segmentation:
    """Do what :func:`segment_depth` says."""
    if config.max_depth is not None:
        depth = torch.where(depth <= config.max_depth, depth, 0.0)
    seen = has_depth(depth)
    inverse = torch.where(seen, 1 / depth.double(), 0.0)
    fx, fy, cx, cy = (float(intrinsics[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    focal = (fx, fy)
    u = torch.arange(depth.shape[1], device=depth.device).double() - cx
    v = torch.arange(depth.shape[0], device=depth.device).double()[:, None] - cy
    x, y = (rays.expand_as(inverse).contiguous() for rays in (u / fx, v / fy))
    pixels = fit_pixels(inverse, seen, u, v, focal=focal, noise=config.noise, dtype=depth.dtype)
    normals, curvature = _normals_and_curvature(pixels, inverse, x, y, focal)
    valid = pixels.valid
    cloud = _inverse_cloud(inverse, seen, pixels, x, y)
    labels, plane_normals, curved = grow_pixels(cloud, pixels, normals, u, v, config)
    normals = torch.where(valid[..., None], normals, 0.0).view(-1, 3)
    # A window at a border that is not flat has no normal of its own; the region has.
    borders = (~pixels.flat.flatten() & (labels >= 0)).nonzero().squeeze(1)
    borders = borders[~curved[labels[borders]]]
    normals[borders] = plane_normals[labels[borders]]
    valid.view(-1)[borders] = True

    if pose is not None:
        pose = pose.to(normals)
        normals = normals @ pose[:3, :3].T
    points = points_of_image(depth, intrinsics, pose)
    rows = seen.flatten().nonzero().squeeze(1)
    table = summarize_planes(points.view(-1, 3)[rows], normals[rows], labels[rows])
    return Segmentation(
        labels.view(depth.shape),
        normals.view(*depth.shape, 3).to(depth.dtype),
        curvature.to(depth.dtype),
        pixels.edge,
        valid,
        table._replace(curved=curved),
    )


def _inverse_cloud(
    inverse: Tensor, seen: Tensor, pixels: PixelPlanes, x: Tensor, y: Tensor
) -> InverseCloud:
    """Return the image as the cloud that regions grow in, from the rays ``(x, y, 1)``."""
    unit = inverse[seen].median() if bool(seen.any()) else inverse.new_ones(())
    columns = torch.stack([x.flatten(), y.flatten(), inverse.flatten() / unit])
    return InverseCloud(columns.T, (pixels.noise / unit).flatten(), seen)


def _normals_and_curvature(
    pixels: PixelPlanes, inverse: Tensor, x: Tensor, y: Tensor, focal: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return unit normals towards the camera ``(H, W, 3)``, and curvature ``(H, W)``."""
    planes = pixels.planes
    columns = [planes.u_slope, planes.v_slope, planes.origin, planes.deviation, *pixels.sides]
    columns += [pixels.valid, inverse, x, y]
    columns = [part.flatten() for part in columns]
    *normals, curvature = map_rows(_shape_of_planes, columns, inverse.new_tensor(focal))
    shape = inverse.shape
    return torch.stack(normals, dim=1).view(*shape, 3), curvature.view(shape)


def _shape_of_planes(
    u_slope: Tensor,
    v_slope: Tensor,
    origin: Tensor,
    deviation: Tensor,
    rows: Tensor,
    columns: Tensor,
    valid: Tensor,
    inverse: Tensor,
    x: Tensor,
    y: Tensor,
    focal: Tensor,
) -> tuple[Tensor, ...]:
    """Return the columns of the normals of windows, and their surface variation.

    That is their variance across the plane, of all. A deviation e of inverse depth is one of
    ``distance * z * e`` from the plane; a step of a column is one of
    ``(x_step - x_slope * z * ray) z`` along it.
    """
    fx, fy = focal.unbind()
    away = u_slope * fx, v_slope * fy, origin
    length = (away[0].square() + away[1].square() + away[2].square()).sqrt()
    length = torch.where(length > 0, length, 1.0)
    z = 1 / torch.where(inverse > 0, inverse, 1.0)
    across = (z * torch.where(valid, deviation, 0.0) / length).square()
    ray = x * x + y * y + 1
    along = torch.zeros_like(z)
    for side, slope, f, place in ((columns, u_slope, fx, x), (rows, v_slope, fy, y)):
        step, spread = slope * z, (side * side - 1) / 12
        along = along + spread * (step * step * ray - 2 / f * step * place + 1 / (f * f))
    total = across + along * z * z
    variation = (across / torch.where(total > 0, total, 1.0)).clamp(max=1 / 3)
    curvature = torch.where(valid, variation, 0.0)
    return *(-part / length for part in away), curvature
