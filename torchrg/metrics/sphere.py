"""Unsigned directions: points of the Gaussian sphere with opposite points identified.

Directions are unit vectors in float64. Their distance is the chord ``min(|a - b|, |a + b|)``, or
its angle ``arccos |a . b|`` (eq. 17), which chords give accurately even if small.
"""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchrg.neighbors import canonical_order

_MAX_PAIRS = 2**17
"""Number of distances computed at a time; about the size of a cache."""
_ROUNDING = 1e-12
"""Maximum relative error by which an angle may be too large."""


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Normalize vectors ``(*, 3)`` in float64; return also the mask ``(*)`` of valid ones.

    Zero and non-finite vectors have no direction and become zero.
    """
    unit = vectors.double()
    size = unit.abs().amax(dim=-1, keepdim=True)
    exists = torch.isfinite(unit).all(dim=-1) & (size.squeeze(-1) > 0)
    # Dividing by the largest entry first keeps the squares of tiny and huge vectors in range.
    unit = torch.where(exists[..., None], unit / size, 0)
    length = unit.square().sum(dim=-1, keepdim=True).sqrt()
    return torch.where(exists[..., None], unit / length, 0), exists


def chunk_rows(length: int) -> int:
    """Return how many rows of distances of this length to compute at a time."""
    return max(1, _MAX_PAIRS // max(1, length))


def chord_table(a: Tensor, b: Tensor, *, aligned: bool = False) -> Tensor:
    """Return the chords between all directions of two sets, shape ``(A, B)``, in [0, sqrt(2)].

    ``aligned`` sets, with all angles at most 90 degrees, take half of the time.
    """
    # A matrix product would be faster, but turn equal directions into chords of 1e-8.
    direct = "donot_use_mm_for_euclid_dist"
    chords = torch.cdist(a, b, compute_mode=direct)
    return chords if aligned else torch.minimum(chords, torch.cdist(a, -b, compute_mode=direct))


def chords_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the chords between directions row by row, in [0, sqrt(2)]."""
    return torch.minimum((a - b).square().sum(dim=-1), (a + b).square().sum(dim=-1)).sqrt()


def chord_to_angle(chords: Tensor) -> Tensor:
    """Convert chords to angles in radians, in place."""
    return chords.div_(2).asin_().mul_(2)


def find_centers(directions: Tensor, clusters: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normalized mean direction of each cluster (eq. 16), after aligning the signs.

    Normals have no sign, so each is first flipped to the side of the cluster's principal axis,
    which maximizes the sum of ``(n . axis)^2``. The mean of the aligned vectors cannot vanish. The
    largest entry of a center is positive. Clusters ``(N,)`` are 0 to M-1, none empty. Returns
    centers ``(M, 3)`` and aligned directions ``(N, 3)``.
    """
    columns = directions.unbind(dim=1)
    products = [
        torch.bincount(clusters, columns[min(i, j)] * columns[max(i, j)])
        for i in range(3)
        for j in range(3)
    ]
    axes = torch.linalg.eigh(torch.stack(products, dim=1).view(-1, 3, 3)).eigenvectors[..., 2]
    largest = axes.gather(-1, axes.abs().argmax(dim=-1, keepdim=True))
    axes = torch.where(largest < 0, -axes, axes)
    opposite = (directions * axes[clusters]).sum(dim=1) < 0
    aligned = torch.where(opposite[:, None], -directions, directions)
    sums = [torch.bincount(clusters, column) for column in aligned.unbind(dim=1)]
    centers, _ = unit_vectors(torch.stack(sums, dim=1))
    return centers, aligned


def merge_directions(centers: Tensor, *, max_angle_deg: float = 5.0) -> Tensor:
    """Group centers ``(M, 3)`` connected by steps of at most an angle.

    Groups are numbered by their first members, shape ``(M,)``, int64.
    """
    max_chord = 2 * math.sin(math.radians(max_angle_deg) / 2)
    groups = torch.full((len(centers),), -1, device=centers.device)
    group = 0
    while len(free := (groups < 0).nonzero().squeeze(1)):
        newest = free[:1]
        while len(newest):
            groups[newest] = group
            free = free[groups[free] < 0]
            near = torch.zeros_like(free, dtype=torch.bool)
            for chunk in torch.split(newest, chunk_rows(len(free))):
                near |= (chord_table(centers[chunk], centers[free]) <= max_chord).any(dim=0)
            newest = free[near]
        group += 1
    return groups


def measure_spreads(
    parts: Sequence[Tensor], centers: Tensor, *, sample_size: int = 20_000, seed: int = 0
) -> tuple[Tensor, Tensor, int, bool]:
    """Return mean pairwise angle and diameter of the directions of each cluster, ``(M,)``.

    Larger clusters, and larger sets of diameter end points, are subsampled to ``sample_size``. Also
    returns the number of clusters with a subsampled mean, and whether all diameters are exact.
    """
    means, diameters, num_sampled, exact = [], [], 0, True
    for directions, center in zip(parts, centers, strict=True):
        ends = _diameter_candidates(directions, center)
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
        # The diagonal block contains each of its pairs twice.
        total += float(angles[:, rows:].sum() + angles[:, :rows].sum() / 2)
    return 2 * total / (count * (count - 1)) if count > 1 else 0.0


def _upper_angles(directions: Tensor) -> Iterator[Tensor]:
    """Yield the angles of blocks of directions to themselves and all later ones, ``(r, n)``."""
    count = len(directions)
    # Directions within 45 degrees of one direction are at most 90 degrees apart.
    aligned = bool(count) and float((directions @ directions[0]).min()) > 0.5**0.5
    start = 0
    while start < count:
        rows = chunk_rows(count - start)
        chords = chord_table(directions[start : start + rows], directions[start:], aligned=aligned)
        yield chord_to_angle(chords)
        start += rows


def _diameter_candidates(directions: Tensor, center: Tensor) -> Tensor:
    """Return the directions of a cluster that can be an end of its diameter.

    A pair at distance ``d`` or more has both ends at least ``d - r`` from the center, where ``r``
    is the radius of the cluster (triangle inequality). ``d`` is an existing distance: from the
    farthest direction to the one farthest from it.
    """
    radii = chord_to_angle(chords_between(directions, center))
    from_first = chord_to_angle(chords_between(directions, directions[radii.argmax()]))
    from_second = chord_to_angle(chords_between(directions, directions[from_first.argmax()]))
    attained = from_second.max() * (1 - _ROUNDING)
    return directions[radii >= attained - radii.max()]


def _subsample(directions: Tensor, size: int, seed: int) -> Tensor:
    """Return a random subset of at most ``size``, independent of the order."""
    if len(directions) <= size:
        return directions
    order = canonical_order(torch.where(directions[:, 2:] < 0, -directions, directions))
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(len(order), generator=generator, device="cpu")[:size]
    return directions[order[chosen.to(order.device)]]
