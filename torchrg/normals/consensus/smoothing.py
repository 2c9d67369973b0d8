"""Rounds in which points learn from the planes of their neighbours."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg._parallel import CHUNK_SIZE, map_chunks
from torchrg.linalg import signs
from torchrg.linalg.moments import residuals, split_columns, sq_lengths
from torchrg.neighbors import gather_patches
from torchrg.normals.consensus.hypotheses import support_scores
from torchrg.structures import Neighbors

_REACH = 2.5
_AGREEMENT = 4.2
_MAX_TILT = 0.95
_RIDGE = 0.01
_VOTE_TOLERANCE = 2.0
_RANK_STEP = 3
_OWN_PLANE_REACH = 3.0
_OWN_RESIDUAL_COST = 0.1


class TangentPlanes(NamedTuple):
    """A plane at each point.

    Attributes:
        normals: Unit normals of any sign, shape ``(N, 3)``; zero where there is no plane.
        offsets: Signed distance of the plane from its point along the normal, shape ``(N,)``.
    """

    normals: Tensor
    offsets: Tensor


def average_planes(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    errors: Tensor,
    rows: Tensor,
    *,
    chunk_size: int = CHUNK_SIZE,
) -> TangentPlanes:
    r"""Give points the average of the planes of those neighbours that agree with theirs.

    Neighbour j agrees with point i as far as its plane passes through i, within 2.5 times the
    noise, and the chord ``c_ij`` between the normals is within 4.2 times its standard error
    ``a_ij = (a_i^2 + a_j^2)^(1/2)``: a bilateral filter of planes, with weights ``w_j`` of
    ``(1 - (c_ij / 4.2 a_ij)^2)^2 (1 - (r_ij / 2.5 s_i)^2) (1 - d_ij^2 / (2 d_max^2)) / a_j^2``,
    each factor at least 0. On a curved surface a mere average would lean towards the denser side;
    the weights are therefore tilted by a linear function of the position, such that the weighted
    mean of the positions is the point (local linear regression).

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        planes: Plane of each point.
        noise: Standard deviation of the noise, shape ``(N,)``.
        errors: Standard error of the normals, radians, shape ``(N,)``, positive.
        rows: Points to treat, shape ``(n,)``.
        chunk_size: Points handled at a time.

    Returns:
        The planes of all points.
    """
    normals, offsets = planes.normals.clone(), planes.offsets.clone()
    parts = planes.normals.T.contiguous()

    def work(block: slice) -> None:
        chosen = rows[block]
        indices = neighbors.indices[chosen]
        flat = indices.reshape(-1)
        columns = split_columns(gather_patches(points, indices))
        x, y, z = (part.index_select(0, flat).view(indices.shape) for part in parts)
        a, b, c = (part.index_select(0, chosen)[:, None] for part in parts)
        cosines = x * a + y * b + z * c
        sign = signs(cosines)
        offset = planes.offsets.index_select(0, flat).view(indices.shape)
        rests = -(x * columns[0] + y * columns[1] + z * columns[2]) - offset
        sq_chords = 2 * (1 - cosines.abs())
        sq_error = (errors * errors).index_select(0, flat).view(indices.shape)
        sq_angle = _AGREEMENT**2 * (sq_error + sq_error[:, :1])
        reach = _REACH * noise[chosen][:, None]
        sq_distances = sq_lengths(columns)
        farthest = sq_distances.amax(dim=1, keepdim=True)
        weights = (1 - sq_chords / sq_angle).clamp_(min=0).square_() * (sq_error[:, :1] / sq_error)
        weights *= (1 - (rests / reach).square_()).clamp_(min=0)
        weights *= 1 - 0.5 * sq_distances / torch.where(farthest > 0, farthest, 1.0)
        if neighbors.valid is not None:
            weights *= neighbors.valid[chosen]
        weights = _balanced(columns, weights) * sign
        mean = torch.stack([(weights * part).sum(dim=1) for part in (x, y, z)], dim=-1)
        length = (mean * mean).sum(dim=1).sqrt_()
        found = length > 0
        safe = torch.where(found, length, 1.0)
        normals[chosen] = torch.where(found[:, None], mean / safe[:, None], normals[chosen])
        moved = -(weights * rests).sum(dim=1) / torch.where(found, (weights * sign).sum(dim=1), 1.0)
        offsets[chosen] = torch.where(found, moved, offsets[chosen])

    map_chunks(work, len(rows), chunk_size, rows.device)
    return TangentPlanes(normals, offsets)


def choose_planes(
    points: Tensor,
    neighbors: Neighbors,
    planes: TangentPlanes,
    noise: Tensor,
    rows: Tensor,
    *,
    chunk_size: int = CHUNK_SIZE,
) -> TangentPlanes:
    r"""Give points the plane, among those of their neighbours, that their neighbourhood supports.

    The score of a plane is that of
    :func:`torchrg.normals.consensus.hypotheses.vote_planes` per weight, less a
    tenth of the square of the point's own residual in units of the noise; planes from which the
    point is farther than three times the noise do not qualify.

    Args:
        points: Points, shape ``(N, 3)``.
        neighbors: Neighbours of all points.
        planes: Plane of each point.
        noise: Standard deviation of the noise, shape ``(N,)``.
        rows: Points to treat, shape ``(n,)``.
        chunk_size: Points handled at a time.

    Returns:
        The planes of all points.
    """
    normals, offsets = planes.normals.clone(), planes.offsets.clone()

    def work(block: slice) -> None:
        chosen = rows[block]
        indices = neighbors.indices[chosen]
        columns = split_columns(gather_patches(points, indices))
        sq_distances = sq_lengths(columns)
        farthest = sq_distances.amax(dim=1, keepdim=True)
        weights = 1 - 0.9 * sq_distances / torch.where(farthest > 0, farthest, 1.0)
        if neighbors.valid is not None:
            weights *= neighbors.valid[chosen]
        total, scale = weights.sum(dim=1), noise[chosen]
        best = torch.full_like(scale, -torch.inf)
        for rank in range(0, indices.shape[1], _RANK_STEP):
            other = indices[:, rank]
            normal = planes.normals.index_select(0, other)
            place = torch.stack([column[:, rank] for column in columns], dim=-1)
            offset = planes.offsets.index_select(0, other) + (normal * place).sum(dim=1)
            rests = residuals(columns, normal, offset) / (_VOTE_TOLERANCE * scale)[:, None]
            own = offset / scale
            score = support_scores(rests, weights) / total - _OWN_RESIDUAL_COST * own * own
            usable = (own.abs() < _OWN_PLANE_REACH) & ((normal * normal).sum(dim=1) > 0)
            better = usable & (score > best)
            best = torch.where(better, score, best)
            normals[chosen] = torch.where(better[:, None], normal, normals[chosen])
            offsets[chosen] = torch.where(better, offset, offsets[chosen])

    map_chunks(work, len(rows), chunk_size, rows.device)
    return TangentPlanes(normals, offsets)


def _balanced(columns: tuple[Tensor, Tensor, Tensor], weights: Tensor) -> Tensor:
    """Return weights tilted such that the weighted mean of the positions is nearly the point."""
    radius = sq_lengths(columns).amax(dim=1, keepdim=True).sqrt_()
    x, y, z = (column / torch.where(radius > 0, radius, 1.0) for column in columns)
    wx, wy, wz = weights * x, weights * y, weights * z
    xx, xy, xz = (wx * x).sum(dim=1), (wx * y).sum(dim=1), (wx * z).sum(dim=1)
    yy, yz, zz = (wy * y).sum(dim=1), (wy * z).sum(dim=1), (wz * z).sum(dim=1)
    ridge = _RIDGE * (xx + yy + zz)
    xx, yy, zz = xx + ridge, yy + ridge, zz + ridge
    # Cramer's rule for a symmetric positive definite 3x3 system.
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * a + xy * b + xz * c
    inverse = torch.where(determinant > 0, 1 / determinant, 0.0)
    mx, my, mz = wx.sum(dim=1), wy.sum(dim=1), wz.sum(dim=1)
    tilt_x = (a * mx + b * my + c * mz) * inverse
    tilt_y = (b * mx + d * my + e * mz) * inverse
    tilt_z = (c * mx + e * my + f * mz) * inverse
    tilt = x * tilt_x[:, None] + y * tilt_y[:, None] + z * tilt_z[:, None]
    return weights * (1 - tilt.clamp_(-_MAX_TILT, _MAX_TILT))
