"""Figure 5: which neighbours are coplanar and connective."""

from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib import pyplot as plt
from torch import Tensor

from reproduction.cells import Record
from reproduction.pictures import settings
from reproduction.runs import Run
from reproduction.sections import Block, figure, text
from torchrg import estimate_normals, load_config, search_knn
from torchrg.neighbors import gather_patches
from torchrg.regions.edges import coplanarity_limits, patch_radii, plane_residuals
from torchrg.regions.shared_neighbors import SharedNeighbors, min_shared_neighbors
from torchrg.structures import Neighbors

_SIDE = 15
"""Points along half the side of a square of points, one apart."""

_COLORS = {
    "coplanar and connective": "#2a7f3f",
    "coplanar, not connective": "#e39b3d",
    "connective, not coplanar": "#4878a8",
    "neither": "#c44e52",
}
"""Neighbours by what they are."""


class Case(NamedTuple):
    """A point and its neighbours, seen along one axis; all lengths are those of the points."""

    title: str
    axes: tuple[int, int]  # that are drawn
    cloud: Tensor  # all points about the point, (N, 3)
    patch: Tensor  # its neighbours, (K, 3)
    normal: Tensor  # (3,)
    coplanar: Tensor  # by eq. (11), (K,)
    connective: Tensor  # by eq. (10), (K,)
    limit: float  # largest distance of a coplanar neighbour


def make_figure5(run: Run) -> tuple[list[Block], Record]:
    """Make Figure 5; return it, and how many neighbours are what."""
    floor = _square(-_SIDE, 0)
    wall = _square(0, _SIDE)[:, [2, 1, 0]]
    raised = _square(0, _SIDE) + torch.tensor([0.0, 0.0, 1.5])
    beyond = _square(0, _SIDE) + torch.tensor([0.9, 0.0, 0.0])
    cases = [
        _test("an edge, from the side", torch.cat([floor, wall]), (0, 2)),
        _test("a step, from the side", torch.cat([floor, raised]), (0, 2)),
        _test("a gap, from above", torch.cat([floor, beyond]), (0, 1)),
    ]
    _draw(run.folder.place("figures/figure5.png"), cases)
    counts = {
        case.title: {
            "both": int((case.coplanar & case.connective).sum()),
            "coplanar": int(case.coplanar.sum()),
            "connective": int(case.connective.sum()),
        }
        for case in cases
    }
    listed = "; ".join(
        f"{title}: {n['coplanar']} coplanar, {n['connective']} connective, {n['both']} both"
        for title, n in counts.items()
    )
    k = load_config("paper").normals.k
    caption = (
        "**Figure 5**: the neighbours of a point (black ring) near an edge, a step and a gap, on "
        "made surfaces; gray: other points. The band is the limit of eq. (11)."
    )
    return [
        figure("figures/figure5.png", caption),
        text(
            "A neighbour is connective if it shares 75 % of its neighbours with the point "
            "(eq. 10), and coplanar if its distance to the plane of the point is at most "
            "median + 2 Qn of those of the neighbourhood (eq. 11). Normals are the paper's. Of "
            f"{k} neighbours: {listed}."
        ),
    ], counts


def _square(start: int, stop: int) -> Tensor:
    """Return points of a level surface, about one apart, with a little noise."""
    rng = torch.Generator().manual_seed(stop - start)
    places = torch.cartesian_prod(
        torch.arange(start, stop) + 0.5, torch.arange(-_SIDE, _SIDE) + 0.5, torch.zeros(1)
    )
    spread = torch.tensor([0.3, 0.3, 0.03])
    return places + spread * torch.randn(places.shape, generator=rng).clamp(-1.5, 1.5)


def _test(title: str, cloud: Tensor, axes: tuple[int, int]) -> Case:
    """Test the neighbours of the point on the floor that is nearest to two before the border."""
    settings_ = load_config("paper")
    neighbors = search_knn(cloud, settings_.normals.k)
    fit = estimate_normals(cloud, config=settings_.normals, neighbors=neighbors)
    row = int((cloud - torch.tensor([-2.0, 0.0, 0.0])).square().sum(dim=1).argmin())
    one = slice(row, row + 1)
    patches = gather_patches(cloud, neighbors.indices[one])
    residuals = plane_residuals(patches, fit.normals[one])
    floor = settings_.growing.coplanarity_floor * patch_radii(patches)
    limit = coplanarity_limits(residuals, floor)
    asked = torch.ones_like(residuals, dtype=torch.bool)
    least = min_shared_neighbors(settings_.growing.connectivity, settings_.normals.k)
    connective = SharedNeighbors(Neighbors(neighbors.indices), least).connected(one, asked)
    return Case(
        title,
        axes,
        cloud - cloud[row],
        patches[0],
        fit.normals[row],
        (residuals <= limit[:, None])[0],
        connective[0],
        float(limit),
    )


def _draw(path: Path, cases: list[Case]) -> None:
    """Draw each case in its two axes."""
    with settings():
        figure_, axes = plt.subplots(
            1, len(cases), figsize=(2.4 * len(cases), 2.6), layout="constrained"
        )
        for axis, case in zip(axes, cases, strict=True):
            _draw_case(axis, case)
        found = {}
        for axis in axes:
            handles, names = axis.get_legend_handles_labels()
            found |= dict(zip(names, handles, strict=True))
        figure_.legend(found.values(), found, loc="outside lower center", ncols=len(found))
        figure_.savefig(path)
        plt.close(figure_)


def _draw_case(axis: plt.Axes, case: Case) -> None:
    """Draw a point, its plane and its neighbours."""
    first, second = case.axes
    reach = float(patch_radii(case.patch[None])) * 1.3
    if second == 2:
        a, b = float(case.normal[first]), float(case.normal[second])
        ends = [-2 * reach, 2 * reach]
        heights = [-a / b * x for x in ends]
        width = case.limit / abs(b)
        band = ([y - width for y in heights], [y + width for y in heights])
        axis.fill_between(ends, *band, color="#e8efe8", linewidth=0)
        axis.plot(ends, heights, color="#999999", linewidth=0.6)
    axis.scatter(case.cloud[:, first], case.cloud[:, second], s=4, color="#bbbbbb", linewidths=0)
    good = (case.coplanar, case.connective)
    kinds = (good[0] & good[1], good[0] & ~good[1], ~good[0] & good[1], ~good[0] & ~good[1])
    for (name, color), mask in zip(_COLORS.items(), kinds, strict=True):
        found = case.patch[mask]
        if len(found) == 0:
            continue
        axis.scatter(found[:, first], found[:, second], s=12, color=color, linewidths=0, label=name)
    axis.scatter([0], [0], s=40, facecolors="none", edgecolors="black", linewidths=1.2)
    axis.set_title(case.title)
    axis.set_xlim(-reach, reach)
    axis.set_ylim(-reach, reach)
    axis.set_aspect("equal")
    axis.grid(visible=False)
    axis.set_xticks([])
    axis.set_yticks([])
