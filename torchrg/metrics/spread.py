"""How far the directions of one cluster are from each other."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.metrics.sphere import chord_table, chord_to_angle, chords_between
from torchrg.neighbors import canonical_order

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
