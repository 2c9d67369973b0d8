"""Algorithm 2 of the paper, line by line, for small clouds: the oracle of region growing.

With ``connectivity_scope="seed"`` it is the paper's text instead: connectivity decides about seeds
alone, and a point that joined without becoming one is looked at again by every later seed.

Written from the paper and independent of the library: plain Python numbers, lists and loops. Where
the paper leaves a choice, the argument has the name and the meaning of the library's setting.
"""

import math


def segment(
    points,
    normals,
    curvature,
    knn,
    *,
    valid=None,
    k=None,
    max_angle_deg=5.0,
    curvature_quantile=0.95,
    curvature_scope="cloud",
    seed_rule="increment",
    connectivity=0.75,
    connectivity_scope="region",
    coplanarity=True,
    coplanarity_scope="all",
    coplanarity_floor=0.005,
    plane_reach=None,
    residual_rms=None,
    min_size=50,
):
    """Return a label for each point; all arguments are lists, points in order of preference.

    ``k`` is the number of neighbors asked for where some lists are shorter.
    """
    num_points, k = len(points), k or len(knn[0])
    valid = [True] * num_points if valid is None else valid
    promotes_late = connectivity is not None and connectivity_scope == "seed"
    sigma_th = curvature_percentile(range(num_points), curvature, valid, curvature_quantile)
    available = {i for i in range(num_points) if valid[i]}
    regions = []

    def reach(i):
        radius = max(math.dist(points[i], points[j]) for j in knn[i])
        is_exact = residual_rms[i] <= coplanarity_floor * radius
        return math.inf if is_exact else plane_reach * residual_rms[i]

    while available:
        p_min = min(available, key=lambda i: (curvature[i], i))
        seeds, region = [p_min], [p_min]
        available.remove(p_min)
        for seed in seeds:
            neighbors = list(knn[seed])
            if curvature_scope == "neighborhood":
                sigma_th = curvature_percentile(neighbors, curvature, valid, curvature_quantile)
            connected = [
                connectivity is None or num_shared(knn, seed, j) >= connectivity * k
                for j in neighbors
            ]
            gamma = [residual(points, normals, seed, j) for j in neighbors]
            if not coplanarity or (plane_reach is not None and reach(seed) < math.inf):
                gamma_th = math.inf
            else:
                used = gamma
                if coplanarity_scope == "connected":
                    used = [g for g, c in zip(gamma, connected, strict=True) if c]
                radius = max(math.dist(points[seed], points[j]) for j in neighbors)
                gamma_th = median(used) + 2 * max(qn(used), coplanarity_floor * radius)
            for j, is_connected, gamma_j in zip(neighbors, connected, gamma, strict=True):
                may_be_promoted = promotes_late and j in region and j not in seeds
                if j not in available and not may_be_promoted:
                    continue
                if connectivity_scope == "region" and not is_connected:
                    continue
                if plane_reach is not None and (
                    gamma_j > reach(seed) or residual(points, normals, j, seed) > reach(j)
                ):
                    continue
                if gamma_j <= gamma_th and angle_deg(normals[seed], normals[j]) <= max_angle_deg:
                    if j in available:
                        region.append(j)
                        available.remove(j)
                    if connectivity_scope == "seed" and not is_connected:
                        continue
                    if seed_rule == "curvature" and curvature[j] <= sigma_th:
                        seeds.append(j)
                    if seed_rule == "increment" and abs(curvature[j] - curvature[seed]) <= sigma_th:
                        seeds.append(j)
        regions.append(region)
    regions.sort(key=lambda region: (-len(region), min(region)))
    labels = [-1] * num_points
    for label, region in enumerate(r for r in regions if len(r) >= min_size):
        for i in region:
            labels[i] = label
    return labels


def curvature_percentile(rows, curvature, valid, quantile):
    ascending = sorted(curvature[i] for i in rows if valid[i])
    return ascending[int(quantile * (len(ascending) - 1))] if ascending else 0.0


def num_shared(knn, i, j):
    return len(set(knn[i]) & set(knn[j]))


def angle_deg(a, b):
    cosine = abs(sum(x * y for x, y in zip(a, b, strict=True)))
    return math.degrees(math.acos(min(1.0, cosine)))


def residual(points, normals, i, j):
    return abs(sum((points[j][c] - points[i][c]) * normals[i][c] for c in range(3)))


def median(values):
    ordered = sorted(values)
    middle = len(ordered) // 2
    if len(ordered) % 2:
        return ordered[middle]
    return (ordered[middle - 1] + ordered[middle]) / 2


def qn(values):
    n = len(values)
    if n < 2:
        return 0.0
    h = n // 2 + 1
    differences = sorted(abs(values[i] - values[j]) for i in range(n) for j in range(i))
    return 2.2219 * differences[h * (h - 1) // 2 - 1]
