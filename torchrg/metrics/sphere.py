"""Directions without sign: points of the Gaussian sphere on which opposite points are one.

Directions are unit vectors in float64; their distance is the chord ``min(|a - b|, |a + b|)``, or
its angle ``arccos |a . b|`` (eq. 17), which chords give without loss where it is small.
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchrg.neighbors import canonical_order

_MAX_PAIRS = 2**17
"""Distances that are computed at a time, about as many as stay in a cache."""

_ROUNDING = 1e-12
"""Relative error by which an angle may come out too large."""


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Normalise vectors ``(*, 3)`` in float64, and say which could be, ``(*)``.

    A zero vector, or one that is not finite, has no direction, and is zero.

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


def rows_at_once(length: int) -> int:
    """Return how many rows of distances of a length are in memory at a time."""
    return max(1, _MAX_PAIRS // max(1, length))


def chord_table(a: Tensor, b: Tensor, *, aligned: bool = False) -> Tensor:
    """Return the chord between all directions of two sets, shape ``(A, B)``, in [0, sqrt(2)].

    If they are ``aligned``, no two more than 90 degrees apart, that is half of the work.
    """
    # A matrix product would be faster, and turn equal directions into chords of 1e-8.
    direct = "donot_use_mm_for_euclid_dist"
    chords = torch.cdist(a, b, compute_mode=direct)
    return chords if aligned else torch.minimum(chords, torch.cdist(a, -b, compute_mode=direct))


def chords_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the chord between directions row by row, in [0, sqrt(2)]."""
    return torch.minimum((a - b).square().sum(dim=-1), (a + b).square().sum(dim=-1)).sqrt()


def chord_to_angle(chords: Tensor) -> Tensor:
    """Return the angles of chords, in radians, in place."""
    return chords.div_(2).asin_().mul_(2)


def find_centers(directions: Tensor, clusters: Tensor, num_clusters: int) -> tuple[Tensor, Tensor]:
    """Return the normalised mean direction of each cluster (eq. 16), after aligning the signs.

    Normals have no sign, so each is first turned to the side of the cluster's principal axis, the
    direction that the sum of ``(n . axis)^2`` is largest for. The mean of the turned vectors
    cannot vanish. The sign of a centre makes its largest entry positive. Each cluster of
    ``clusters`` ``(N,)``, 0 to M-1, has one direction at least. Centres are ``(M, 3)``; the turned
    directions ``(N, 3)`` are the second result.

    Example:
        >>> directions = torch.tensor([[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]], dtype=torch.float64)
        >>> find_centers(directions, torch.tensor([0, 0]), 1)[0].abs().tolist()
        [[0.0, 0.0, 1.0]]
    """
    columns = directions.unbind(dim=1)
    products = [
        torch.bincount(clusters, columns[min(i, j)] * columns[max(i, j)], num_clusters)
        for i in range(3)
        for j in range(3)
    ]
    axes = torch.linalg.eigh(torch.stack(products, dim=1).view(-1, 3, 3)).eigenvectors[..., 2]
    largest = axes.gather(-1, axes.abs().argmax(dim=-1, keepdim=True))
    axes = torch.where(largest < 0, -axes, axes)
    opposite = (directions * axes[clusters]).sum(dim=1) < 0
    aligned = torch.where(opposite[:, None], -directions, directions)
    sums = [torch.bincount(clusters, column, num_clusters) for column in aligned.unbind(dim=1)]
    centers, _ = unit_vectors(torch.stack(sums, dim=1))
    return centers, aligned


def merge_directions(centers: Tensor, *, max_angle_deg: float = 5.0) -> Tensor:
    """Number the groups of centres ``(M, 3)`` that are joined by steps of at most an angle.

    Groups are 0, 1, ... in the order of their first members, shape ``(M,)``, int64.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> merge_directions(torch.stack([axes[0], axes[1], -axes[0]])).tolist()
        [0, 1, 0]
    """
    longest = 2 * math.sin(math.radians(max_angle_deg) / 2)
    groups = torch.full((len(centers),), -1, device=centers.device)
    group = 0
    while len(free := (groups < 0).nonzero().squeeze(1)):
        newest = free[:1]
        while len(newest):
            groups[newest] = group
            free = free[groups[free] < 0]
            near = torch.zeros_like(free, dtype=torch.bool)
            for chunk in torch.split(newest, rows_at_once(len(free))):
                near |= (chord_table(centers[chunk], centers[free]) <= longest).any(dim=0)
            newest = free[near]
        group += 1
    return groups


def measure_spreads(
    parts: Sequence[Tensor], centers: Tensor, *, sample_size: int = 20_000, seed: int = 0
) -> tuple[Tensor, Tensor, int, bool]:
    """Return mean angle over all pairs, and diameter, of the directions of each cluster, ``(M,)``.

    Larger clusters, and larger sets of possible ends of a diameter, are subsampled to
    ``sample_size``; third and fourth are the clusters whose mean is of a subsample, and whether no
    diameter is.
    """
    means, diameters, num_sampled, exact = [], [], 0, True
    for directions, center in zip(parts, centers, strict=True):
        ends = _rim(directions, center)
        means.append(_mean_pairwise_angle(_subsample(directions, sample_size, seed)))
        angles = _upper_angles(_subsample(ends, sample_size, seed))
        diameters.append(max((float(block.max()) for block in angles), default=0.0))
        num_sampled += len(directions) > sample_size
        exact = exact and len(ends) <= sample_size
    return centers.new_tensor(means), centers.new_tensor(diameters), num_sampled, exact


def _mean_pairwise_angle(directions: Tensor) -> float:
    """Return the mean angle over all pairs of directions (eq. 14); 0 for fewer than two."""
    count, total = len(directions), 0.0
    for angles in _upper_angles(directions):
        rows = len(angles)
        # The square at the diagonal holds each of its pairs twice.
        total += float(angles[:, rows:].sum() + angles[:, :rows].sum() / 2)
    return 2 * total / (count * (count - 1)) if count > 1 else 0.0


def _upper_angles(directions: Tensor) -> Iterator[Tensor]:
    """Yield the angles of some directions to themselves and to all later ones, ``(r, n)``."""
    count = len(directions)
    # Within 45 degrees of one of them no two are more than 90 degrees apart.
    aligned = bool(count) and float((directions @ directions[0]).min()) > 0.5**0.5
    start = 0
    while start < count:
        rows = rows_at_once(count - start)
        chords = chord_table(directions[start : start + rows], directions[start:], aligned=aligned)
        yield chord_to_angle(chords)
        start += rows


def _rim(directions: Tensor, center: Tensor) -> Tensor:
    """Return the directions of a cluster that can be an end of its diameter.

    A pair at least as far apart as ``d`` has both ends at least ``d - r`` from the centre, with
    ``r`` the largest distance from it (triangle inequality). ``d`` is a distance that
    occurs: from the farthest direction to the one farthest from that.
    """
    radii = chord_to_angle(chords_between(directions, center))
    from_first = chord_to_angle(chords_between(directions, directions[radii.argmax()]))
    from_second = chord_to_angle(chords_between(directions, directions[from_first.argmax()]))
    reached = from_second.max() * (1 - _ROUNDING)
    return directions[radii >= reached - radii.max()]


def _subsample(directions: Tensor, size: int, seed: int) -> Tensor:
    """Return a random subset of at most a size that does not depend on the order."""
    if len(directions) <= size:
        return directions
    order = canonical_order(torch.where(directions[:, 2:] < 0, -directions, directions))
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(order), generator=generator, device="cpu")[:size]
    return directions[order[chosen.to(order.device)]]
