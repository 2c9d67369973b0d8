"""Principal curvatures of height fields."""

import torch
from torch import Tensor

from torchrg.normals.frame import root


def shape_operator(
    slope_u: Tensor, slope_v: Tensor, uu: Tensor, uv: Tensor, vv: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the normal of a height field and how it turns along two tangents.

    Args:
        slope_u: First derivative along u, shape ``(*)``.
        slope_v: First derivative along v.
        uu: Second derivative along u.
        uv: Mixed derivative.
        vv: Second derivative along v.

    Returns:
        Unit normal with positive height, shape ``(*, 3)``; entries aa, ab, bb of the shape operator
        in an orthonormal basis of tangents a and b, shape ``(*, 3)``; that basis, ``(*, 2, 3)``.

    Example:
        >>> zero, one = torch.zeros(()), torch.ones(())
        >>> shape_operator(zero, zero, 2 * one, zero, one)[1]
        tensor([2., 0., 1.])
    """
    one = torch.ones_like(slope_u)
    gradient = (slope_u * slope_u + slope_v * slope_v + 1).sqrt()
    normal = torch.stack([-slope_u, -slope_v, one], dim=-1) / gradient[..., None]
    length = (slope_u * slope_u + 1).sqrt()
    first = torch.stack([one, torch.zeros_like(one), slope_u], dim=-1) / length[..., None]
    second = torch.linalg.cross(normal, first)
    au, bu, bv = first[..., 0], second[..., 0], second[..., 1]
    aa = au * au * uu
    ab = au * (bu * uu + bv * uv)
    bb = bu * bu * uu + 2 * bu * bv * uv + bv * bv * vv
    shape = torch.stack([aa, ab, bb], dim=-1) / gradient[..., None]
    return normal, shape, torch.stack([first, second], dim=-2)


def principal_curvatures(shape: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Return the eigenvalues of shape operators, larger first, and their directions.

    Args:
        shape: Entries aa, ab, bb, shape ``(*, 3)``.
        tangents: The tangents a and b, shape ``(*, 2, 3)``.

    Returns:
        Curvatures, shape ``(*, 2)``, and unit directions, shape ``(*, 2, 3)``, without gradient.

    Example:
        >>> principal_curvatures(torch.tensor([1.0, 1.0, 1.0]), torch.eye(3)[:2])[0]
        tensor([2., 0.])
    """
    aa, ab, bb = shape.unbind(dim=-1)
    middle, half = (aa + bb) / 2, (aa - bb) / 2
    radius = root(half * half + ab * ab)
    values = torch.stack([middle + radius, middle - radius], dim=-1)
    with torch.no_grad():
        # Of the two rows of (S - k1), the longer one is orthogonal to the first direction.
        along = torch.where(half >= 0, half + radius, ab)
        across = torch.where(half >= 0, ab, radius - half)
        size = root(along * along + across * across)
        round_ = size == 0
        along = torch.where(round_, 1.0, along / torch.where(round_, 1.0, size))
        across = torch.where(round_, 0.0, across / torch.where(round_, 1.0, size))
        first = torch.stack([along, across], dim=-1)
        second = torch.stack([-across, along], dim=-1)
        directions = torch.stack([first, second], dim=-2) @ tangents
    return values, directions
