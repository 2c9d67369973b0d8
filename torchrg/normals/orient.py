"""Signs of normals: towards a place or direction, consistent, or into rooms."""

import math
from itertools import product
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes, of_clouds
from torchrg._parallel import CHUNK_SIZE, map_chunks, places_of, sequential_operations
from torchrg.errors import ConfigError
from torchrg.neighbors import check_neighbors, distinct_points, gather_patches, search_knn
from torchrg.structures import Neighbors

Orientation = Literal["viewpoint", "+x", "-x", "+y", "-y", "+z", "-z", "consistent", "interior"]
"""Names of the directions and sides that normals can be turned towards."""

NUM_NEIGHBORS = 20
"""Neighbours that are searched where none are given."""

_NUM_LINKS = 12
"""Nearest neighbours over which signs spread: as many as reach between the faces of a thin
plate."""

_NUM_FOLLOWED = 6
"""Nearest points with a sign that are asked by one without."""

_MOST_SPREADING = 2**19
"""Points over which signs spread. Of larger clouds so many stand for all, which takes a kilobyte
each, and the others follow those near to them."""

_SPREADING_SHARE = 1 / 16
"""Share of the points that stand for all of clouds so large that it is more: whole buildings."""

_PATCH_BEND = 0.05
"""Largest bend within a smooth patch, that between normals 18 degrees apart."""

_LARGEST_BEND = 2.0
"""Bend through a plate; links of more tell nothing."""

_FACE_BEND = 0.01
_USUAL_BENDS = 4.0
"""Largest bend within a face: that between normals 8 degrees apart, or this multiple of the median
of all, which noise makes larger where points are dense. The two sides of a sparse thin plate are
one patch, and two faces."""

_LEAST_FACE = 10
"""Points of a face that decides for itself. Smaller ones, as along edges, follow their patch, and
smaller patches, as where noise is large, follow those around them."""

_CLEARLY_OUTWARDS = 1e-3
"""Share of its largest value beyond which a volume or a mean normal cannot be rounding."""

_SPACINGS_PER_CELL = 1.5
_SPACING_QUANTILE = 0.9
"""Quantile of the spacing of the points that gives the side of a cell, so that sparse walls are
closed."""

_CELLS_PER_POINT = 16
"""A grid with more cells a point than this, and more than a thousand, is made coarser."""

_STEEP = 0.87
"""Cosine, of 30 degrees, above which a neighbour lies straight ahead."""

_PARALLEL, _ABOVE = 0.99, 0.5
"""Cosine, of 8 degrees, between normals that are parallel, and sine, of 30 degrees, of the angle at
which a neighbour with such a normal lies on another face. On one smooth surface it rises by no more
than half of the angle between the normals."""

_OPEN_WEIGHT = 0.5
"""Weight of a free path that leaves the box around the cloud."""

_HALF_WORTH = 8
"""Free cells at which a path gets half of the largest weight. A gap so weighs less than a room, and
a hall no more than a room."""

_OPEN = 1 << 24
"""Added to the length of paths that leave the box: more cells than any grid has in a row."""


