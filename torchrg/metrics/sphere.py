"""Directions without sign: points of the Gaussian sphere on which opposite points are one."""

from typing import NamedTuple

import torch
from torch import Tensor


class Centers(NamedTuple):
    """The centre of each cluster of directions, and the directions with their signs aligned.

    Attributes:
        centers: Unit vectors, shape ``(M, 3)``, float64.
        directions: The input with the sign that points to the centre's side, shape ``(N, 3)``.
    """

    centers: Tensor
    directions: Tensor


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Normalise vectors in float64.

    Args:
        vectors: Vectors of any length, shape ``(*, 3)``.

    Returns:
        Unit vectors ``(*, 3)``, float64, and which of them exist ``(*)``: a zero vector or one
        that is not finite has none, and is zero.

    Example:
        >>> unit, exists = unit_vectors(torch.tensor([[0.0, 3, 4], [0, 0, 0], [torch.nan, 0, 0]]))
        >>> unit[0].tolist(), exists.tolist()
        ([0.0, 0.6, 0.8], [True, False, False])
    """
    unit = vectors.double()
    size = unit.abs().amax(dim=-1, keepdim=True)
    exists = torch.isfinite(unit).all(dim=-1) & (size.squeeze(-1) > 0)
    # Dividing by the largest entry first keeps the squares of tiny and huge vectors in range.
    unit = torch.where(exists[..., None], unit / size, 0)
    length = unit.square().sum(dim=-1, keepdim=True).sqrt()
    return torch.where(exists[..., None], unit / length, 0), exists


def chord_table(a: Tensor, b: Tensor, *, aligned: bool = False) -> Tensor:
    r"""Return the chord between all directions of two sets, ``min(|a - b|, |a + b|)``.

    Args:
        a: Unit vectors, shape ``(A, 3)``, float64.
        b: Unit vectors, shape ``(B, 3)``, float64.
        aligned: Whether no angle between the vectors as given exceeds 90 degrees; saves half of
            the work.

    Returns:
        Lengths in [0, sqrt(2)], shape ``(A, B)``.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> chord_table(axes[:1], torch.cat([axes[1:], -axes[:1]])).square().round().tolist()
        [[2.0, 2.0, 0.0]]
    """
    # A matrix product would be faster, and turn equal directions into chords of 1e-8.
    direct = "donot_use_mm_for_euclid_dist"
    chords = torch.cdist(a, b, compute_mode=direct)
    return chords if aligned else torch.minimum(chords, torch.cdist(a, -b, compute_mode=direct))


def chord_to_angle(chords: Tensor) -> Tensor:
    r"""Return the angles of chords, in radians, in place: ``arccos |a . b|`` of eq. (17).

    Example:
        >>> chord_to_angle(torch.tensor([0.0, 1.0])).rad2deg().round().tolist()
        [0.0, 60.0]
    """
    return chords.div_(2).asin_().mul_(2)


def chords_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the chord between directions row by row, in [0, sqrt(2)]; as :func:`chord_table`.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> chords_between(axes, -axes).tolist()
        [0.0, 0.0, 0.0]
    """
    return torch.minimum((a - b).square().sum(dim=-1), (a + b).square().sum(dim=-1)).sqrt()


def find_centers(directions: Tensor, clusters: Tensor, num_clusters: int) -> Centers:
    r"""Return the normalised mean direction of each cluster (eq. 16), after aligning the signs.

    Normals have no sign, so each is first turned to the side of the cluster's principal axis, the
    direction that the sum of ``(n . axis)^2`` is largest for. The mean of the turned vectors
    cannot vanish.

    Convention:
        The sign of a centre makes its largest entry positive.

    Args:
        directions: Unit vectors, shape ``(N, 3)``, float64.
        clusters: Cluster of each, 0 to M-1, each with one direction at least, shape ``(N,)``.
        num_clusters: M.

    Returns:
        Centres and aligned directions.

    Example:
        >>> directions = torch.tensor([[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]], dtype=torch.float64)
        >>> find_centers(directions, torch.tensor([0, 0]), 1).centers.abs().tolist()
        [[0.0, 0.0, 1.0]]
    """
    columns = directions.unbind(dim=1)
    products = [
        torch.bincount(clusters, columns[min(i, j)] * columns[max(i, j)], num_clusters)
        for i in range(3)
        for j in range(3)
    ]
    axes = torch.linalg.eigh(torch.stack(products, dim=1).view(-1, 3, 3)).eigenvectors[..., 2]
    axes = _with_positive_largest(axes)
    opposite = (directions * axes[clusters]).sum(dim=1) < 0
    aligned = torch.where(opposite[:, None], -directions, directions)
    sums = [torch.bincount(clusters, column, num_clusters) for column in aligned.unbind(dim=1)]
    centers, _ = unit_vectors(torch.stack(sums, dim=1))
    return Centers(centers, aligned)


def _with_positive_largest(vectors: Tensor) -> Tensor:
    """Return the vectors with the sign that makes their largest entry positive."""
    largest = vectors.gather(-1, vectors.abs().argmax(dim=-1, keepdim=True))
    return torch.where(largest < 0, -vectors, vectors)
