"""One-sided faces of a cloud: planes, sides of thin plates, and smooth patches.

A double cover makes the normals of a face consistent. Each node of a graph occurs twice, with its
normal and with the opposite one, and a link joins the copies that agree. A connected component
contains one copy of each of its nodes and is a face.
"""

import math

import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, map_tasks, nonzero_rows, split_rows
from torchrg.linalg.moments import dot
from torchrg.neighbors.order import connected_components, mark_distinct, sort_integers

_RANKS = (2, 4, 6, 9, 12, 15)
"""Neighbor ranks over which faces spread. Noise tilts the links to nearer ones."""
_MIN_BEND, _MAX_BEND, _BEND_FACTOR = 0.01, 0.05, 4.0
"""Maximum bend within a smooth patch: a multiple of the median bend, clamped to the bends of
normals 8 and 18 degrees apart."""
_TRUST_POWER = 4
"""Power of ``1 - bend / 2`` that weights a link: 1 on a plane, 1/16 over a right-angled edge, 0
through a plate."""
_MIN_FACE_POINTS = 10
"""A face of fewer points joins its neighbor. Noise tilts its normals, or an edge bends them."""
_MIN_AGREEMENT = 0.5
"""Minimum agreement per point at which a face joins its neighbor. The median is 0.5 to 1 for
patches of one surface split by noise, and 0.05 for faces that meet at an edge of a room."""
_MIN_TWO_SIDED = 0.73
"""Minimum ratio of squared mean height to mean squared height, about the middle, of a plate among
thin faces. One side with noise has 0.70, a filled slab 0.75, and a plate 0.8 to 1."""
_MAX_HEIGHT_FACTOR = 2.0
"""Multiple of the mean height at which heights are clamped, to limit stray points."""
_MIN_COSINE = 0.5
"""Minimum cosine between a normal and its plane, 60 degrees; other points are on an edge."""


def find_faces(
    points: Tensor,
    normals: Tensor,
    near: Tensor,
    labels: Tensor,
    axes: Tensor,
    max_thickness: float,
) -> tuple[Tensor, Tensor]:
    """Find one-sided faces: planes, and smooth patches between them.

    1. A thin plane is a face. A plate, with points at both ends of its heights, is two faces.
    2. The remaining points form smooth patches. A patch joins the face with the highest agreement
       if it has few points, or if the agreement is large for its size.
    3. Plates among the patches are also two faces.

    Points ``(N, 3)`` are in canonical order, ``near`` ``(N, K)`` are rows of their neighbors,
    ``labels`` ``(N,)`` are plane IDs or negative, with unit normals ``axes`` ``(M, 3)``.
    ``max_thickness`` is the maximum RMS height of a thin face. Returns the face of each point,
    int32, and the sign that makes its normal consistent within the face, ``(N,)`` each. Some face
    IDs are unused.
    """
    faces = torch.full((len(points),), -1, dtype=torch.int32)
    signs, rows = normals.new_ones(len(points)), scratch.store(nonzero_rows(labels >= 0))
    label, axes = scratch.store(labels.index_select(0, rows).long()), axes.to(points)
    side, is_thin = _split_plates(points, rows, label, axes, max_thickness)
    for part in split_rows(len(rows), ROWS_AT_ONCE):
        near_plane, plane = rows[part], label[part]
        cosine = dot(normals.index_select(0, near_plane), axes.index_select(0, plane))
        kept = nonzero_rows(is_thin.index_select(0, plane) & (cosine.abs() > _MIN_COSINE))
        chosen, face = near_plane.index_select(0, kept), 2 * plane + side[part]
        faces.index_copy_(0, chosen, face.index_select(0, kept).int())
        signs.index_copy_(0, chosen, cosine.index_select(0, kept).sign())
    del label, side, rows
    rows = nonzero_rows(faces >= 0)
    joined, signs = _join_patches(points, normals, near, faces, signs, _MIN_AGREEMENT)
    has_plane = torch.zeros(int(joined.max()) + 1, dtype=torch.bool)
    has_plane[joined.index_select(0, rows)] = True
    rows = nonzero_rows(~has_plane.index_select(0, joined))
    indices, patch = torch.unique(joined.index_select(0, rows), return_inverse=True)
    sums = normals.new_zeros(len(indices), 3)
    for part in split_rows(len(rows), ROWS_AT_ONCE):
        sums.index_add_(0, patch[part], normals[rows[part]] * signs[rows[part], None])
    axes = torch.nn.functional.normalize(sums, dim=1)
    side, _ = _split_plates(points, rows, patch, axes, max_thickness)
    joined[rows] += len(has_plane) * side
    return joined, signs


