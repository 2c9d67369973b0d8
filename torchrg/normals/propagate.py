"""Signs of normals that agree along a spanning tree of the neighbour graph."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.structures import Neighbors

_NUM_LINKS = 12


class Signs(NamedTuple):
    """Signs that make normals agree within each patch of points.

    Attributes:
        signs: 1 or -1 for each point, shape ``(N,)``.
        patches: The patch that each point belongs to, 0 to M-1, shape ``(N,)``, int64.
    """

    signs: Tensor
    patches: Tensor


def propagate_signs(
    points: Tensor, normals: Tensor, neighbors: Neighbors, *, max_bend: float = 4.0
) -> Signs:
    r"""Find signs by which neighbouring normals agree, along a minimum spanning tree [1].

    Two normals agree if one and the mirror image of the other in the plane halfway between the two
    points form less than a right angle [2]: so they do on a sphere, on both sides of a sharp edge,
    and on the two faces of a thin plate, each pointing away from the other. How far a link can be
    trusted is its bend ``1 - |c| + (u . n_i)^2 + (u . n_j)^2``, with ``c`` the cosine of that angle
    and ``u`` the direction of the link: 0 on a plane, 1 over a right-angled edge, 2 through a
    plate. The tree takes the links of least bend; memory and time are those of a sparse graph.

    Args:
        points: Points, shape ``(N, 3)``, in canonical order if ties are to be independent of it.
        normals: Unit normals, shape ``(N, 3)``.
        neighbors: Neighbours of all points, of which the nearest twelve are used.
        max_bend: Links of a larger bend join no patches.

    Returns:
        Signs and patches. A patch is what the links join; its first point has sign 1.

    References:
        [1] H. Hoppe et al. Surface reconstruction from unorganized points. SIGGRAPH, 1992.
        [2] H. Xie et al. Piecewise C1 continuous surface reconstruction of noisy point clouds via
        local implicit quadric regression. IEEE Visualization, 2003.

    Example:
        >>> points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
        >>> normals = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]])
        >>> near = Neighbors(torch.tensor([[0, 1], [1, 2], [2, 1]]))
        >>> propagate_signs(points, normals, near).signs
        tensor([ 1., -1.,  1.])
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components
    from scipy.sparse.csgraph import minimum_spanning_tree as spanning_tree

    num_points = len(points)
    if num_points == 0:
        return Signs(normals.new_ones(0), torch.zeros(0, dtype=torch.int64, device=points.device))
    starts, ends, bends = _links(points, normals, neighbors)
    kept = bends <= max_bend
    # A weight of zero would be no link, so every link weighs one more than its bend.
    weights, pairs = 1 + bends[kept], (starts[kept], ends[kept])
    tree = spanning_tree(csr_array((weights, pairs), shape=(num_points, num_points)))
    num_patches, patches = connected_components(tree, directed=False)
    _, first = np.unique(patches, return_index=True)
    root = np.full(num_patches, num_points)
    rows, columns = tree.nonzero()
    joined = csr_array(
        (
            np.ones(len(rows) + num_patches),
            (np.concatenate([rows, root]), np.concatenate([columns, first])),
        ),
        shape=(num_points + 1, num_points + 1),
    )
    _, parents = breadth_first_order(joined, num_points, directed=False)
    parents = parents[:num_points].copy()
    parents[first] = first
    signs = _signs_to_root(points, normals, torch.from_numpy(parents).long().to(points.device))
    return Signs(signs, torch.from_numpy(patches).long().to(points.device))


def _links(
    points: Tensor, normals: Tensor, neighbors: Neighbors
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Return both ends and the bend of each link, an end of lower row first."""
    indices = neighbors.indices[:, 1 : 1 + _NUM_LINKS].long()
    own = torch.arange(len(points), device=points.device)[:, None].expand_as(indices)
    linked = indices != own
    if neighbors.valid is not None:
        linked &= neighbors.valid[:, 1 : 1 + _NUM_LINKS]
    pairs = torch.stack([own[linked], indices[linked]])
    low, high = pairs.amin(dim=0), pairs.amax(dim=0)
    keys = torch.unique(low * len(points) + high)
    low, high = keys // len(points), keys % len(points)
    cosine, slope = _agreement(points, normals, low, high)
    bends = 1 - cosine.abs() + slope
    return (
        low.cpu().numpy().astype(np.int32),
        high.cpu().numpy().astype(np.int32),
        bends.clamp(min=0).double().cpu().numpy(),
    )


def _agreement(points: Tensor, normals: Tensor, i: Tensor, j: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cosine between a mirrored normal and the other, and how steep the link is."""
    link = points[j] - points[i]
    sq_length = (link * link).sum(dim=-1)
    sq_length = torch.where(sq_length > 0, sq_length, 1.0)
    a, b = normals[i], normals[j]
    along_a, along_b = (link * a).sum(dim=-1), (link * b).sum(dim=-1)
    cosine = (a * b).sum(dim=-1) - 2 * along_a * along_b / sq_length
    return cosine, (along_a * along_a + along_b * along_b) / sq_length


def _signs_to_root(points: Tensor, normals: Tensor, parents: Tensor) -> Tensor:
    """Multiply signs along the way to each root, doubling the stride of the way each time."""
    cosine, _ = _agreement(
        points, normals, torch.arange(len(points), device=points.device), parents
    )
    signs = torch.where(cosine < 0, -1.0, 1.0).to(normals.dtype)
    signs[parents == torch.arange(len(points), device=points.device)] = 1.0
    while True:
        further = parents[parents]
        signs = signs * signs[parents]
        if torch.equal(further, parents):
            return signs
        parents = further
