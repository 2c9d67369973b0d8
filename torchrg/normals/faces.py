"""Faces of a cloud: planes, the two sides of thin plates, and smooth patches between them.

A double cover tells how normals of a face agree. Each node of a graph is there twice, with its
normal and with the opposite one, and a link joins the copies that agree. A connected component
holds one copy of each of its nodes, and is a face.
"""

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels, scratch
from torchrg._parallel import ROWS_AT_ONCE, ROWS_IN_CACHE, map_chunks, places_of
from torchrg.linalg.moments import dot

_RANKS = (2, 4, 6, 9, 12, 15)
"""Neighbors, by rank, over which faces spread. Noise tilts the links to nearer ones."""

_MIN_BEND, _MAX_BEND, _BENDS = 0.01, 0.05, 4.0
"""Largest bend within a smooth patch: a multiple of the median bend, but at least that between
normals 8 degrees apart, and at most that between normals 18 degrees apart."""

_TRUST_POWER = 4
"""Power of ``1 - bend / 2`` that weighs a link: 1 on a plane, 1/16 over a right-angled edge, 0
through a plate."""

_FEW_POINTS = 10
"""A face of fewer points joins its neighbor. Noise tilts its normals, or an edge bends them."""

_STRONG_AGREEMENT = 0.5
"""Agreement for each of its points above which a face joins its neighbor. The median is 0.5 to 1
for patches that noise cuts from one surface, and 0.05 for faces that meet at an edge of a room."""

_TWO_SIDES = 0.73
"""Squared mean height about the middle by mean squared height, above which a thin face is a plate.
Noise about one side has 0.70, a slab with points all through it 0.75, and a plate 0.8 to 1."""

_FAR_OFF = 2.0
"""Multiple of the mean height at which heights are cut off, so that stray points do not matter."""

_MIN_COSINE = 0.5
"""Cosine between a normal and its plane, 60 degrees, below which the point is on an edge."""


def find_faces(
    points: Tensor,
    normals: Tensor,
    near: Tensor,
    labels: Tensor,
    axes: Tensor,
    max_thickness: float,
) -> tuple[Tensor, Tensor]:
    """Find faces, each of which looks to one side: planes, and smooth patches between them.

    1. A thin plane is a face. A plate, with points at both ends of its heights, is two.
    2. The remaining points form smooth patches. A patch joins the face that it agrees with most if
       it has few points, or if the agreement is large for its size.
    3. Plates among the patches are two faces, too.

    Points ``(N, 3)`` are in canonical order, ``near`` ``(N, K)`` are rows of their neighbors,
    ``labels`` ``(N,)`` those of planes or negative, with unit normals ``axes`` ``(M, 3)``. Thin is
    a face up to a root mean square height. Returns the face of each point, and the sign by which
    its normal agrees with others of the face, ``(N,)`` each. Some numbers of faces have no point.
    """
    faces, signs = torch.full((len(points),), -1), normals.new_ones(len(points))
    rows = places_of(labels >= 0)
    label, axes = labels[rows].long(), axes.to(points)
    cosine = dot(normals[rows], axes[label])
    side, is_thin = _split_plates(points[rows], label, axes, max_thickness)
    is_on_plane = is_thin[label] & (cosine.abs() > _MIN_COSINE)
    rows = rows[is_on_plane]
    faces[rows], signs[rows] = (2 * label + side)[is_on_plane], cosine[is_on_plane].sign()
    joined, signs = _join_patches(points, normals, near, faces, signs, _STRONG_AGREEMENT)
    has_plane = torch.zeros(int(joined.max()) + 1, dtype=torch.bool)
    has_plane[joined[rows]] = True
    rows = places_of(~has_plane[joined])
    numbers, patch = torch.unique(joined[rows], return_inverse=True)
    sums = normals.new_zeros(len(numbers), 3)
    sums.index_add_(0, patch, normals[rows] * signs[rows, None])
    axes = torch.nn.functional.normalize(sums, dim=1)
    side, _ = _split_plates(points[rows], patch, axes, max_thickness)
    joined[rows] += len(has_plane) * side
    return joined, signs


def gather_lists(near: Tensor, rows: Tensor, ranks: list[int]) -> Tensor:
    """Return the neighbors of some points at some ranks; lists on a disk leave the memory again."""
    parts = []
    for chunk in torch.split(rows, ROWS_IN_CACHE):
        parts.append(near[chunk][:, ranks])
        scratch.release()
    return torch.cat(parts) if parts else near[:0, ranks]