def gather_lists(near: Tensor, rows: Tensor, ranks: list[int]) -> Tensor:
    """Return the neighbors of points at the given ranks; releases memory-mapped lists."""
    parts, columns = [], torch.tensor(ranks, dtype=torch.int64)
    for chunk in torch.split(rows, ROWS_IN_CACHE):
        parts.append(near.index_select(0, chunk).index_select(1, columns))
        scratch.release()
    return torch.cat(parts) if parts else near[:0, ranks]


def find_surfaces(points: Tensor, normals: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Find connected surfaces, over edges and across thin plates; see :func:`find_faces`.

    Smooth patches join the patch with the highest agreement until none has a neighbor.
    """
    none = torch.full((len(points),), -1, dtype=torch.int32)
    return _join_patches(points, normals, near, none, normals.new_ones(len(points)), 0.0)


def _split_plates(
    points: Tensor, rows: Tensor, faces: Tensor, axes: Tensor, max_thickness: float
) -> tuple[Tensor, Tensor]:
    """Return which points ``(n,)`` are on the upper side of a plate, and which faces ``(M,)`` thin.

    The points ``rows`` ``(n,)`` are on ``faces`` ``(n,)``, rows of the ``axes`` ``(M, 3)``.
    """
    if kernels.serve(points, axes):
        limits = max_thickness * max_thickness, _MAX_HEIGHT_FACTOR, _MIN_TWO_SIDED
        side, is_thin, *_ = kernels.call("split_plates", points, rows, faces, axes, *limits)
        return side, is_thin
    counts = torch.bincount(faces, minlength=len(axes)).clamp(min=1)

    def mean(values: Tensor) -> Tensor:
        return torch.bincount(faces, values, minlength=len(axes)) / counts

    middle = dot(points[rows], axes[faces]).double()
    middle -= mean(middle)[faces]
    for _ in range(2):
        reach = (_MAX_HEIGHT_FACTOR * mean(middle.abs()))[faces]
        middle.clamp_(max=reach).clamp_(min=reach.neg_())
        middle -= mean(middle)[faces]
    squares = mean(middle * middle)
    is_thin = squares <= max_thickness * max_thickness
    is_plate = is_thin & (mean(middle.abs()) ** 2 > _MIN_TWO_SIDED * squares)
    return (middle > 0) & is_plate[faces], is_thin


def _join_patches(
    points: Tensor, normals: Tensor, near: Tensor, faces: Tensor, signs: Tensor, strong: float
) -> tuple[Tensor, Tensor]:
    """Grow smooth patches of points without a face (negative), and join patches and faces.

    Writes to ``faces``, int32, and ``signs``, ``(N,)`` each.

    Two normals agree if one and the mirror image of the other form less than a right angle,
    mirrored in the bisecting plane of the two points [1]. This holds on a sphere, on both sides of
    a sharp edge, and for the opposite normals of a thin plate. The bend of a link measures how
    reliable it is: ``1 - |c| + (u . n_i)^2 + (u . n_j)^2``, with ``c`` the cosine of that angle and
    ``u`` the direction of the link. It is 0 on a plane, 1 over a right-angled edge, and 2 through a
    plate.

    References:
        [1] H. Xie et al. Piecewise C1 continuous surface reconstruction of noisy point clouds via
        local implicit quadric regression. IEEE Visualization, 2003.
    """
    rows, num_faces = nonzero_rows(faces < 0), int(faces.max()) + 1
    ranks = [rank for rank in _RANKS if rank < near.shape[1]]
    patch, sign = _grow_patches(points, normals, near, rows, ranks)
    faces[rows], signs[rows] = patch.add_(num_faces), sign.to(signs)
    del patch, sign

    def compare(chunk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        starts, ends, cosine, bend = _find_links(points, normals, near, chunk, ranks, faces)
        trust = (1 - bend / 2).clamp(min=0) ** _TRUST_POWER
        here, there = (signs.index_select(0, rows) for rows in (starts, ends))
        agreement = trust * cosine.sign() * here * there
        return faces.index_select(0, starts), faces.index_select(0, ends), agreement

    links = map_tasks(compare, torch.split(rows, ROWS_AT_ONCE), rows.device)
    low, high, agreement = (torch.cat(parts) for parts in zip(*links, strict=True))
    del links, rows
    sizes = torch.bincount(faces)
    joined, flips = _join_faces(low, high, agreement, sizes, strong)
    return joined.index_select(0, faces), signs * flips.index_select(0, faces).to(signs)


def _grow_patches(
    points: Tensor, normals: Tensor, near: Tensor, rows: Tensor, ranks: list[int]
) -> tuple[Tensor, Tensor]:
    """Return the smooth patch of each of the points ``rows`` ``(n,)``, and its sign in it."""
    bend = _find_links(points, normals, near, rows[::8], ranks)[3]
    typical = float(bend.median()) if bend.numel() else 0.0
    limit = min(max(_BEND_FACTOR * typical, _MIN_BEND), _MAX_BEND)
    node = torch.full((len(points),), -1, dtype=torch.int32)
    node[rows] = torch.arange(len(rows), dtype=torch.int32)

    def link(chunk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        starts, ends, cosine, _ = _find_links(points, normals, near, chunk, ranks, node, limit)
        return node.index_select(0, starts), node.index_select(0, ends), cosine < 0

    links = map_tasks(link, torch.split(rows, ROWS_AT_ONCE), rows.device)
    return connected_components(len(rows), *map(torch.cat, zip(*links, strict=True)))


def _find_links(
    points: Tensor,
    normals: Tensor,
    near: Tensor,
    rows: Tensor,
    ranks: list[int],
    groups: Tensor | None = None,
    max_bend: float = math.inf,
) -> tuple[Tensor, ...]:
    """Return links from rows ``(n,)`` to their neighbors at some ranks: ends, cosine and bend.

    The cosine is that of the normals, one of them mirrored. With ``groups`` ``(N,)``, int32, only
    links to another group, not negative, are returned; bends are at most ``max_bend``.
    """
    if kernels.serve(points, normals, near, groups) and near.is_contiguous():
        columns = torch.tensor(ranks, dtype=torch.int64)
        lists = points, normals, near, rows, columns, groups
        *found, count = kernels.call("find_links", *lists, max_bend)
        scratch.release()
        return tuple(values.view(-1)[: int(count)].clone() for values in found)
    starts, ends = rows.repeat_interleave(len(ranks)), gather_lists(near, rows, ranks).view(-1)
    arms, normal, other = points[ends] - points[starts], normals[starts], normals[ends]
    here, there, squares = dot(arms, normal), dot(arms, other), dot(arms, arms)
    squares = torch.where(squares > 0, squares, 1.0)
    cosine = dot(other, normal) - 2 * here * there / squares
    bend = 1 - cosine.abs() + (here * here + there * there) / squares
    chosen = bend <= max_bend
    if groups is not None:
        chosen &= (groups[ends] >= 0) & (groups[ends] != groups[starts])
    chosen = nonzero_rows(chosen)
    return starts[chosen].int(), ends[chosen].int(), cosine[chosen], bend[chosen]


def _join_faces(
    low: Tensor, high: Tensor, agreement: Tensor, sizes: Tensor, strong: float
) -> tuple[Tensor, Tensor]:
    """Repeatedly join each face to the face it agrees with most.

    The agreement of two faces is the sum over the links ``(L,)`` between them; if it is negative,
    one is flipped. Faces of many points join if it is ``strong`` for their ``sizes`` ``(M,)``.
    Returns the new index of each face, int32, and its sign, ``(M,)``.
    """
    count = len(sizes)
    indices, signs = torch.arange(count, dtype=torch.int32), torch.ones(count)
    while True:
        keys = torch.minimum(low, high).long() * count + torch.maximum(low, high)
        order, pairs = sort_integers(keys)
        starts = mark_distinct(pairs)
        values = agreement.index_select(0, order).double()
        totals = torch.bincount(starts.cumsum(0) - 1, values).double()
        pairs = pairs.index_select(0, nonzero_rows(starts))
        low, high = pairs // count, pairs % count
        agreement = torch.where(low == high, 0.0, totals)
        owner, other = torch.cat([low, high]), torch.cat([high, low])
        strength = agreement.abs().repeat(2)
        limit = torch.where(sizes < _MIN_FACE_POINTS, 0.0, strong * sizes).double()
        limit.scatter_reduce_(0, owner, strength, "amax")
        chosen = nonzero_rows((strength == limit[owner]) & (strength > 0))
        # Ties go to the first, so that only two faces can choose each other in a cycle.
        choices = 2 * other + (agreement < 0).repeat(2)
        best = torch.full((count,), 2 * count)
        best.scatter_reduce_(0, owner[chosen], choices[chosen], "amin")
        rows = nonzero_rows(best < 2 * count)
        if len(rows) == 0:
            return indices, signs
        best = best[rows]
        joined, flips = connected_components(count, rows, best // 2, best % 2 == 1)
        count = int(joined.max()) + 1
        if count == len(sizes):
            return indices, signs
        indices, signs = joined[indices], signs * flips[indices]
        sizes = torch.bincount(joined, sizes).long()
        agreement = agreement * flips[low] * flips[high]
        low, high = joined[low], joined[high]
