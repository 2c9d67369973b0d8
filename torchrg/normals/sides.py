"""Signs of normals by what is known of a cloud: faces of its mesh, places of scanners, or rooms."""

from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import places_of
from torchrg.errors import ConfigError
from torchrg.neighbors import distinct_rows
from torchrg.normals.orient import Orientation, orient_normals, turn_towards
from torchrg.structures import Cloud

CloudOrientation = Orientation | Literal["auto", "up", "none"]
"""Names of the sides that the normals of a cloud can be turned towards."""

_FEW = 0.01
"""Share of the points up to which those of unknown front, as vertices of no face, follow their
neighbours. Where there are more, they may be a part of the room, which decides for itself."""
_AS_NEAR = 1 + 1e-6
"""Ratio of distances that differ by rounding only."""


def orient_cloud(
    cloud: Cloud,
    normals: Tensor,
    towards: CloudOrientation = "auto",
    *,
    viewpoint: NDArray[np.floating] | None = None,
) -> Tensor:
    """Choose the sign of each normal of a cloud that was read from a file.

    - ``"auto"``: to the front where the cloud has one, by the faces of its mesh or by where its
      scanners stood; else as ``"interior"``.
    - ``"viewpoint"``: towards ``viewpoint``, or where the scanners stood by the file.
    - ``"up"``: as ``"+z"``. ``"none"``: as they are.
    - ``"interior"`` and the others: see :func:`orient_normals`.

    A point without a front follows the nearest that have one. Where more than one in a hundred is
    without, as where few points of a file are of faces, these are turned as by ``"interior"``.

    Args:
        cloud: The cloud, as :func:`torchrg.read_cloud` gives it.
        normals: Unit normals of its points, shape ``(N, 3)``; zero where there is none.
        towards: See above.
        viewpoint: Where the scanner stood, in the coordinates of the cloud, shape ``(3,)``.

    Raises:
        ConfigError: If ``towards`` is unknown, or no place is known to look at.

    Example:
        >>> from torchrg.structures import Cloud
        >>> cloud = Cloud(np.eye(3), front=np.array([[0, 0, -1]] * 3, np.float32))
        >>> orient_cloud(cloud, torch.tensor([[0.0, 0.0, 1.0]] * 3))[0] + 0
        tensor([ 0.,  0., -1.])
    """
    if towards == "none":
        return normals
    if viewpoint is None:
        check_viewpoint(cloud, towards)
        if towards == "viewpoint" or (towards == "auto" and cloud.front is not None):
            return _to_front(cloud, normals)
    way: Orientation = {"auto": "interior", "up": "+z"}.get(towards, towards)  # type: ignore[assignment]
    place = None if viewpoint is None else torch.from_numpy(viewpoint - cloud.origin)
    return orient_normals(cloud.points, normals, towards=way, viewpoint=place)


def check_viewpoint(cloud: Cloud, towards: str, repair: str = "use interior") -> None:
    """Raise ConfigError if normals shall look at scanners and the cloud does not know of any."""
    has_stations = cloud.front is not None and "scans" in cloud.header
    if towards == "viewpoint" and not has_stations:
        name = cloud.source or "orient_cloud"
        raise ConfigError(
            f"{name}: expected poses of scanners, as an E57 file may have, to orient normals by "
            f"viewpoint, got none; {repair}."
        )


def _to_front(cloud: Cloud, normals: Tensor) -> Tensor:
    """Return normals that look to the front of the cloud."""
    from scipy.spatial import cKDTree

    points, front = cloud.points, torch.from_numpy(cloud.front).to(normals)
    turned, is_known = turn_towards(normals, front), (front != 0).any(dim=-1)
    has_normal = (normals != 0).any(dim=-1)
    lost = places_of(has_normal & ~is_known & points.isfinite().all(dim=-1))
    if len(lost) == 0:
        return turned
    # Copies with one normal and one front count once.
    rows = distinct_rows(points, *turned.unbind(dim=-1), *front.unbind(dim=-1))
    rows = rows[has_normal[rows]]
    seeing = rows[is_known[rows]]
    if len(rows) - len(seeing) > _FEW * len(rows):
        inside = orient_normals(points, normals, towards="interior")
        return turned.index_copy(0, lost, inside[lost])
    tree, places = cKDTree(points[seeing].numpy()), points[lost].numpy()
    distance, _ = tree.query(places)
    # All that are as near, so that their order does not matter.
    near = tree.query_ball_point(places, distance * _AS_NEAR)
    looks = torch.stack([turned[seeing[rows]].sum(dim=0) for rows in near])
    return turned.index_copy(0, lost, turn_towards(normals[lost], looks))
