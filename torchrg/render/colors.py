"""Perceptually distinct colors for planes, normals, curvature and sharp points."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg.errors import ShapeError
from torchrg.linalg.angles import unit_direction
from torchrg.metrics.contingency import check_labels, contingency_table, number_labels
from torchrg.metrics.labels import match_regions
from torchrg.neighbors import search_knn
from torchrg.neighbors.voxels import sample_voxels
from torchrg.regions.adjacency import NUM_CONTACTS, KnnAdjacency
from torchrg.regions.directions import horizontal_toward, unit_axis
from torchrg.render.surface import sample_rows
from torchrg.structures import AnyCloud
from torchrg.structures.points import Array, Labels, Points, Values


def rgb_to_lab(colors: Tensor) -> Tensor:
    """Convert sRGB in [0, 1], shape ``(*, 3)``, to CIE Lab, where distances are perceptual."""
    from kornia.color import rgb_to_lab as of_image

    lab: Tensor = of_image(_as_image(colors))[0, :, :, 0].T.reshape(colors.shape)
    return lab


def _lab_to_rgb(colors: Tensor) -> Tensor:
    """Convert CIE Lab to the nearest sRGB, uint8."""
    from kornia.color import lab_to_rgb as of_image

    rgb: Tensor = of_image(_as_image(colors))[0, :, :, 0].T.reshape(colors.shape)
    return (rgb * 255).round().to(torch.uint8)


def _as_image(colors: Tensor) -> Tensor:
    """Reshape colors ``(*, 3)`` to an image of one column ``(1, 3, N, 1)``."""
    return colors.reshape(-1, 3).T[None, :, :, None]


UNLABELED_GRAY = 176
"""Red, green and blue of unlabeled points."""
_CALM = (
    "ffaab2 ffad91 efb76e c7c56c 97d083 5dd6a9 0bd7d5 05d3f7 7dc9ff aebefe e0aefe ffa6d6 "
    "e682a2 e7857d d69160 b89e54 91a95d 63b179 19b49f 08b1c0 02adde 64a4eb a497e2 cf89c7"
)
"""Colors of large planes: 24 hues of chroma up to 46 in CIE Lab, lightness 78 and 66."""
_VIVID = (
    "c52f53 b74622 936001 6b6f00 277b16 057959 047776 03758a 0072a2 1368cf 8c4fb4 b93487 "
    "ef4f8e ee5955 d37222 a68901 6d9914 05a053 029d8a 049aa7 0497c1 0391e8 887cf0 d061c6 "
    "ff909d ff946f e7a33e b4b63a 74c35c 04c894 0ec4c3 0ec1e2 3ebbff 95aeff d796ff ff8acb"
)
"""Colors of small planes, more visible: 24 hues of chroma up to 66, lightness 45, 58 and 72."""
_MIN_LARGE_FRACTION = 0.03
"""Minimum fraction of all points in a large plane."""
_SIMILAR = 60.0
"""Squared distance in CIE Lab of two colors that look about the same."""
_LIGHTNESS_WEIGHT = 0.1
"""Weight of squared differences in lightness, since two shades of one hue look like one plane under
different light."""
_DICHROMACY_WEIGHT = 0.5
"""Weight of color vision deficiency. With less, adjacent planes look the same to color-blind
viewers; with more, to all other viewers."""
_DICHROMACY_AXES = ((0.0, 1.0), (1.07, 0.56))
"""Directions in the a-b plane of CIE Lab visible without one kind of cones: blue-yellow without the
long or middle ones, red-cyan without the short ones. Fitted to the palette under the model of
Machado et al., A physiologically-based model for simulation of color vision deficiency, 2009."""
_MIN_WEIGHT = 0.005
"""Minimum weight of a plane that is not adjacent; adjacent planes have weight 1."""
_GRAY_WEIGHT = 0.05
"""Weight of the gray of unlabeled points, which occur nearly everywhere."""
PALETTE = torch.tensor([list(bytes.fromhex(row)) for row in f"{_CALM} {_VIVID}".split()]).byte()
"""Colors of planes, calm ones first, shape ``(60, 3)``, uint8."""


def _similarity() -> Tensor:
    """Return the similarity of palette colors to each other and to gray, ``(60, 61)``.

    Combines normal color vision with the weighted worst dichromacy.
    """
    gray = PALETTE.new_full((1, 3), UNLABELED_GRAY)
    labs = rgb_to_lab(torch.cat([PALETTE, gray]).double() / 255)
    light, a, b = (labs[: len(PALETTE), None] - labs).unbind(dim=2)
    worst = torch.stack([(a * x + b * y).square() for x, y in _DICHROMACY_AXES]).amin(dim=0)
    trichromatic, worst = _LIGHTNESS_WEIGHT * light**2 + a**2 + b**2, light**2 + worst
    return 1 / (trichromatic + _SIMILAR) + _DICHROMACY_WEIGHT / (worst + _SIMILAR)


def choose_colors(
    sizes: Tensor, pairs: Tensor, weights: Tensor, *, fixed: Tensor | None = None
) -> Tensor:
    """Choose a palette row for each plane greedily, the largest plane first.

    Each chosen color repels later ones with the inverse square of its distance in Lab: the color of
    an adjacent plane, in ``pairs`` ``(E, 2)``, with its weight, others weakly. ``fixed`` ones stay.
    """
    repulsion = _similarity().T
    fraction = sizes / sizes.sum()
    strength = (8 * fraction).clamp(_MIN_WEIGHT, 1).double()
    choices = torch.full_like(sizes, -1) if fixed is None else fixed.to(sizes, copy=True)
    done = choices >= 0
    field = strength[done] @ repulsion[choices[done]] + _GRAY_WEIGHT * repulsion[-1]
    ends = torch.cat([pairs, pairs.flip(1)])
    order = ends[:, 0].argsort(stable=True)
    others, pull = ends[order, 1], weights.double().repeat(2)[order]
    starts = torch.searchsorted(ends[order, 0], torch.arange(len(sizes) + 1)).tolist()
    num_calm = len(_CALM.split())
    for plane in sizes.sort(descending=True, stable=True).indices.tolist():
        if done[plane]:
            continue
        near = slice(starts[plane], starts[plane + 1])
        placed = choices[others[near]]
        cost = field + (pull[near] * (placed >= 0)) @ repulsion[placed]
        calm = bool(fraction[plane] > _MIN_LARGE_FRACTION)
        pick = cost[:num_calm].argmin() if calm else num_calm + cost[num_calm:].argmin()
        choices[plane] = pick
        field += strength[plane] * repulsion[pick]
    return choices


_HORIZONTAL_LIGHTNESS, _UPRIGHT_LIGHTNESS = 84.0, 60.5
"""Lightness in CIE Lab of horizontal and vertical surfaces: floors are lighter than walls."""
_CHROMA = 42.0
"""Chroma in CIE Lab of vertical surfaces, which distinguishes their hues."""
_RAMP = (
    (88.4, 0.0, 0.0),
    (84.6, 6.8, 41.2),
    (68.1, 39.9, 53.7),
    (45.1, 60.6, 25.3),
    (19.0, 44.1, -21.7),
)
"""Curvature scale in CIE Lab: light gray, yellow, orange, red, violet, with decreasing lightness,
so that it also works in print."""
MAX_CURVATURE = 0.1
"""Curvature at the end of the color scale."""
_REGULAR, _SHARP = (205, 205, 205), (214, 40, 40)
"""Red, green and blue of regular points (light gray) and of sharp ones (red)."""


def color_normals(normals: Points, *, up: Sequence[float] | str = "z") -> Tensor:
    """Color normals by direction; opposite normals get the same color.

    Horizontal surfaces are light gray. Vertical surfaces are colored by the direction they face,
    with perpendicular walls in opposite hues. Slanted surfaces are in between.

    Args:
        normals: Unit normals of arbitrary sign, shape ``(*, 3)``; zero if unknown.
        up: Up direction: three numbers, or the name of an axis.

    Returns:
        Shape ``(*, 3)``, uint8; gray for unknown normals.

    Raises:
        ShapeError: If the shape or dtype is invalid.
        ConfigError: If ``up`` is zero.

    Example:
        >>> color_normals(torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, 0, 0]]))[:, 0].tolist()
        [209, 209, 176]
    """
    tensor = as_tensor("color_normals", "normals", normals)
    check_shapes("color_normals", normals=(tensor, "* 3"))
    check_floating("color_normals", normals=tensor)
    axis = unit_direction("color_normals", up).to(tensor)
    east = horizontal_toward(unit_axis(axis), axis)
    x, y, z = (tensor @ side for side in (east, torch.linalg.cross(axis, east), axis))
    lightness = _UPRIGHT_LIGHTNESS + (_HORIZONTAL_LIGHTNESS - _UPRIGHT_LIGHTNESS) * z * z
    lab = torch.stack([lightness, _CHROMA * (x * x - y * y), 2 * _CHROMA * x * y], dim=-1)
    missing = (tensor == 0).all(dim=-1, keepdim=True)
    gray = torch.tensor(UNLABELED_GRAY, dtype=torch.uint8, device=tensor.device)
    return torch.where(missing, gray, _lab_to_rgb(lab))


def color_curvature(curvature: Values) -> Tensor:
    """Color curvature from light gray through yellow and red to dark violet.

    The scale is proportional to the square root of the curvature, ends at 0.1, and is the same for
    every cloud.

    Args:
        curvature: Surface variation in [0, 1/3], shape ``(*)``.

    Returns:
        Shape ``(*, 3)``, uint8.

    Raises:
        ShapeError: If the dtype is invalid.

    Example:
        >>> color_curvature(torch.tensor([0.0, 0.1, 0.3])).tolist()
        [[222, 222, 222], [90, 0, 78], [90, 0, 78]]
    """
    tensor = as_tensor("color_curvature", "curvature", curvature)
    check_floating("color_curvature", curvature=tensor)
    position = (tensor / MAX_CURVATURE).clamp(0, 1).sqrt().nan_to_num() * (len(_RAMP) - 1)
    before = position.long().clamp(max=len(_RAMP) - 2)
    ramp = tensor.new_tensor(_RAMP)
    lab = torch.lerp(ramp[before], ramp[before + 1], (position - before)[..., None])
    return _lab_to_rgb(lab)


def color_sharp(sharp: Tensor | Array) -> Tensor:
    """Color sharp feature points red and all others light gray.

    Args:
        sharp: Shape ``(*)``, bool.

    Returns:
        Shape ``(*, 3)``, uint8.

    Raises:
        ShapeError: If ``sharp`` is not bool.

    Example:
        >>> color_sharp(torch.tensor([False, True])).tolist()
        [[205, 205, 205], [214, 40, 40]]
    """
    tensor = as_tensor("color_sharp", "sharp", sharp)
    if tensor.dtype != torch.bool:
        dtype = str(tensor.dtype).removeprefix("torch.")
        raise ShapeError(f"color_sharp: expected sharp of bool, got {dtype}.")
    colors = torch.tensor([_REGULAR, _SHARP], dtype=torch.uint8, device=tensor.device)
    return colors[tensor.long()]


_NEIGHBORHOODS = ((256, 1.0), (48, 0.2))
"""Number of voxels along the longest side of the cloud, and weight of planes in adjacent voxels."""


def color_planes(
    labels: Labels,
    points: AnyCloud | None = None,
    *,
    reference: Labels | None = None,
) -> Tensor:
    """Color the points of each plane.

    Planes are colored greedily, the largest first: each gets the color of a fixed palette that is
    most distinct from adjacent planes and, with less weight, from all others. Large planes get calm
    colors, small ones vivid colors.

    Convention:
        The colors do not depend on the order of the points.

    Args:
        labels: Plane of each point, shape ``(*)``, integers; ``UNLABELED`` for none.
        points: Points, shape ``(*, 3)``, which define adjacency. Default: no adjacency.
        reference: Other labels of the same points, shape ``(*)``. A plane of ``labels`` and one of
            ``reference`` that are each other's largest overlap share the color of
            ``color_planes(reference, points)``. For images side by side.

    Returns:
        Shape ``(*, 3)``, uint8; unlabeled points are gray.

    Raises:
        ShapeError: If a shape or dtype is invalid.

    Example:
        >>> colors = color_planes(torch.tensor([0, 0, 1, -1]))
        >>> colors[3].tolist(), bool((colors[0] == colors[1]).all())
        ([176, 176, 176], True)
    """
    caller = "color_planes"
    tensor = as_tensor(caller, "labels", labels)
    other = None if reference is None else as_tensor(caller, "reference", reference)
    cloud = None if points is None else as_tensor(caller, "points", points)
    check_shapes(caller, labels=(tensor, "*"), points=(cloud, "* 3"), reference=(other, "*"))
    check_floating(caller, points=cloud)
    flat = check_labels(caller, labels=tensor.flatten())[0]
    same = None if other is None else check_labels(caller, reference=other.flatten())[0]
    cloud = None if cloud is None else cloud.detach().reshape(-1, 3)
    rows, colors = palette_of_planes(flat, cloud, reference=same)
    return colors[rows].view(*tensor.shape, 3)


def palette_of_planes(
    labels: Tensor, points: Tensor | None, *, reference: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return each point's palette row ``(N,)``, and the palette ``(M + 1, 3)``, uint8.

    Palette rows are the existing labels, ascending, and gray, also for row -1. The arguments are
    those of :func:`color_planes`, with one axis.
    """
    fixed = None
    if reference is not None:
        table = contingency_table(labels, reference)
        pairs = match_regions(table)
        fixed = torch.full_like(table.region_sizes, -1)
        chosen = _choose(reference, points)[1]
        fixed[table.regions[pairs]] = chosen[table.faces[pairs]]
    rows, choices = _choose(labels, points, fixed)
    gray = torch.full((1, 3), UNLABELED_GRAY, dtype=torch.uint8, device=labels.device)
    return rows, torch.cat([PALETTE.to(labels.device)[choices], gray])


