"""Normal orientation: interior, mesh front, scanner position, axis, or consistent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchrg import scratch
from torchrg._checks import (
    as_cloud,
    as_tensor,
    check_choices,
    check_floating,
    check_points,
    check_shapes,
    eager_only,
)
from torchrg._parallel import ROWS_AT_ONCE, nonzero_rows, split_rows
from torchrg.errors import ConfigError
from torchrg.neighbors import distinct_points, search_knn
from torchrg.neighbors.knn import check_neighbors
from torchrg.neighbors.order import distinct_rows
from torchrg.normals.faces import find_faces, find_surfaces
from torchrg.normals.free_space import cell_width, vote_free_side
from torchrg.structures import UNLABELED, AnyCloud, Cloud, Neighbors
from torchrg.structures.points import Points

Orientation = Literal[
    "auto", "interior", "viewpoint", "consistent", "up", "+x", "-x", "+y", "-y", "+z", "-z", "none"
]
"""Modes of normal orientation; see :func:`orient_normals`."""
SearchDistinct = Callable[[Tensor, int], Neighbors]
"""Search of ``k`` neighbors among distinct finite points in canonical order, as transforms use."""
NUM_NEIGHBORS = 20
"""Neighborhood size for orientation, including the point itself."""
_NUM_VOTES = 256
"""Approximate number of voting points per face."""
_HASH, _HASHES = 2654435761, 2**32
"""Knuth's multiplicative hash of a row; it selects the voting points."""
_THICKNESS = 0.5
"""RMS height of a thin face, as a fraction of the cell width. Two faces farther apart have separate
smooth patches."""
_CLEARLY_OUTWARDS = 1e-3
"""Fraction of its maximum above which a volume or a mean normal is not a rounding error."""
_FEW = 0.01
"""Maximum fraction of points with unknown front, such as vertices without faces, that follow their
neighbors. More of them may form a part of the room and are oriented as ``"interior"``."""
_AS_NEAR = 1 + 1e-6
"""Ratio below which two distances differ only by rounding."""


