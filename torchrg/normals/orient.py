"""Signs of normals: into rooms, to the front of a mesh, to a scanner, along an axis, or alike."""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import (
    as_tensor,
    check_choices,
    check_floating,
    check_points,
    check_shapes,
    eager_only,
)
from torchrg._parallel import nonzero_rows, sequential_operations
from torchrg.errors import ConfigError
from torchrg.neighbors import check_neighbors, distinct_points, distinct_rows, search_knn
from torchrg.normals.faces import find_faces, find_surfaces
from torchrg.normals.free_space import cell_width, vote_free_side
from torchrg.structures import UNLABELED, Cloud, Neighbors

Orientation = Literal[
    "auto", "interior", "viewpoint", "consistent", "up", "+x", "-x", "+y", "-y", "+z", "-z", "none"
]
"""Sides to which normals can point; see :func:`orient_normals`."""

Points = Tensor | NDArray[np.floating]
"""Rows of three numbers, as a tensor or an array."""

NUM_NEIGHBORS = 20
"""Nearest points that orientation uses, the point itself included."""

_NUM_VOTES = 256
"""Points of a face that vote, about."""

_HASH, _HASHES = 2654435761, 2**32
"""Knuth's multiplicative hash of a row, which decides whether its point votes."""

_THICKNESS = 0.5
"""Root mean square height of a thin face by the side of a cell. Two faces farther apart have smooth
patches of their own."""

_CLEARLY_OUTWARDS = 1e-3
"""Fraction of its largest value beyond which a volume or a mean normal cannot be rounding."""

_FEW = 0.01
"""Fraction of the points up to which points of unknown front, such as vertices of no face, follow
their neighbors. More of them may be a part of the room, which decides for itself."""

_AS_NEAR = 1 + 1e-6
"""Ratio of distances that differ by rounding only."""


@eager_only
@sequential_operations()
def orient_normals(
    points: Points | Cloud,
    normals: Points,
    *,
    orient: Orientation = "auto",
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
    neighbors: Neighbors | None = None,
) -> Tensor:
    """Choose the sign of each normal.

    - ``"auto"``: to the front of the surface where it is known, as by the faces of a mesh or the
      places of scanners, else as ``"interior"``.
    - ``"interior"``: into the free space of rooms: floors up, ceilings down, walls into their own
      room, furniture away from its inside. Points of each face vote by the free paths in front of
      them and behind. Several rooms, storeys and missing ceilings are no obstacle; a wall between
      two rooms is right if it is thicker than about two point spacings, a plate seen from both
      sides if normals of its faces can be told apart. A lone object seen from outside is turned
      inwards, as a room would be: use ``"consistent"`` for it.
    - ``"viewpoint"``: towards where the scanner stood.
    - ``"consistent"``: neighbors agree, over edges and across thin plates too; outwards for a
      closed surface. Each connected surface is oriented on its own.
    - ``"up"``, ``"+x"`` ... ``"-z"``: along an axis; up is ``"+z"``. ``"none"``: as they are.

    Convention:
        The result does not depend on the signs of the input, nor on the order of the points. Copies
        of a point count once, and look to one side. A normal for which neither sign is right (at
        right angles to the axis, say) gets the one that makes the first of z, y, x that is not zero
        positive.

    Args:
        points: Points, shape ``(N, 3)``, or a cloud.
        normals: Unit normals, shape ``(N, 3)``; zero where there is none.
        orient: See above.
        viewpoint: Where the scanner stood, shape ``(3,)``, or ``(N, 3)`` for several scans, in the
            coordinates of the points or of the cloud. Only with ``orient="viewpoint"``.
        front: Direction from each point to where its surface was seen from, shape ``(N, 3)``, as
            :attr:`torchrg.Cloud.front`. A point whose front is zero follows the nearest others; if
            these are more than one in a hundred, they are turned as by ``"interior"``. Default:
            that of the cloud.
        neighbors: Neighbors of all points, all of them finite, for faces. Default: searched.

    Returns:
        The normals, some of them reversed. Rows of points that are not finite stay as they are.

    Raises:
        ConfigError: If ``orient`` is unknown, or ``viewpoint`` is missing or not wanted.
        ShapeError: If a shape or dtype is not as above.

    Example:
        >>> cloud = Cloud(np.eye(3), front=np.array([[0, 0, -1]] * 3, np.float32))
        >>> orient_normals(cloud, torch.tensor([[0.0, 0.0, 1.0]] * 3))[0] + 0
        tensor([ 0.,  0., -1.])
        >>> floor = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))
        >>> down = torch.tensor([0.0, 0, -1]).expand(25, 3)
        >>> orient_normals(floor, down, orient="up")[0] + 0
        tensor([0., 0., 1.])
    """
    cloud, directions = find_directions(
        "orient_normals", points, orient, viewpoint=viewpoint, front=front
    )
    vectors = as_tensor("orient_normals", "normals", normals)
    check_shapes("orient_normals", points=(cloud, "N 3"), normals=(vectors, "N 3"))
    check_floating("orient_normals", normals=vectors)
    if neighbors is not None:
        check_neighbors("orient_normals", neighbors, cloud)

    def turn(side: Orientation) -> Tensor:
        if neighbors is not None:
            return turn_faces(cloud, vectors, side, neighbors)
        upright = _upright(vectors)
        usable = nonzero_rows((upright != 0).any(dim=-1) & cloud.isfinite().all(dim=-1))
        units = upright.detach()[usable]
        distinct = distinct_points(cloud[usable], units.unbind(dim=-1))
        turned = distinct.restore(turn_faces(distinct.points, units[distinct.rows], side))
        # Copies of a point look to the side of the one that stands for them.
        return turn_towards(upright, upright.detach().index_copy(0, usable, turned))

    return choose_side(cloud, vectors, orient, directions, turn)