@of_clouds
@sequential_operations()
def orient_normals(
    points: Tensor | NDArray[np.floating],
    normals: Tensor | NDArray[np.floating],
    *,
    towards: Orientation = "interior",
    viewpoint: Tensor | NDArray[np.floating] | None = None,
    neighbors: Neighbors | None = None,
) -> Tensor:
    """Choose the sign of each normal.

    - ``"viewpoint"``: towards where the scanner stood.
    - ``"+x"`` ... ``"-z"``: along an axis.
    - ``"consistent"``: neighbours agree, over edges and across thin plates too, by propagation
      along a spanning tree; outwards for a closed surface. Each component of the neighbour graph
      is oriented on its own.
    - ``"interior"``: into the free space of rooms: floors up, ceilings down, walls into their own
      room, furniture away from its inside. Each point votes by the free paths in front of it and
      behind, and faces decide by majority; a few points whose normals agree with no others follow
      the face that they are on. Several rooms, storeys and missing ceilings are
      no obstacle; a wall between two rooms is right if it is thicker than about two point spacings,
      a plate seen from both sides if normals of its faces can be told apart. A lone object seen
      from outside is turned inwards, as a room would be: use ``"consistent"`` for it.

    Convention:
        The result does not depend on the signs that came in, nor on the order of the points. Copies
        of a point count once, and look to one side. A normal for which neither sign is right (at
        right angles to the axis, say) gets the one that makes the first of z, y, x that is not zero
        positive.

    Args:
        points: Points, shape ``(N, 3)``.
        normals: Unit normals, shape ``(N, 3)``; zero where there is none.
        towards: See above.
        viewpoint: Where the scanner stood, shape ``(3,)``, or ``(N, 3)`` for several scans.
        neighbors: Neighbours of all points, all of them finite, for the last two. Default: 20 each,
            searched.

    Returns:
        The normals, some of them reversed. Rows of points that are not finite stay as they are.

    Raises:
        ConfigError: If ``towards`` is unknown, or ``viewpoint`` is missing or not wanted.
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> floor = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
        >>> down = torch.tensor([0.0, 0, -1]).expand(25, 3)
        >>> orient_normals(floor, down, towards="+z")[0] + 0
        tensor([0., 0., 1.])
    """
    cloud = as_tensor("orient_normals", "points", points).detach()
    vectors = as_tensor("orient_normals", "normals", normals)
    check_shapes("orient_normals", points=(cloud, "N 3"), normals=(vectors, "N 3"))
    check_floating("orient_normals", points=cloud)
    check_floating("orient_normals", normals=vectors)
    if towards not in get_args(Orientation):
        names = ", ".join(get_args(Orientation))
        raise ConfigError(
            f"orient_normals: expected towards to be one of {names}, got {towards!r}."
        )
    if (towards == "viewpoint") != (viewpoint is not None):
        wanted = "a viewpoint" if viewpoint is None else "no viewpoint"
        repair = "" if viewpoint is None else "; pass towards='viewpoint' to look at one"
        raise ConfigError(f"orient_normals: expected {wanted} with towards={towards!r}{repair}.")
    if viewpoint is not None:
        place = as_tensor("orient_normals", "viewpoint", viewpoint).to(cloud)
        pattern = "3" if place.ndim == 1 else "N 3"
        check_shapes("orient_normals", points=(cloud, "N 3"), viewpoint=(place, pattern))
        return turn_towards(vectors, (place - cloud).to(vectors.dtype))
    if towards not in ("consistent", "interior"):
        axis = torch.zeros(3, dtype=vectors.dtype, device=vectors.device)
        axis["xyz".index(towards[1])] = 1.0 if towards[0] == "+" else -1.0
        return turn_towards(vectors, axis)
    upright = _upright(vectors)
    turn = _turn_outwards if towards == "consistent" else _turn_inside
    if neighbors is not None:
        check_neighbors("orient_normals", neighbors, cloud)
        signs = turn(cloud, upright.detach().to(cloud.dtype), neighbors)
        return upright * signs[:, None].to(vectors.dtype)
    usable = places_of((upright != 0).any(dim=-1) & cloud.isfinite().all(dim=-1))
    if len(usable) == 0:
        return upright
    distinct = distinct_points(cloud[usable], upright[usable].detach().unbind(dim=-1))
    places, units = distinct.points, upright[usable][distinct.rows].detach().to(cloud.dtype)
    spreads = _evenly_spread(len(places)).to(places.device)
    sources = places[spreads]
    near = search_knn(sources, min(NUM_NEIGHBORS, len(sources)), canonical=True)
    oriented = units[spreads] * turn(sources, units[spreads], near)[:, None]
    sides = units.index_copy(0, places_of(spreads), oriented)
    following = places_of(~spreads)
    if len(following):
        signs = _follow(places, units, following, sources, oriented)
        sides = sides.index_copy(0, following, units[following] * signs[:, None])
    # Copies of a point look to the side of the one that stands for them.
    directions = upright.detach().index_copy(0, usable, distinct.restore(sides).to(vectors.dtype))
    return turn_towards(vectors, directions)