@eager_only
def orient_normals(
    points: AnyCloud,
    normals: Points,
    *,
    orient: Orientation = "auto",
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
    neighbors: Neighbors | SearchDistinct | None = None,
) -> Tensor:
    """Choose the sign of each normal.

    - ``"auto"``: the front of the surface if known, from mesh faces or scanner positions, else
      ``"interior"``.
    - ``"interior"``: into the free space of rooms: floors up, ceilings down, walls into their room,
      furniture outwards. Points of each face vote by the free paths in front and behind. Multiple
      rooms, several floors and missing ceilings are supported. A wall between two rooms is correct
      if it is thicker than about two point spacings, a plate seen from both sides if the normals of
      its faces can be separated. A single object seen from outside is turned inwards like a room;
      use ``"consistent"`` instead.
    - ``"viewpoint"``: towards the scanner position.
    - ``"consistent"``: neighbors agree, also over edges and across thin plates; outwards for closed
      surfaces. Each connected surface is oriented independently.
    - ``"up"``, ``"+x"`` ... ``"-z"``: along an axis; up is ``"+z"``. ``"none"``: unchanged.

    Convention:
        The result does not depend on the input signs or the order of the points. Duplicates count
        once and have one orientation. If neither sign is right, as for a normal orthogonal to the
        axis, the first nonzero coordinate of z, y, x is made positive.

    Args:
        points: Points, shape ``(N, 3)``, a cloud or the path of a file.
        normals: Unit normals, shape ``(N, 3)``; zero for points without a normal.
        orient: Orientation mode, see above. Default: ``"auto"``.
        viewpoint: Scanner position, shape ``(3,)``, or ``(N, 3)`` for several scans, in the
            coordinates of the points or of the cloud. Only with ``orient="viewpoint"``.
        front: Direction from each point to the side from which its surface was seen, shape
            ``(N, 3)``, as :attr:`torchrg.Cloud.front`. Points with a zero front follow their
            nearest neighbors; if they are more than 1 % of all points, they are oriented as
            ``"interior"``. Default: that of the cloud.
        neighbors: Neighbors of all points, which must be finite, or a function that searches them.
            Default: searched among distinct points.

    Returns:
        The normals, some of them reversed. Rows of points that are not finite are unchanged.

    Raises:
        ConfigError: If ``orient`` is unknown, ``viewpoint`` is missing or unexpected, or
            ``viewpoint`` or ``front`` is not finite.
        ShapeError: If a shape or dtype is wrong.

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
    known = None if callable(neighbors) else neighbors
    if known is not None:
        check_neighbors("orient_normals", known, cloud)

    def turn(side: Orientation) -> Tensor:
        if known is not None:
            return turn_faces(cloud, vectors, side, known)
        upright = _upright(vectors)
        usable = nonzero_rows((upright != 0).any(dim=-1) & cloud.isfinite().all(dim=-1))
        units = upright.detach()[usable]
        distinct = distinct_points(cloud[usable], units.unbind(dim=-1))
        near = neighbors(distinct.points, NUM_NEIGHBORS) if callable(neighbors) else None
        turned = distinct.restore(turn_faces(distinct.points, units[distinct.rows], side, near))
        # Duplicates follow the orientation of their representative.
        return turn_towards(upright, upright.detach().index_copy(0, usable, turned))

    return choose_side(cloud, vectors, orient, directions, turn)


def find_directions(
    caller: str,
    points: AnyCloud,
    orient: Orientation,
    *,
    viewpoint: Points | Sequence[float] | None = None,
    front: Points | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Return points ``(N, 3)`` and the front directions that an orientation needs, or None.

    See :func:`orient_normals` for the arguments and the errors.
    """
    check_choices(caller, orient=(orient, Orientation))
    origin = torch.zeros(3, dtype=torch.float64)
    points = as_cloud(points)
    if isinstance(points, Cloud):
        caller, origin = points.source or caller, torch.from_numpy(points.origin)
        if viewpoint is None and front is None and (orient == "auto" or "scans" in points.header):
            front = points.front
        points = points.points
    positions = as_tensor(caller, "points", points).detach()
    check_points(caller, positions)
    if viewpoint is not None:
        if orient != "viewpoint":
            raise ConfigError(
                f"{caller}: expected no viewpoint with orient={orient!r}, got one; pass "
                "orient='viewpoint' to use it."
            )
        is_array = isinstance(viewpoint, Tensor | np.ndarray)
        position = as_tensor(caller, "viewpoint", viewpoint if is_array else np.array(viewpoint))
        position = position.to(positions.device)
        check_shapes(
            caller,
            points=(positions, "N 3"),
            viewpoint=(position, "3" if position.ndim == 1 else "N 3"),
        )
        _check_finite(caller, "viewpoint", position, positions, "pass the scanner position")
        return positions, (position - origin.to(position.device)).to(positions) - positions
    if front is not None:
        directions = as_tensor(caller, "front", front).to(positions)
        check_shapes(caller, points=(positions, "N 3"), front=(directions, "N 3"))
        _check_finite(caller, "front", directions, positions, "pass zeros where it is unknown")
        return positions, directions
    if orient == "viewpoint":
        raise ConfigError(
            f"{caller}: expected a viewpoint, or scanner poses as in an E57 file, got none; pass "
            "the viewpoint (--viewpoint X Y Z), or use interior."
        )
    return positions, None


def _check_finite(caller: str, name: str, values: Tensor, points: Tensor, repair: str) -> None:
    """Check values ``(3,)``, or those ``(N, 3)`` of all finite points."""
    wrong = ~values.isfinite()
    if values.ndim == 2:
        wrong &= points.isfinite().all(dim=1, keepdim=True).to(wrong.device)
    if bool(wrong.any()):
        shown = values[wrong][0].item()
        raise ConfigError(f"{caller}: expected finite {name}, got {shown}; {repair}.")


