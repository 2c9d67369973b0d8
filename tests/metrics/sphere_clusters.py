"""Clusters of directions for tests, and the internal indices by loops over all pairs."""

import math

import torch


def scattered(rng, sizes, spread, *, axes=None):
    """Unit vectors about one axis a cluster, with random signs, and the cluster of each."""
    if axes is None:
        axes = torch.randn(len(sizes), 3, generator=rng, dtype=torch.float64)
    axes = torch.nn.functional.normalize(axes.double(), dim=1)
    labels = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    noise = torch.randn(len(labels), 3, generator=rng, dtype=torch.float64)
    directions = torch.nn.functional.normalize(axes[labels] + spread * noise, dim=1)
    signs = torch.randint(0, 2, (len(labels), 1), generator=rng) * 2 - 1
    return directions * signs, labels


def distance(a, b):
    """Eq. (17)."""
    return math.acos(min(1.0, abs(sum(x * y for x, y in zip(a, b, strict=True)))))


def center(cluster):
    """Eq. (16), signs aligned with the direction that all others are closest to on the whole."""
    axis = torch.linalg.svd(torch.tensor(cluster))[2][0].tolist()
    turned = [
        [x if sum(p * q for p, q in zip(v, axis, strict=True)) >= 0 else -x for x in v]
        for v in cluster
    ]
    mean = [sum(column) / len(column) for column in zip(*turned, strict=True)]
    length = math.hypot(*mean)
    return [x / length for x in mean]


def indices_by_loops(directions, labels):
    """Equations (12) to (15), as they are printed."""
    clusters = [directions[labels == i].tolist() for i in labels.unique().tolist()]
    k, centers = len(clusters), [center(cluster) for cluster in clusters]
    cp = sum(
        sum(distance(x, w) for x in cluster) / len(cluster)
        for cluster, w in zip(clusters, centers, strict=True)
    )
    apart = [[distance(v, w) for w in centers] for v in centers]
    within = [
        [distance(x, y) for i, x in enumerate(cluster) for y in cluster[i + 1 :]]
        for cluster in clusters
    ]
    spread = [sum(ds) / len(ds) if ds else 0.0 for ds in within]
    between = [
        distance(x, y)
        for m in range(k)
        for n in range(m + 1, k)
        for x in clusters[m]
        for y in clusters[n]
    ]
    return {
        "cp": cp / k,
        "sp": 2 / (k * k - k) * sum(apart[i][j] for i in range(k) for j in range(i + 1, k)),
        "dbi": sum(
            max((spread[i] + spread[j]) / apart[i][j] for j in range(k) if j != i) for i in range(k)
        )
        / k,
        "dvi": min(between) / max(max(ds, default=0.0) for ds in within),
    }
