"""Signs of normals: towards a place or direction, consistent, or into rooms."""

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ConfigError
from torchrg.neighbors import finite_rows, search_knn
from torchrg.normals.interior import vote_free_side
from torchrg.normals.propagate import propagate_signs
from torchrg.structures import Neighbors

Orientation = Literal["viewpoint", "+x", "-x", "+y", "-y", "+z", "-z", "consistent", "interior"]

ORIENTATIONS: tuple[str, ...] = (
    "viewpoint",
    *("+x", "-x", "+y", "-y", "+z", "-z"),
    "consistent",
    "interior",
)
"""What normals can be turned towards."""

_NUM_NEIGHBORS = 20
_FACE_BEND = 0.05
_CLEARLY_OUTWARDS = 1e-3


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
      along a spanning tree (:func:`torchrg.normals.propagate.propagate_signs`); outwards for a
      closed surface. Components of the neighbour graph are turned each for itself.
    - ``"interior"``: into the free space of rooms: floors up, ceilings down, walls into their own
      room, furniture away from its inside. Each point votes by the free paths in front of it and
      behind (:func:`torchrg.normals.interior.vote_free_side`), and smooth pieces of surface decide
      by majority. Several rooms, storeys and missing ceilings are no obstacle; a wall between two
      rooms is right if it is thicker than about two point spacings, a plate seen from both sides if
      normals of its faces can be told apart. A lone object seen from outside is turned inwards, as
      a room would be: use ``"consistent"`` for it.

    Convention:
        The result does not depend on the signs that came in, nor on the order of the points. A
        normal for which neither sign is right (at right angles to the axis, say) gets the one that
        makes the first of z, y, x that is not zero positive. Region growing ignores signs.

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
    cloud = as_tensor("orient_normals", "points", points)
    given = as_tensor("orient_normals", "normals", normals)
    check_shapes("orient_normals", points=(cloud, "N 3"), normals=(given, "N 3"))
    check_floating("orient_normals", points=cloud)
    check_floating("orient_normals", normals=given)
    if towards not in ORIENTATIONS:
        names = ", ".join(ORIENTATIONS)
        raise ConfigError(
            f"orient_normals: expected towards to be one of {names}, got {towards!r}."
        )
    if (towards == "viewpoint") != (viewpoint is not None):
        wanted = "a viewpoint" if viewpoint is None else "no viewpoint"
        raise ConfigError(f"orient_normals: expected {wanted} with towards={towards!r}.")
    upright = _upright(given)
    if viewpoint is not None:
        place = as_tensor("orient_normals", "viewpoint", viewpoint).to(cloud)
        pattern = "3" if place.ndim == 1 else "N 3"
        check_shapes("orient_normals", points=(cloud, "N 3"), viewpoint=(place, pattern))
        return _face(upright, (place - cloud).to(upright.dtype))
    if towards not in ("consistent", "interior"):
        axis = torch.zeros(3, dtype=given.dtype, device=given.device)
        axis["xyz".index(towards[1])] = 1.0 if towards[0] == "+" else -1.0
        return _face(upright, axis)
    turn = _turn_outwards if towards == "consistent" else _turn_inside
    if neighbors is not None:
        return upright * turn(cloud, upright.to(cloud.dtype), neighbors)[:, None].to(given.dtype)
    rows = finite_rows(cloud)
    rows = rows[(upright[rows] != 0).any(dim=-1)]
    if len(rows) == 0:
        return upright
    kept, units = cloud[rows], upright[rows]
    near = search_knn(kept, min(_NUM_NEIGHBORS, len(kept)), canonical=True)
    signs = turn(kept, units.to(cloud.dtype), near)[:, None].to(given.dtype)
    return upright.index_copy(0, rows, units * signs)


def _upright(normals: Tensor) -> Tensor:
    """Return normals whose first of z, y, x that is not zero is positive."""
    return torch.where((_leading(normals) < 0)[:, None], -normals, normals)


def _leading(vectors: Tensor) -> Tensor:
    """Return the first of z, y, x that is not zero."""
    x, y, z = vectors.unbind(dim=-1)
    return torch.where(z != 0, z, torch.where(y != 0, y, x))


def _face(normals: Tensor, direction: Tensor) -> Tensor:
    """Return normals reversed where they form more than a right angle with a direction."""
    away = (normals * direction).sum(dim=-1, keepdim=True) < 0
    return torch.where(away, -normals, normals)


def _turn_outwards(points: Tensor, normals: Tensor, neighbors: Neighbors) -> Tensor:
    """Return consistent signs, by which each component encloses a positive volume."""
    signs, parts = propagate_signs(points, normals, neighbors)
    num_parts = int(parts.max()) + 1 if len(parts) else 0
    count = torch.bincount(parts, minlength=num_parts).double()
    agreed = (normals * signs[:, None]).double()
    sums = agreed.new_zeros(num_parts, 3)
    local = points.double() - points[:1].double()
    center = sums.index_add(0, parts, local) / count[:, None]
    arms = local - center[parts]
    volume = _sum_by(parts, (arms * agreed).sum(dim=-1), num_parts)
    size = _sum_by(parts, (arms * arms).sum(dim=-1).sqrt(), num_parts)
    # An open surface encloses nothing, and the rounding of its volume means nothing.
    mean = sums.index_add(0, parts, agreed)
    mean = torch.where(mean.abs() > _CLEARLY_OUTWARDS * count[:, None], mean, 0.0)
    inwards = torch.where(volume.abs() > _CLEARLY_OUTWARDS * size, volume, _leading(mean)) < 0
    return torch.where(inwards[parts], -signs, signs)


def _turn_inside(points: Tensor, normals: Tensor, neighbors: Neighbors) -> Tensor:
    """Return signs for the freer side, by the votes of smooth pieces of surface."""
    signs, pieces = propagate_signs(points, normals, neighbors, max_bend=_FACE_BEND)
    votes = vote_free_side(points, normals, neighbors) * signs
    totals = _sum_by(pieces, votes, int(pieces.max()) + 1 if len(pieces) else 0)
    return torch.where(totals[pieces] < 0, -signs, signs)


def _sum_by(groups: Tensor, values: Tensor, num_groups: int) -> Tensor:
    """Return the sum of the values of each group."""
    return values.new_zeros(num_groups).index_add(0, groups, values)
