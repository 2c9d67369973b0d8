"""Plane segmentation of a single depth image."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any, cast

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_choices, check_shapes, eager_only
from torchrg._parallel import nonzero_rows
from torchrg.config import DepthConfig, SelectionConfig, settings_of
from torchrg.depth.camera import check_view, read_intrinsics
from torchrg.depth.growth import grow_pixels
from torchrg.depth.normals import fit_pixels
from torchrg.depth.pixels import InverseCloud, describe_pixels
from torchrg.depth.values import DepthKind, convert_depth, drop_channel
from torchrg.depth.windows import Image
from torchrg.linalg.angles import unit_direction
from torchrg.linalg.moments import Segments, kth_smallest
from torchrg.linalg.rigid import check_rigid
from torchrg.normals import Orientation, orient_normals
from torchrg.regions.classes import classify_planes
from torchrg.regions.fit import fit_planes
from torchrg.regions.selection import keep_planes, selected_rows
from torchrg.regions.table import measure_planes
from torchrg.structures import Planes, Segmentation
from torchrg.structures.planes import Deferred


@eager_only
@torch.no_grad()
def segment_depth(
    depth: Tensor,
    intrinsics: Tensor,
    config: DepthConfig | Mapping[str, Any] | None = None,
    *,
    pose: Tensor | None = None,
    orient: Orientation = "auto",
    depth_scale: float = 1.0,
    depth_kind: DepthKind = "z",
    **changes: Any,  # noqa: ANN401
) -> Segmentation:
    """Segment a depth image into planes.

    All decisions use inverse depth. In it planes stay planes, and the noise of a triangulating
    sensor does not depend on depth; see :func:`torchrg.depth.normals.fit_pixels` and
    :func:`torchrg.depth.growth.grow_pixels`.

    Convention:
        Pixels without depth (0, negative, not finite, above ``max_depth``, the largest value of 16
        bits or of an integer type) are unlabeled, and no neighborhood crosses a depth step.

    Args:
        depth: Depth image, shape ``(H, W)`` or ``(1, H, W)``, float32, float64 or integers.
        intrinsics: Camera matrix, shape ``(3, 3)``, 4 x 4 or a kornia ``PinholeCamera``; see
            :func:`torchrg.depth.camera.depth_to_points`.
        config: A depth configuration, or a dictionary. Default: :class:`DepthConfig`.
        pose: Camera-to-world matrix, shape ``(4, 4)``. Default: results in camera coordinates.
        orient: Normal orientation: towards the camera for "auto", "viewpoint" and "none", otherwise
            as in :func:`torchrg.normals.orient_normals`. Default: "auto".
        depth_scale: Depth units per meter, 1000 for millimeters. Default: 1, meters.
        depth_kind: "ray" for distances from the camera center. Default: "z".
        **changes: Individual parameters, as in ``max_depth=4.0``.

    Returns:
        A segmentation whose fields are images of ``(H, W)`` or ``(H, W, 3)``. Pixels near an edge,
        without a flat window centered on them, are sharp.

    Raises:
        ShapeError: If a shape or dtype is not as above, or ``pose`` is no rigid motion.
        ConfigError: If ``intrinsics`` are impossible for such images, or a parameter is invalid.

    Warns:
        DepthWarning: If ``intrinsics`` are improbable, see :func:`torchrg.depth.camera.check_view`,
            or the depth is, see :func:`torchrg.depth.values.convert_depth`.

    Example:
        >>> intrinsics = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
        >>> depth = torch.full((30, 40), 2.0)
        >>> depth[:, 20:] = 3.0
        >>> seg = segment_depth(depth, intrinsics)
        >>> seg.labels[0, ::13].tolist(), seg.planes.offset.tolist()
        ([0, 0, 1, 1], [2.0, 3.0])
    """
    depth = drop_channel(as_tensor("segment_depth", "depth", depth))
    pose = None if pose is None else as_tensor("segment_depth", "pose", pose).to(depth.device)
    intrinsics = read_intrinsics("segment_depth", intrinsics, depth)
    intrinsics = intrinsics[0] if intrinsics.shape[:-2] == (1,) else intrinsics
    check_shapes(
        "segment_depth", depth=(depth, "H W"), intrinsics=(intrinsics, "3 3"), pose=(pose, "4 4")
    )
    check_rigid("segment_depth", "pose", pose)
    check_view("segment_depth", intrinsics, (depth.shape[1], depth.shape[0]))
    check_choices("segment_depth", orient=(orient, Orientation))
    settings = settings_of("segment_depth", DepthConfig, config, changes)
    depth = convert_depth("segment_depth", depth, intrinsics, depth_scale, depth_kind)
    seg = _segment(depth, intrinsics, settings, pose, orient)
    # Labels have the default order.
    is_default = all(getattr(settings, f.name) == f.default for f in fields(SelectionConfig))
    return seg if is_default else keep_planes(seg, selected_rows(seg.planes, settings))


def _segment(
    depth: Tensor, intrinsics: Tensor, config: DepthConfig, pose: Tensor | None, orient: Orientation
) -> Segmentation:
    """Implement :func:`segment_depth`."""
    if config.max_depth is not None:
        depth = torch.where(depth <= config.max_depth, depth, 0.0)
    seen = depth > 0
    inverse = depth.double().reciprocal().nan_to_num_(posinf=0.0)
    fx, fy, cx, cy = (float(intrinsics[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u = torch.arange(depth.shape[1], device=depth.device).double() - cx
    v = torch.arange(depth.shape[0], device=depth.device).double() - cy
    image, x, y = Image(inverse, seen, u, v), u / fx, v / fy
    planes = fit_pixels(image, focal=(fx, fy), noise=config.noise, dtype=depth.dtype)
    pixels = describe_pixels(image, planes, (fx, fy), config)
    joins, flat, edge = (pixels.right, pixels.down), planes.flat, planes.edge
    del planes
    num_seen = int(seen.count_nonzero())
    # Pixels without depth have inverse depth 0, which is less than that of others.
    middle = seen.numel() - num_seen + (num_seen - 1) // 2
    unit = kth_smallest(inverse.flatten(), middle) if num_seen else 1.0
    cloud = InverseCloud(inverse / unit, x, y, pixels.noise / unit, seen)
    labels, plane_normals, curved = grow_pixels(cloud, flat, joins, config)
    normals, valid = pixels.normals.view(-1, 3), pixels.valid
    # A boundary pixel without a flat window has no normal; use the region's.
    boundary = nonzero_rows((labels >= 0) & ~flat.flatten())
    boundary = boundary[~curved[labels[boundary]]]
    normals[boundary] = plane_normals[labels[boundary]]
    valid.view(-1)[boundary] = True
    if pose is not None:
        pose = pose.to(normals)
        normals, plane_normals = normals @ pose[:3, :3].T, plane_normals @ pose[:3, :3].T
    # The table is measured later, even if labels change by then.
    numbers = labels.clone()

    def locate() -> Tensor:
        z = torch.where(seen, depth.double(), 1.0)
        points = torch.stack([(x * z).flatten(), (y[:, None] * z).flatten(), z.flatten()])
        return points.T if pose is None else (pose[:3, :3] @ points + pose[:3, 3:]).T

    @torch.no_grad()
    def measure(_: object) -> Planes:
        segments, points = Segments(numbers), locate()
        fit = fit_planes(segments, points, plane_normals, shared=True)
        table = measure_planes(segments, points, fit._replace(curved=curved))
        if config.up is None:
            return table
        up = unit_direction("segment_depth", config.up)
        return replace(table, kind=classify_planes(table, points, numbers, up))

    if orient not in ("auto", "viewpoint", "none"):
        positions = torch.where(seen.view(-1, 1), locate(), torch.nan).float()
        normals = orient_normals(positions, normals, orient=orient)
    return Segmentation(
        labels.view(depth.shape),
        normals.view(*depth.shape, 3).to(depth.dtype),
        pixels.curvature.to(depth.dtype),
        edge,
        valid,
        cast(Planes, Deferred(measure)),
    )