def _evenly_spread(num_points: int) -> Tensor:
    """Return which points in canonical order stand for all: every so many along the curve."""
    count = min(num_points, max(_MOST_SPREADING, int(_SPREADING_SHARE * num_points)))
    spreads = torch.zeros(num_points, dtype=torch.bool)
    spreads[torch.arange(count) * num_points // count] = True
    return spreads


def _follow(
    points: Tensor, normals: Tensor, rows: Tensor, nearest: Tensor, oriented: Tensor
) -> Tensor:
    """Return signs of rows ``(n,)`` that agree with oriented normals of points near to them.

    That is followed over whose link the surface bends least, as along the tree of
    :func:`propagate_signs`: the other face of a plate may be nearer.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(nearest.cpu().numpy(), balanced_tree=False, compact_nodes=False)

    def follow(chunk: slice) -> Tensor:
        asked = rows[chunk]
        _, nearest_places = tree.query(points[asked].cpu().numpy(), min(_NUM_FOLLOWED, tree.n))
        near = torch.from_numpy(nearest_places).to(points.device)
        arms = nearest[near] - points[asked, None]
        cosine, slope = _agreement(arms, normals[asked, None].to(points.dtype), oriented[near])
        least = (1 - cosine.abs() + slope).argmin(dim=1, keepdim=True)
        return torch.where(cosine.gather(1, least)[:, 0] < 0, -1.0, 1.0).to(points.dtype)

    return torch.cat(map_chunks(follow, len(rows), CHUNK_SIZE, points.device))


def turn_towards(normals: Tensor, directions: Tensor) -> Tensor:
    """Return normals at no more than a right angle to a direction, ``(3,)`` or ``(N, 3)``."""
    upright = _upright(normals)
    away = (upright * directions).sum(dim=-1, keepdim=True) < 0
    return torch.where(away, -upright, upright)


def _upright(normals: Tensor) -> Tensor:
    """Return normals whose first of z, y, x that is not zero is positive."""
    return torch.where((_leading(normals) < 0)[:, None], -normals, normals)


def _leading(vectors: Tensor) -> Tensor:
    """Return the first of z, y, x that is not zero."""
    x, y, z = vectors.unbind(dim=-1)
    return torch.where(z != 0, z, torch.where(y != 0, y, x))


def _turn_outwards(points: Tensor, normals: Tensor, neighbors: Neighbors) -> Tensor:
    """Return consistent signs, by which each component encloses a positive volume."""
    signs, parts, _ = propagate_signs(points, normals, neighbors)
    count = torch.bincount(parts).double()
    agreed = (normals * signs[:, None]).double()
    local = points.double() - points[:1].double()
    center = _sum_by(parts, local) / count[:, None]
    arms = local - center[parts]
    volume = _sum_by(parts, (arms * agreed).sum(dim=-1))
    size = _sum_by(parts, (arms * arms).sum(dim=-1).sqrt())
    # An open surface encloses nothing, and the rounding of its volume means nothing.
    mean = _sum_by(parts, agreed)
    mean = torch.where(mean.abs() > _CLEARLY_OUTWARDS * count[:, None], mean, 0.0)
    inwards = torch.where(volume.abs() > _CLEARLY_OUTWARDS * size, volume, _leading(mean)) < 0
    return torch.where(inwards[parts], -signs, signs)


def _turn_inside(points: Tensor, normals: Tensor, neighbors: Neighbors) -> Tensor:
    """Return signs for the freer side, by the votes of faces."""
    links = _find_links(points, normals, neighbors)
    signs, patches, faces = propagate_signs(
        points, normals, neighbors, within_patches=True, links=links
    )
    votes = vote_free_side(points, normals, neighbors) * signs
    is_large = torch.bincount(faces)[faces] >= _LEAST_FACE
    of_patches = _decide_patches(_sum_by(patches, votes), patches, signs, links)
    decided = torch.where(is_large, _sum_by(faces, votes)[faces], of_patches[patches])
    return torch.where(decided < 0, -signs, signs)


def _decide_patches(votes: Tensor, patches: Tensor, signs: Tensor, links: "_Links") -> Tensor:
    """Return votes of patches by which small ones agree with those around them, shape ``(M,)``.

    Mostly it is noise that tells a few points from the face that they are on. Links to patches that
    have decided tell more, those of little bend most; patches that no link reaches decide for
    themselves.
    """
    decided = torch.where(torch.bincount(patches) < _LEAST_FACE, 0.0, votes.sign())
    first, second = patches[links.starts], patches[links.ends]
    between = (first != second).nonzero().squeeze(1)
    first, second = first[between], second[between]
    ends = signs[links.starts[between]] * signs[links.ends[between]]
    trust = (1 - links.bends[between].double() / _LARGEST_BEND).clamp(min=0)
    agreement = torch.where(links.cosines[between] < 0, -trust, trust) * ends
    while True:
        seen = _sum_at(decided, first, second, agreement)
        most = _sum_at(decided.abs(), first, second, trust)
        is_new = (decided == 0) & (seen.abs() > _CLEARLY_OUTWARDS * most)
        if not bool(is_new.any()):
            return torch.where(decided == 0, votes, decided)
        decided = torch.where(is_new, seen.sign(), decided)


def _sum_at(values: Tensor, first: Tensor, second: Tensor, weights: Tensor) -> Tensor:
    """Return at each end of links the weighted sum of the values at the others."""
    sums = torch.zeros_like(values).index_add(0, first, weights * values[second])
    return sums.index_add(0, second, weights * values[first])


def _sum_by(groups: Tensor, values: Tensor) -> Tensor:
    """Return the sum of the values of each group."""
    num_groups = int(groups.max()) + 1 if len(groups) else 0
    return values.new_zeros(num_groups, *values.shape[1:]).index_add(0, groups, values)


def propagate_signs(
    points: Tensor,
    normals: Tensor,
    neighbors: Neighbors,
    *,
    within_patches: bool = False,
    links: "_Links | None" = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find signs by which neighbouring normals agree, along a minimum spanning tree [1].

    Two normals agree if one and the mirror image of the other in the plane halfway between the two
    points form less than a right angle [2]: so they do on a sphere, on both sides of a sharp edge,
    and on the two faces of a thin plate, each pointing away from the other. How far a link can be
    trusted is its bend ``1 - |c| + (u . n_i)^2 + (u . n_j)^2``, with ``c`` the cosine of that angle
    and ``u`` the direction of the link: 0 on a plane, 1 over a right-angled edge, 2 through a
    plate. The tree takes the links of least bend; within smooth patches those of more than 0.05 not
    at all. Points are in canonical order if ties are to be independent of it.

    Returns signs ``(N,)``, 1 or -1; the connected patch that each point belongs to, 0 to M-1, whose
    first point has sign 1; and its face within the patch, where no link of the tree bends by more
    than four times the median of all, or 0.01.

    References:
        [1] H. Hoppe et al. Surface reconstruction from unorganized points. SIGGRAPH, 1992.
        [2] H. Xie et al. Piecewise C1 continuous surface reconstruction of noisy point clouds via
        local implicit quadric regression. IEEE Visualization, 2003.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components
    from scipy.sparse.csgraph import minimum_spanning_tree as spanning_tree

    num_points = len(points)
    if num_points == 0:
        none = torch.zeros(0, dtype=torch.int64, device=points.device)
        return normals.new_ones(0), none, none
    links = _find_links(points, normals, neighbors) if links is None else links
    starts, ends = (end.cpu().numpy().astype(np.int32) for end in (links.starts, links.ends))
    bends = links.bends.double().cpu().numpy()
    face_bend = max(_FACE_BEND, _USUAL_BENDS * float(np.median(bends))) if len(bends) else 0.0
    linked = bends <= _PATCH_BEND if within_patches else slice(None)
    # A weight of zero would be no link, so every link weighs one more than its bend.
    weights, pairs = 1 + bends[linked], (starts[linked], ends[linked])
    tree = spanning_tree(csr_array((weights, pairs), shape=(num_points, num_points)))
    num_patches, patches = connected_components(tree, directed=False)
    flat = tree.data <= 1 + face_bend
    rows, columns = tree.nonzero()
    inside = csr_array((np.ones(flat.sum()), (rows[flat], columns[flat])), shape=tree.shape)
    _, faces = connected_components(inside, directed=False)
    _, first = np.unique(patches, return_index=True)
    root = np.full(num_patches, num_points)
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
    patches, faces = (
        torch.from_numpy(numbers).long().to(points.device) for numbers in (patches, faces)
    )
    return signs, patches, faces


class _Links(NamedTuple):
    """Links of neighbours ``(L,)``, lower row first; cosines are of a normal and one mirrored."""

    starts: Tensor
    ends: Tensor
    bends: Tensor
    cosines: Tensor


def _find_links(points: Tensor, normals: Tensor, neighbors: Neighbors) -> _Links:
    """Return the links between each point and its nearest neighbours."""
    indices = neighbors.indices[:, 1 : 1 + _NUM_LINKS].long()
    rows = torch.arange(len(points), device=points.device)[:, None].expand_as(indices)
    linked = indices != rows
    if neighbors.valid is not None:
        linked &= neighbors.valid[:, 1 : 1 + _NUM_LINKS]
    here, there = rows[linked], indices[linked]
    keys = torch.minimum(here, there) * len(points) + torch.maximum(here, there)
    keys = torch.unique(keys)
    low, high = keys // len(points), keys % len(points)
    cosine, slope = _agreement(points[high] - points[low], normals[low], normals[high])
    return _Links(low, high, (1 - cosine.abs() + slope).clamp(min=0), cosine)


def _agreement(links: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cosine between a mirrored normal and the other, and how steep the link is."""
    sq_length = (links * links).sum(dim=-1)
    sq_length = torch.where(sq_length > 0, sq_length, 1.0)
    along_a, along_b = (links * a).sum(dim=-1), (links * b).sum(dim=-1)
    cosine = (a * b).sum(dim=-1) - 2 * along_a * along_b / sq_length
    return cosine, (along_a * along_a + along_b * along_b) / sq_length


def _signs_to_root(points: Tensor, normals: Tensor, parents: Tensor) -> Tensor:
    """Multiply signs along the way to each root, doubling the stride of the way each time."""
    rows = torch.arange(len(points), device=points.device)
    cosine, _ = _agreement(points[parents] - points, normals, normals[parents])
    signs = torch.where(cosine < 0, -1.0, 1.0).to(normals.dtype)
    signs[parents == rows] = 1.0
    while True:
        further = parents[parents]
        signs = signs * signs[parents]
        if torch.equal(further, parents):
            return signs
        parents = further


def vote_free_side(points: Tensor, normals: Tensor, neighbors: Neighbors) -> Tensor:
    """Return how much more free space lies in front of each point than behind it.

    1. The cloud marks the cells of a grid, 1.5 point spacings wide (the 90th percentile of them,
       so that sparse walls have no holes).
    2. From each point, in each of the 26 directions to neighbouring cells, the free path is
       measured to the next marked cell. A path that leaves the cloud's box counts half.
    3. If a neighbour lies straight in front, within 30 degrees of the normal, paths to the front
       end there, and paths to the back likewise; so they do at one with a parallel normal that
       rises by more than 17 degrees. The faces of thin plates are closer than cells.
    4. The vote is the sum of ``sign(n . d) (n . d)^2 f(path)`` over the directions ``d``, where
       ``f`` rises from 0 to 1 and is half at 8 cells.

    Returns votes ``(N,)``, float64, positive where the normal points to the freer side.
    """
    front, back = _near_obstacles(points, normals, neighbors)
    width = _cell_width(points, neighbors)
    votes = torch.zeros(len(points), dtype=torch.float64, device=points.device)
    if len(points) == 0 or width == 0:
        return votes
    cells = ((points - points.amin(dim=0)) / width).floor().long()
    occupied = torch.zeros((cells.amax(dim=0) + 1).tolist(), dtype=torch.bool, device=points.device)
    occupied[cells.unbind(dim=-1)] = True
    for steps in product((-1, 0, 1), repeat=3):
        if any(steps):
            stride = width * math.sqrt(sum(step * step for step in steps))
            free = _free_cells(occupied, steps)
            direction = torch.tensor(steps, dtype=points.dtype, device=points.device)
            count = free[cells.unbind(dim=-1)]
            is_open = count >= _OPEN
            length = torch.where(is_open, count - _OPEN, count) * stride
            cosine = (normals * direction).sum(dim=-1) / (stride / width)
            limit = torch.where(cosine > 0, front, back)
            is_open = is_open & (limit > length)
            path = torch.minimum(length.to(points.dtype), limit)
            worth = path / (path + _HALF_WORTH * width)
            votes += cosine * cosine.abs() * torch.where(is_open, _OPEN_WEIGHT, 1.0) * worth
    return votes


def _near_obstacles(points: Tensor, normals: Tensor, neighbors: Neighbors) -> tuple[Tensor, Tensor]:
    """Return distances to the nearest faces ahead and behind that neighbours lie on, or inf."""

    def measure(chunk: slice) -> tuple[Tensor, Tensor]:
        patches = gather_patches(points, neighbors.indices[chunk])
        height = (patches * normals[chunk, None]).sum(dim=-1)
        sq_distance = (patches * patches).sum(dim=-1)
        around = normals[neighbors.indices[chunk].long()]
        cosine = (around * normals[chunk, None]).sum(dim=-1).abs()
        least_sine = torch.where(cosine > _PARALLEL, _ABOVE, _STEEP)
        beyond = height * height > least_sine * least_sine * sq_distance
        beyond &= neighbors.counted(chunk)
        ahead = torch.where(beyond & (height > 0), height, torch.inf).amin(dim=-1)
        behind = torch.where(beyond & (height < 0), -height, torch.inf).amin(dim=-1)
        return ahead, behind

    parts = map_chunks(measure, len(points), CHUNK_SIZE, points.device)
    front, back = (torch.cat(ends) for ends in zip(*parts, strict=True))
    return front, back


def _cell_width(points: Tensor, neighbors: Neighbors) -> float:
    """Return the width of the grid's cells; wider than asked for if there would be too many."""
    rank = (neighbors.indices.shape[1] - 1) // 2
    if len(points) == 0 or rank == 0:
        return 0.0
    offsets = points[neighbors.indices[:, rank].long()] - points
    # A disk of that radius holds ``rank`` points, one for each square of the spacing.
    spacing = (offsets * offsets).sum(dim=-1).sqrt() * math.sqrt(math.pi / rank)
    at = max(math.ceil(_SPACING_QUANTILE * len(points)), 1)
    width: float = _SPACINGS_PER_CELL * float(spacing.kthvalue(at).values)
    extent: list[float] = (points.amax(dim=0) - points.amin(dim=0)).tolist()
    if width == 0:
        return float(max(extent)) / len(points)
    most = _CELLS_PER_POINT * len(points) + 1000
    while math.prod(side / width + 1 for side in extent) > most:
        width *= 1.25
    return width


def _free_cells(occupied: Tensor, steps: tuple[int, ...]) -> Tensor:
    """Return how many free cells follow each cell in a direction, plus ``_OPEN`` if no end."""
    axis = next(a for a in range(3) if steps[a])
    u, v = (steps[a] for a in range(3) if a != axis)
    layers = occupied.movedim(axis, 0)
    counts = torch.full(layers.shape, _OPEN, dtype=torch.int32, device=occupied.device)
    depth, rows, columns = layers.shape
    order = range(depth - 2, -1, -1) if steps[axis] > 0 else range(1, depth)
    beyond = counts.new_full((rows + 2, columns + 2), _OPEN)
    for layer in order:
        following = layer + steps[axis]
        beyond[1:-1, 1:-1] = torch.where(layers[following], 0, counts[following] + 1)
        counts[layer] = beyond[1 + u : 1 + u + rows, 1 + v : 1 + v + columns]
    return counts.movedim(0, axis)