def choose_side(
    points: Tensor,
    normals: Tensor,
    orient: Orientation,
    front: Tensor | None,
    turn: Callable[[Orientation], Tensor],
) -> Tensor:
    """Return oriented normals; see :func:`orient_normals`, whose checks are done.

    ``turn`` returns normals oriented face by face, "interior" or "consistent".
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
    """Return normals at an angle of at most 90 degrees to directions ``(3,)`` or ``(N, 3)``."""
    upright = _upright(normals)
    away = (upright * directions).sum(dim=-1, keepdim=True) < 0
    return torch.where(away, -upright, upright)


def _upright(normals: Tensor) -> Tensor:
    """Return normals whose first nonzero coordinate of z, y, x is positive."""
    return torch.where((_leading(normals) < 0)[:, None], -normals, normals)


def _leading(vectors: Tensor) -> Tensor:
    """Return the first nonzero coordinate of z, y, x."""
    x, y, z = vectors.unbind(dim=-1)
    return torch.where(z != 0, z, torch.where(y != 0, y, x))


def _turn_to_front(
    points: Tensor, normals: Tensor, front: Tensor, turn: Callable[[Orientation], Tensor]
) -> Tensor:
    """Orient normals to the front, or like their neighbors if the front is unknown."""
    from scipy.spatial import cKDTree

    turned, is_known = turn_towards(normals, front), (front != 0).any(dim=-1)
    has_normal = (normals != 0).any(dim=-1)
    lost = nonzero_rows(has_normal & ~is_known & points.isfinite().all(dim=-1))
    if len(lost) == 0:
        return turned
    # Duplicates with the same normal and front count once.
    rows = distinct_rows(points, *turned.unbind(dim=-1), *front.unbind(dim=-1))
    rows = rows[has_normal[rows]]
    seeing = rows[is_known[rows]]
    if len(rows) - len(seeing) > _FEW * len(rows):
        return turned.index_copy(0, lost, turn("interior")[lost])
    tree, positions = (cKDTree(points[seeing].numpy(force=True)), points[lost].numpy(force=True))
    distance, _ = tree.query(positions)
    # Include all ties, so the order of the points does not matter.
    near = tree.query_ball_point(positions, distance * _AS_NEAR)
    sums = torch.stack([turned[seeing[rows]].sum(dim=0) for rows in near])
    return turned.index_copy(0, lost, turn_towards(normals[lost], sums))


def turn_faces(
    points: Tensor,
    normals: Tensor,
    side: Orientation,
    neighbors: Neighbors | None = None,
    labels: Tensor | None = None,
    axes: Tensor | None = None,
) -> Tensor:
    """Return normals oriented face by face, "interior" or "consistent".

    Points ``(N, 3)`` are distinct and in canonical order. Neighbors are searched if there are too
    few. Planes with ``labels`` ``(N,)`` and unit normals ``axes`` ``(M, 3)`` are interior faces.
    """
    upright = scratch.store(_upright(normals))
    if len(points) == 0:
        return upright
    k = min(NUM_NEIGHBORS, len(points))
    if neighbors is None or neighbors.indices.shape[1] < k:
        neighbors = search_knn(points, k)
    near, positions, units = (
        values.detach().cpu() for values in (neighbors.indices, points, upright.to(points))
    )
    if side == "consistent":
        signs = _turn_outwards(positions, units, near)
    else:
        labels = torch.full((len(points),), UNLABELED) if labels is None else labels.cpu()
        axes = positions.new_zeros(0, 3) if axes is None else axes.cpu()
        signs = _turn_inside(positions, units, near, labels, axes)
    return upright * signs[:, None].to(upright)


def _turn_inside(
    points: Tensor, normals: Tensor, near: Tensor, labels: Tensor, axes: Tensor
) -> Tensor:
    """Return signs towards the freer side, voted by a sample of the points of each face."""
    width = cell_width(points, near[:, :NUM_NEIGHBORS])
    faces, signs = find_faces(points, normals, near, labels, axes, _THICKNESS * width)
    sizes = torch.bincount(faces)
    votes_at = torch.zeros(len(points), dtype=torch.bool)
    for part in split_rows(len(points), ROWS_AT_ONCE):
        hashes = torch.arange(part.start, part.stop) * _HASH % _HASHES
        votes_at[part] = hashes * sizes.index_select(0, faces[part]) < _NUM_VOTES * _HASHES
    rows = nonzero_rows(votes_at)
    votes = vote_free_side(points, normals, near, rows, width) * signs[rows]
    total = torch.bincount(faces[rows], votes.double(), minlength=len(sizes))
    return torch.where(total.index_select(0, faces) < 0, -signs, signs)


def _turn_outwards(points: Tensor, normals: Tensor, near: Tensor) -> Tensor:
    """Return consistent signs for which each surface encloses a positive volume."""
    surfaces, signs = find_surfaces(points, normals, near)
    count = torch.bincount(surfaces)[:, None]
    agreed = scratch.store((normals * signs[:, None]).double())
    local = scratch.store((points - points[:1]).double())
    arms = scratch.store(local - (_sum_by(surfaces, local) / count)[surfaces])
    volume = _sum_by(surfaces, (arms * agreed).sum(dim=-1))
    size = _sum_by(surfaces, (arms * arms).sum(dim=-1).sqrt())
    # An open surface encloses no volume; ignore its rounding error.
    mean = _sum_by(surfaces, agreed)
    mean = torch.where(mean.abs() > _CLEARLY_OUTWARDS * count, mean, 0.0)
    inwards = torch.where(volume.abs() > _CLEARLY_OUTWARDS * size, volume, _leading(mean)) < 0
    return torch.where(inwards[surfaces], -signs, signs)


def _sum_by(groups: Tensor, values: Tensor) -> Tensor:
    """Return the sum of the values of each group."""
    num_groups = int(groups.max()) + 1
    return values.new_zeros(num_groups, *values.shape[1:]).index_add(0, groups, values)
