"""A palette for planes, and the choice of well separated colours from it."""

import math

import numpy as np
import torch
from torch import Tensor

from torchrg.report.oklab import oklab_to_rgb, rgb_to_oklab, to_bytes

UNLABELED_GRAY = 176
"""Red, green and blue of points that belong to no plane."""

_CALM = ((0.78, 0.88), (0.07, 0.095), 24)  # lightness, chroma, number of hues
_VIVID = ((0.62, 0.70, 0.78), (0.13, 0.165), 36)
_LARGE = 0.03  # share of all: planes that get a calm colour
_ALIKE = 0.0005  # squared OKLab distance of colours that look about the same
_ELSEWHERE = 0.005  # how much a plane that is not next to another one counts for it


def make_palette() -> tuple[Tensor, int]:
    """Return sRGB colours of even hues, shape ``(C, 3)``, uint8, and how many of them are calm.

    Example:
        >>> colors, num_calm = make_palette()
        >>> len(colors) > 150, 0 < num_calm < len(colors)
        (True, True)
    """
    groups = []
    for lightness, chroma, num_hues in (_CALM, _VIVID):
        hues = torch.arange(num_hues, dtype=torch.float64) * (2 * math.pi / num_hues)
        light, strength, hue = torch.meshgrid(
            torch.tensor(lightness, dtype=torch.float64),
            torch.tensor(chroma, dtype=torch.float64),
            hues,
            indexing="ij",
        )
        lab = torch.stack([light, strength * hue.cos(), strength * hue.sin()], dim=-1)
        colors = oklab_to_rgb(lab.view(-1, 3))
        groups.append(colors[((colors >= 0) & (colors <= 1)).all(dim=-1)])
    return to_bytes(torch.cat(groups)), len(groups[0])


def choose_colors(
    sizes: Tensor, pairs: Tensor, weights: Tensor, *, fixed: Tensor | None = None
) -> Tensor:
    """Choose a colour for each plane, the largest first, far from those chosen before.

    Each chosen colour repels with the inverse square of its distance in OKLab: that of a neighbour
    with its weight, any other with a little.

    Args:
        sizes: Points of each plane, shape ``(M,)``.
        pairs: Planes that are neighbours, shape ``(E, 2)``.
        weights: How much they are, shape ``(E,)``.
        fixed: Rows of the palette that are chosen already, shape ``(M,)``; negative: free.

    Returns:
        Rows of :func:`make_palette`, shape ``(M,)``, int64.

    Example:
        >>> choices = choose_colors(torch.tensor([5, 4]), torch.tensor([[0, 1]]), torch.ones(1))
        >>> len(choices.unique())
        2
    """
    palette, num_calm = make_palette()
    gray = palette.new_full((1, 3), UNLABELED_GRAY)
    lab = rgb_to_oklab(torch.cat([palette, gray]).double() / 255)
    distances = (lab[:, None] - lab).square().sum(dim=-1)
    repulsion = (1 / (distances + _ALIKE)).numpy()[:, :-1]
    share = (sizes / sizes.sum()).numpy()
    strength = np.clip(8 * share, _ELSEWHERE, 1)
    choices = torch.full_like(sizes, -1).numpy() if fixed is None else fixed.numpy().copy()
    done = choices >= 0
    field = strength[done] @ repulsion[choices[done]] + 0.05 * repulsion[-1]
    ends = torch.cat([pairs, pairs.flip(1)])
    order = ends[:, 0].argsort(stable=True)
    starts = torch.searchsorted(ends[order, 0], torch.arange(len(sizes) + 1)).tolist()
    others, pull = ends[order, 1].numpy(), weights.repeat(2)[order].numpy()
    for plane in sizes.sort(descending=True, stable=True).indices.tolist():
        if done[plane]:
            continue
        near = slice(starts[plane], starts[plane + 1])
        placed = choices[others[near]]
        cost = field + (pull[near] * (placed >= 0)) @ repulsion[placed]
        calm = share[plane] > _LARGE
        pick = cost[:num_calm].argmin() if calm else num_calm + cost[num_calm:].argmin()
        choices[plane] = pick
        field += strength[plane] * repulsion[pick]
    return torch.from_numpy(choices)