def find_surfaces(points: Tensor, normals: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Find connected surfaces, over edges and across thin plates; see :func:`find_faces`.

    Smooth patches join the one that they agree with most until none has a neighbor.
    """
    none = torch.full((len(points),), -1)
    return _join_patches(points, normals, near, none, normals.new_ones(len(points)), 0.0)


def _split_plates(
    points: Tensor, faces: Tensor, axes: Tensor, max_thickness: float
) -> tuple[Tensor, Tensor]:
    """Return the side of each point ``(n,)``, 0 or 1 on a plate, and which faces are thin ``(M,)``.

    Faces ``(n,)`` are rows of their axes ``(M, 3)``.
    """
    counts = torch.bincount(faces, minlength=len(axes)).clamp(min=1)

    def mean(values: Tensor) -> Tensor:
        return torch.bincount(faces, values, minlength=len(axes)) / counts

    height = dot(points, axes[faces]).double()
    middle = height - mean(height)[faces]
    for _ in range(2):
        reach = _FAR_OFF * mean(middle.abs())[faces]
        middle = torch.minimum(torch.maximum(middle, -reach), reach)
        middle -= mean(middle)[faces]
    squares = mean(middle * middle)
    is_thin = squares <= max_thickness * max_thickness
    is_plate = is_thin & (mean(middle.abs()) ** 2 > _TWO_SIDES * squares)
    return ((middle > 0) & is_plate[faces]).long(), is_thin


def _join_patches(
    points: Tensor, normals: Tensor, near: Tensor, faces: Tensor, signs: Tensor, strong: float
) -> tuple[Tensor, Tensor]:
    """Grow smooth patches where there is no face, negative, and join them and the faces.

    Two normals agree if one and the mirror image of the other in the plane halfway between the two
    points form less than a right angle [1]: so they do on a sphere, on both sides of a sharp edge,
    and on the two faces of a thin plate, each pointing away from the other. How far a link can be
    trusted is its bend ``1 - |c| + (u . n_i)^2 + (u . n_j)^2``, with ``c`` the cosine of that angle
    and ``u`` the direction of the link: 0 on a plane, 1 over a right-angled edge, 2 through a
    plate.

    References:
        [1] H. Xie et al. Piecewise C1 continuous surface reconstruction of noisy point clouds via
        local implicit quadric regression. IEEE Visualization, 2003.
    """
    rows, num_faces = places_of(faces < 0), int(faces.max()) + 1
    ranks = [rank for rank in _RANKS if rank < near.shape[1]]
    bend = _compare(points, normals, rows[::8], gather_lists(near, rows[::8], ranks))[1]
    typical = float(bend.median()) if bend.numel() else 0.0
    limit = min(max(_BENDS * typical, _MIN_BEND), _MAX_BEND)
    node = torch.full((len(points),), -1, dtype=torch.int32)
    node[rows] = torch.arange(len(rows), dtype=torch.int32)
    patches = _Components(len(rows))
    for chunk in torch.split(rows, ROWS_AT_ONCE):
        ends = gather_lists(near, chunk, ranks)
        cosine, bend = _compare(points, normals, chunk, ends)
        there = node[ends]
        is_smooth = (bend <= limit) & (there >= 0)
        starts = node[chunk].repeat_interleave(is_smooth.sum(dim=1))
        patches.link(starts, there[is_smooth], cosine[is_smooth] < 0)
    patch, sign = patches.find()
    del node, patches
    faces, signs = faces.clone(), signs.clone()
    faces[rows], signs[rows] = num_faces + patch, sign.to(signs)
    links = []
    for chunk in torch.split(rows, ROWS_AT_ONCE):
        ends = gather_lists(near, chunk, ranks)
        is_between = faces[ends] != faces[chunk, None]
        has_any = is_between.any(dim=1)
        chunk, ends, is_between = chunk[has_any], ends[has_any], is_between[has_any]
        cosine, bend = (values[is_between] for values in _compare(points, normals, chunk, ends))
        starts = chunk.repeat_interleave(is_between.sum(dim=1))
        ends = ends[is_between]
        trust = (1 - bend / 2).clamp(min=0) ** _TRUST_POWER
        agreement = trust * cosine.sign() * signs[starts] * signs[ends]
        links.append((faces[starts], faces[ends], agreement))
    low, high, agreement = (torch.cat(parts) for parts in zip(*links, strict=True))
    sizes = torch.bincount(faces)
    joined, turns = _join_faces(low, high, agreement, sizes, strong)
    return joined[faces], signs * turns[faces].to(signs)


def _compare(points: Tensor, normals: Tensor, rows: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cosine of normals, one of them mirrored, and the bend of links ``(n, K)``."""

    def compare(chunk: slice) -> tuple[Tensor, Tensor]:
        at, shape = rows[chunk], ends[chunk].shape
        cosine, here, there, squares = (points.new_zeros(shape) for _ in range(4))
        for place, normal in zip(points.unbind(dim=1), normals.unbind(dim=1), strict=True):
            arm, other = (
                values.index_select(0, ends[chunk].reshape(-1)).view(shape)
                for values in (place, normal)
            )
            arm -= place[at, None]
            own = normal[at, None]
            cosine += other * own
            here += arm * own
            there += arm * other
            squares += arm * arm
        squares = torch.where(squares > 0, squares, 1.0)
        cosine -= 2 * here * there / squares
        return cosine, 1 - cosine.abs() + (here * here + there * there) / squares

    parts = map_chunks(compare, len(rows), ROWS_IN_CACHE, points.device)
    cosine, bend = (torch.cat(part) for part in zip(*parts, strict=True))
    return cosine, bend


def _join_faces(
    low: Tensor, high: Tensor, agreement: Tensor, sizes: Tensor, strong: float
) -> tuple[Tensor, Tensor]:
    """Let each face join the one that it agrees with most, again and again.

    The agreement of two faces is the sum over the links ``(L,)`` between them; where it is
    negative, one is turned. Faces of many points join where it is ``strong`` for their ``sizes``
    ``(M,)``. Returns the new number of each face, and its sign there, ``(M,)``.
    """
    from scipy.sparse import coo_array

    numbers, signs = torch.arange(len(sizes)), torch.ones(len(sizes))
    while True:
        is_between = low != high
        ends = torch.stack([torch.minimum(low, high), torch.maximum(low, high)])[:, is_between]
        values = agreement[is_between].double().numpy(), tuple(ends.numpy())
        half = coo_array(values, shape=(len(sizes), len(sizes))).tocsr()
        both = (half + half.T).tocsr()
        both.sort_indices()
        strength, owner = np.abs(both.data), np.repeat(np.arange(len(sizes)), np.diff(both.indptr))
        most = torch.where(sizes < _FEW_POINTS, 0.0, strong * sizes).double().numpy()
        np.maximum.at(most, owner, strength)
        # Of equal ones the first, so that no more than two faces choose each other in a circle.
        chosen = np.flatnonzero((strength == most[owner]) & (strength > 0))
        chosen = chosen[np.unique(owner[chosen], return_index=True)[1]]
        components = _Components(len(sizes))
        components.link(
            *(
                torch.from_numpy(values)
                for values in (
                    owner[chosen].astype(np.int32),
                    both.indices[chosen].astype(np.int32),
                    both.data[chosen] < 0,
                )
            )
        )
        joined, turns = components.find()
        if int(joined.max()) + 1 == len(sizes):
            return numbers, signs
        numbers, signs = joined[numbers], signs * turns[numbers]
        sizes = torch.bincount(joined, sizes).long()
        half = half.tocoo()
        low, high = (torch.from_numpy(end).long() for end in half.coords)
        agreement = torch.from_numpy(half.data) * turns[low] * turns[high]
        low, high = joined[low], joined[high]


class _Components:
    """Connected components of a signed graph: the signs of two nodes agree along a link, or differ.

    Components that no signs fit are taken apart: each of their nodes is a component.
    """

    def __init__(self, num_nodes: int) -> None:
        self.parents = torch.arange(num_nodes, dtype=torch.int32)
        self.is_turned = torch.zeros(num_nodes, dtype=torch.bool)
        self.is_torn = torch.zeros(num_nodes, dtype=torch.bool)
        self.links: list[tuple[Tensor, Tensor, Tensor]] = []

    def link(self, starts: Tensor, ends: Tensor, is_turned: Tensor) -> None:
        """Add links between nodes ``(L,)``, int32; signs differ along those that are turned."""
        if kernels.serve():
            forest = self.parents, self.is_turned, self.is_torn
            kernels.call("link_nodes", starts, ends, is_turned, *forest)
        else:
            self.links.append((starts, ends, is_turned))

    def find(self) -> tuple[Tensor, Tensor]:
        """Return the component of each node, by its first node, and its sign there, 1 or -1."""
        if kernels.serve():
            kernels.call("flatten_nodes", self.parents, self.is_turned, self.is_torn)
        elif self.links:
            self._search()
        nodes = torch.arange(len(self.parents))
        # Single nodes come last.
        roots = torch.where(self.is_torn, len(nodes) + nodes, self.parents)
        is_used = torch.zeros(2 * len(nodes), dtype=torch.bool).index_fill_(0, roots, True)
        signs = torch.where(self.is_turned & ~self.is_torn, -1.0, 1.0)
        return is_used.cumsum(0)[roots] - 1, signs

    def _search(self) -> None:
        """Find components on a double cover, whose nodes are each there with both signs."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = len(self.parents)
        starts, ends, is_turned = (
            torch.cat(parts).numpy() for parts in zip(*self.links, strict=True)
        )
        other = count * is_turned.astype(np.int32)
        pairs = np.append(starts, starts + count), np.append(ends + other, ends + count - other)
        cover = coo_array((np.ones(2 * len(starts)), pairs), shape=(2 * count, 2 * count))
        upright, opposite = connected_components(cover, directed=False)[1].reshape(2, count)
        _, first, inverse = np.unique(
            np.minimum(upright, opposite), return_index=True, return_inverse=True
        )
        self.parents = torch.from_numpy(first[inverse].astype(np.int32))
        self.is_turned, self.is_torn = map(
            torch.from_numpy, (upright > opposite, upright == opposite)
        )
