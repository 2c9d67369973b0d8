"""Which neighbours may join a region: tests of single edges, each a function of tensors."""

import torch
from torch import Tensor

from torchrg.neighbors import gather_patches
from torchrg.robust import median, qn
from torchrg.structures import Neighbors


def plane_residuals(patches: Tensor, normals: Tensor) -> Tensor:
    """Return the distance of neighbours to the plane through each point, below eq. (10).

    Args:
        patches: Neighbours about the point itself, shape ``(n, K, 3)``.
        normals: Unit normals of the points, shape ``(n, 3)``.

    Returns:
        ``|(p_j - p_i) . n_i|``, shape ``(n, K)``.

    Example:
        >>> patches = torch.tensor([[[0.0, 0, 0], [1, 2, 3]]])
        >>> plane_residuals(patches, torch.tensor([[0.0, 0, 1]])).tolist()
        [[0.0, 3.0]]
    """
    x, y, z = patches.unbind(dim=-1)
    a, b, c = normals[:, :, None].unbind(dim=1)
    result = x * a
    result += y * b
    result += z * c
    return result.abs_()


def coplanarity_limits(residuals: Tensor, floor: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Return the largest residual of a coplanar neighbour, eq. (11).

    :math:`\gamma_{th} = \mathrm{median}(\gamma) + 2 \max(Q_n(\gamma), \mathrm{floor})`. The paper
    has no floor. Without one, the limit of a neighbourhood where most residuals are equal (exact
    or quantised coordinates) is their median, and the wall shatters.

    Args:
        residuals: Distances of the neighbours to the point's plane, shape ``(n, K)``.
        floor: Least scale of the residuals, shape ``(n,)``.
        mask: Which neighbours count, shape ``(n, K)``, bool. Default: all.

    Returns:
        Limits, shape ``(n,)``, in the unit of the residuals.

    Example:
        >>> residuals = torch.tensor([[0.0, 1, 1, 2, 9], [0, 0, 0, 0, 1]])
        >>> coplanarity_limits(residuals, torch.tensor([0.0, 0.25])).tolist()
        [5.44379997253418, 0.5]
    """
    scale = torch.maximum(qn(residuals, mask=mask), floor)
    return median(residuals, mask=mask) + 2 * scale


def neighborhood_radii(points: Tensor, neighbors: Neighbors) -> Tensor:
    """Return the distance of each point to its last neighbour, shape ``(N,)``.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [0, 3, 4]])
        >>> neighborhood_radii(points, Neighbors(torch.tensor([[0, 1], [1, 0]]))).tolist()
        [5.0, 5.0]
    """
    indices, counted = neighbors
    last = torch.full_like(indices[:, :1], indices.shape[1] - 1)
    if counted is not None:
        last = counted.sum(dim=1, keepdim=True, dtype=last.dtype).sub_(1).clamp_(min=0)
    ends = torch.cat([indices[:, :1], indices.gather(1, last.long())], dim=1)
    return patch_radii(gather_patches(points, ends))


def patch_radii(patches: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the distance from each point to its farthest neighbour.

    Args:
        patches: Neighbours about the point itself, shape ``(n, K, 3)``.
        mask: Which neighbours count, shape ``(n, K)``, bool. Default: all.

    Returns:
        Shape ``(n,)``.

    Example:
        >>> patch_radii(torch.tensor([[[0.0, 0, 0], [0, 3, 4]]])).tolist()
        [5.0]
    """
    sq_distances = patch_sq_distances(patches)
    if mask is not None:
        sq_distances = torch.where(mask, sq_distances, 0.0)
    return sq_distances.amax(dim=-1).sqrt()


def patch_sq_distances(patches: Tensor) -> Tensor:
    """Return the squared distance from each point to its neighbours, shape ``(n, K)``.

    Example:
        >>> patch_sq_distances(torch.tensor([[[0.0, 0, 0], [0, 3, 4]]])).tolist()
        [[0.0, 25.0]]
    """
    x, y, z = patches.unbind(dim=-1)
    result = x * x
    result += y * y
    result += z * z
    return result