def find_directions(
    caller: str,
    points: Points | Cloud,
    orient: Orientation,
    *,
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Return points ``(N, 3)`` and the directions from them that an orientation needs, or None.

    See :func:`orient_normals` for the arguments and the errors.
    """
    check_choices(caller, orient=(orient, Orientation))
    origin = torch.zeros(3, dtype=torch.float64)
    if isinstance(points, Cloud):
        caller, origin = points.source or caller, torch.from_numpy(points.origin)
        if viewpoint is None and front is None and (orient == "auto" or "scans" in points.header):
            front = points.front
        points = points.points
    places = as_tensor(caller, "points", points).detach()
    check_points(caller, places)
    if viewpoint is not None:
        if orient != "viewpoint":
            raise ConfigError(
                f"{caller}: expected no viewpoint with orient={orient!r}, got one; pass "
                "orient='viewpoint' to look at it."
            )
        is_array = isinstance(viewpoint, Tensor | np.ndarray)
        place = as_tensor(caller, "viewpoint", viewpoint if is_array else np.array(viewpoint))
        check_shapes(
            caller, points=(places, "N 3"), viewpoint=(place, "3" if place.ndim == 1 else "N 3")
        )
        return places, (place - origin.to(place.device)).to(places) - places
    if front is not None:
        directions = as_tensor(caller, "front", front).to(places)
        check_shapes(caller, points=(places, "N 3"), front=(directions, "N 3"))
        return places, directions
    if orient == "viewpoint":
        raise ConfigError(
            f"{caller}: expected a viewpoint, or scanner poses as in an E57 file, got none; pass "
            "the viewpoint (--viewpoint X Y Z), or use interior."
        )
    return places, None


def choose_side(
    points: Tensor,
    normals: Tensor,
    orient: Orientation,
    front: Tensor | None,
    turn: Callable[[Orientation], Tensor],
) -> Tensor:
    """Return normals that look to their side; see :func:`orient_normals`, whose checks are done.

    ``turn`` returns the normals turned face by face, "interior" or "consistent".
    """
    if orient == "none":
        return normals
    if orient in ("auto", "viewpoint") and front is not None:
        return _turn_to_front(points, normals, front.to(normals), turn)
    if orient in ("auto", "interior", "consistent"):
        return turn("consistent" if orient == "consistent" else "interior")
    axis = "+z" if orient == "up" else orient
    direction = normals.new_zeros(3)
    direction["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return turn_towards(normals, direction)


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


def _turn_to_front(
    points: Tensor, normals: Tensor, front: Tensor, turn: Callable[[Orientation], Tensor]
) -> Tensor:
    """Return normals that look to the front, or as their neighbors where that is not known."""
    from scipy.spatial import cKDTree

    turned, is_known = turn_towards(normals, front), (front != 0).any(dim=-1)
    has_normal = (normals != 0).any(dim=-1)
    lost = nonzero_rows(has_normal & ~is_known & points.isfinite().all(dim=-1))
    if len(lost) == 0:
        return turned
    # Copies with one normal and one front count once.
    rows = distinct_rows(points, *turned.unbind(dim=-1), *front.unbind(dim=-1))
    rows = rows[has_normal[rows]]
    seeing = rows[is_known[rows]]
    if len(rows) - len(seeing) > _FEW * len(rows):
        return turned.index_copy(0, lost, turn("interior")[lost])
    tree, places = (cKDTree(points[seeing].numpy(force=True)), points[lost].numpy(force=True))
    distance, _ = tree.query(places)
    # All that are as near, so that their order does not matter.
    near = tree.query_ball_point(places, distance * _AS_NEAR)
    looks = torch.stack([turned[seeing[rows]].sum(dim=0) for rows in near])
    return turned.index_copy(0, lost, turn_towards(normals[lost], looks))


def turn_faces(
    points: Tensor,
    normals: Tensor,
    side: Orientation,
    neighbors: Neighbors | None = None,
    labels: Tensor | None = None,
    axes: Tensor | None = None,
) -> Tensor:
    """Return normals turned face by face, "interior" or "consistent".

    Points ``(N, 3)`` are distinct and in canonical order. Neighbors are searched where they are
    few. Planes by their ``labels`` ``(N,)`` and unit normals ``(M, 3)`` are faces of an interior.
    """
    upright = _upright(normals)
    if len(points) == 0:
        return upright
    k = min(NUM_NEIGHBORS, len(points))
    if neighbors is None or neighbors.indices.shape[1] < k:
        neighbors = search_knn(points, k)
    near, places, units = (
        values.detach().cpu() for values in (neighbors.indices[:, :k], points, upright.to(points))
    )
    if side == "consistent":
        signs = _turn_outwards(places, units, near)
    else:
        labels = torch.full((len(points),), UNLABELED) if labels is None else labels.cpu()
        axes = places.new_zeros(0, 3) if axes is None else axes.cpu()
        signs = _turn_inside(places, units, near, labels, axes)
    return upright * signs[:, None].to(upright)


def _turn_inside(
    points: Tensor, normals: Tensor, near: Tensor, labels: Tensor, axes: Tensor
) -> Tensor:
    """Return signs for the freer side, by the votes of some points of each face."""
    width = cell_width(points, near)
    faces, signs = find_faces(points, normals, near, labels, axes, _THICKNESS * width)
    sizes = torch.bincount(faces)
    hashes = torch.arange(len(points)) * _HASH % _HASHES
    rows = nonzero_rows(hashes * sizes[faces] < _NUM_VOTES * _HASHES)
    votes = vote_free_side(points, normals, near, rows, width) * signs[rows]
    total = torch.bincount(faces[rows], votes.double(), minlength=len(sizes))
    return torch.where(total[faces] < 0, -signs, signs)


def _turn_outwards(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """Return consistent signs, by which each surface encloses a positive volume."""
    surfaces, signs = find_surfaces(points, normals, near)
    count = torch.bincount(surfaces)[:, None]
    agreed, local = (normals * signs[:, None]).double(), (points - points[:1]).double()
    arms = local - (_sum_by(surfaces, local) / count)[surfaces]
    volume = _sum_by(surfaces, (arms * agreed).sum(dim=-1))
    size = _sum_by(surfaces, (arms * arms).sum(dim=-1).sqrt())
    # An open surface encloses nothing, and the rounding of its volume means nothing.
    mean = _sum_by(surfaces, agreed)
    mean = torch.where(mean.abs() > _CLEARLY_OUTWARDS * count, mean, 0.0)
    inwards = torch.where(volume.abs() > _CLEARLY_OUTWARDS * size, volume, _leading(mean)) < 0
    return torch.where(inwards[surfaces], -signs, signs)


def _sum_by(groups: Tensor, values: Tensor) -> Tensor:
    """Return the sum of the values of each group."""
    num_groups = int(groups.max()) + 1
    return values.new_zeros(num_groups, *values.shape[1:]).index_add(0, groups, values)
