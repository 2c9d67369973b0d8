"""Directions without sign: points of the Gaussian sphere on which opposite points are one."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.neighbors import canonical_order


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


_ROUNDING = 1e-12


class Spreads(NamedTuple):
    """How wide each cluster is.

    Attributes:
        means: Mean angle over all pairs of points of each cluster, radians, shape ``(M,)``.
        diameters: Largest angle within each cluster, radians, shape ``(M,)``.
        num_sampled: Clusters whose mean was taken over a subsample.
        exact_diameters: Whether no diameter was.
    """

    means: Tensor
    diameters: Tensor
    num_sampled: int
    exact_diameters: bool


def measure_spreads(
    parts: Sequence[Tensor],
    centers: Tensor,
    *,
    sample_size: int = 20_000,
    seed: int = 0,
    max_pairs: int = 2**17,
) -> Spreads:
    """Measure mean pairwise angle and diameter of each cluster.

    Args:
        parts: Unit vectors of each cluster, M tensors of shape ``(n, 3)``, n >= 1, float64.
        centers: Centre of each cluster, shape ``(M, 3)``.
        sample_size: Larger clusters, and larger sets of possible ends of a diameter, are
            subsampled to this size.
        seed: Seed of the subsamples.
        max_pairs: Angles in memory at a time; changes the result by rounding only.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> spreads = measure_spreads([axes[:1], axes[1:]], axes[:2])
        >>> spreads.means.rad2deg().round().tolist(), spreads.num_sampled
        ([0.0, 90.0], 0)
    """
    means, diameters, num_sampled, exact = [], [], 0, True
    for part, center in zip(parts, centers, strict=True):
        ends = rim(part, center)
        sampled = subsample(part, sample_size, seed), subsample(ends, sample_size, seed)
        means.append(mean_pairwise_angle(sampled[0], max_pairs=max_pairs))
        diameters.append(diameter(sampled[1], max_pairs=max_pairs))
        num_sampled += len(part) > sample_size
        exact = exact and len(ends) <= sample_size
    return Spreads(centers.new_tensor(means), centers.new_tensor(diameters), num_sampled, exact)


def mean_pairwise_angle(directions: Tensor, *, max_pairs: int = 2**17) -> float:
    r"""Return the mean angle over all pairs of directions, the intra term of eq. (14).

    Args:
        directions: Unit vectors, shape ``(N, 3)``, float64.
        max_pairs: Angles in memory at a time; changes the result by rounding only.

    Returns:
        Radians; 0 for fewer than two directions.

    Example:
        >>> round(mean_pairwise_angle(torch.eye(3, dtype=torch.float64)), 4)
        1.5708
    """
    count = len(directions)
    total = 0.0
    for block in _upper_blocks(directions, max_pairs):
        rows = len(block)
        # The square at the diagonal holds each of its pairs twice.
        total += float(block[:, rows:].sum() + block[:, :rows].sum() / 2)
    return 2 * total / (count * (count - 1)) if count > 1 else 0.0


def diameter(directions: Tensor, *, max_pairs: int = 2**17) -> float:
    """Return the largest angle between two directions, in radians; 0 for fewer than two.

    Args:
        directions: Unit vectors, shape ``(N, 3)``, float64.
        max_pairs: Angles in memory at a time; does not change the result.

    Example:
        >>> round(diameter(torch.eye(3, dtype=torch.float64)), 4)
        1.5708
    """
    return max((float(block.max()) for block in _upper_blocks(directions, max_pairs)), default=0.0)


def rim(directions: Tensor, center: Tensor) -> Tensor:
    r"""Return the directions that can be an end of the cluster's diameter.

    By the triangle inequality a pair at least as far apart as ``d`` has both ends at least
    ``d - r`` from the centre, with ``r`` the largest distance from it. ``d`` is a distance that
    occurs: from the farthest direction to the one farthest from that.

    Args:
        directions: Unit vectors, shape ``(N, 3)``, N >= 1, float64.
        center: Unit vector, shape ``(3,)``.

    Returns:
        A subset of the rows, with the same diameter.

    Example:
        >>> a = torch.linspace(-0.1, 0.1, 101, dtype=torch.float64)
        >>> arc = torch.stack([a.sin(), torch.zeros_like(a), a.cos()], dim=1)
        >>> len(rim(arc, arc[50]))
        2
    """
    radii = chord_to_angle(chords_between(directions, center))
    from_first = chord_to_angle(chords_between(directions, directions[radii.argmax()]))
    from_second = chord_to_angle(chords_between(directions, directions[from_first.argmax()]))
    reached = from_second.max() * (1 - _ROUNDING)
    return directions[radii >= reached - radii.max()]


def subsample(directions: Tensor, size: int, seed: int) -> Tensor:
    """Return a random subset of the directions that does not depend on their order.

    Args:
        directions: Unit vectors, shape ``(N, 3)``, float64.
        size: Number of directions to return; all of them if they are fewer.
        seed: Seed of the choice.

    Example:
        >>> len(subsample(torch.eye(3, dtype=torch.float64), 2, seed=0))
        2
    """
    if len(directions) <= size:
        return directions
    order = canonical_order(torch.where(directions[:, 2:] < 0, -directions, directions))
    chosen = torch.randperm(len(order), generator=torch.Generator().manual_seed(seed))[:size]
    return directions[order[chosen.to(order.device)]]


def _upper_blocks(directions: Tensor, max_pairs: int) -> Iterator[Tensor]:
    """Yield the angles of a block of directions to itself and to all later ones, ``(r, n)``."""
    count = len(directions)
    # Within 45 degrees of one of them no two are more than 90 degrees apart.
    aligned = bool(count) and float((directions @ directions[0]).min()) > 0.5**0.5
    start = 0
    while start < count:
        rows = max(1, max_pairs // (count - start))
        chords = chord_table(directions[start : start + rows], directions[start:], aligned=aligned)
        yield chord_to_angle(chords)
        start += rows


def merge_directions(
    centers: Tensor, *, max_angle_deg: float = 5.0, max_pairs: int = 2**17
) -> Tensor:
    """Number the groups of centres that are joined by steps of a small angle.

    Args:
        centers: Unit vectors, shape ``(M, 3)``, float64; opposite ones are one direction.
        max_angle_deg: Largest step, included.
        max_pairs: Chords in memory at a time; does not change the result.

    Returns:
        Group of each centre, 0, 1, ... in the order of their first members, shape ``(M,)``, int64.

    Example:
        >>> axes = torch.eye(3, dtype=torch.float64)
        >>> merge_directions(torch.stack([axes[0], axes[1], -axes[0]])).tolist()
        [0, 1, 0]
    """
    longest = 2 * math.sin(math.radians(max_angle_deg) / 2)
    groups = torch.full((len(centers),), -1, device=centers.device)
    group = 0
    while len(rest := (groups < 0).nonzero().squeeze(1)):
        frontier = rest[:1]
        while len(frontier):
            groups[frontier] = group
            rest = rest[groups[rest] < 0]
            near = torch.zeros_like(rest, dtype=torch.bool)
            for block in torch.split(frontier, max(1, max_pairs // max(1, len(rest)))):
                near |= (chord_table(centers[block], centers[rest]) <= longest).any(dim=0)
            frontier = rest[near]
        group += 1
    return groups