def _choose(
    labels: Tensor, points: Tensor | None, fixed: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return each point's index among the existing labels, and the palette row of each label."""
    rows = number_labels(labels)[1]
    num_planes = int(rows.max()) + 1 if len(rows) else 0
    chosen = torch.arange(len(rows), device=rows.device) if points is None else sample_rows(points)
    chosen = chosen[rows[chosen] >= 0]
    sample = rows[chosen]
    sizes = torch.bincount(sample, minlength=num_planes)
    pairs, weights = [sizes.new_zeros((0, 2))], [torch.zeros(0, dtype=torch.float64)]
    if points is not None:
        for num_voxels, weight in _NEIGHBORHOODS:
            pairs.append(_adjacent_planes(points[chosen], sample, num_voxels))
            weights.append(torch.full((len(pairs[-1]),), weight, dtype=torch.float64))
    choices = choose_colors(sizes.cpu(), torch.cat(pairs).cpu(), torch.cat(weights), fixed=fixed)
    return rows, choices.to(labels.device)


def _adjacent_planes(points: Tensor, labels: Tensor, num_voxels: int) -> Tensor:
    """Return the pairs of planes in adjacent voxels, shape ``(E, 2)``."""
    extent = float((points.amax(dim=0) - points.amin(dim=0)).amax()) if len(points) else 0.0
    if extent == 0:
        return labels.new_zeros((0, 2))
    sample = sample_voxels(points, extent / num_voxels).rows
    neighbors = search_knn(points[sample], min(NUM_CONTACTS + 1, len(sample)))
    return KnnAdjacency(neighbors).contacts(labels[sample])[0]
