"""Figures 1, 2, 5 and 6: the method and its indices."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib import pyplot as plt
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

from reproduction.clouds import Run
from reproduction.pictures import settings
from reproduction.records import Block, Record, figure, section, text
from tests.made import make_shape
from torchrg import estimate_normals, load_config, search_knn
from torchrg.linalg.moments import project, unbind_columns
from torchrg.neighbors.knn import gather_columns
from torchrg.regions.edges import coplanarity_limits, patch_radii
from torchrg.regions.shared_neighbors import connected_neighbors, min_shared_neighbors
from torchrg.structures import Neighbors

FRAMEWORK = (
    "**Figure 1**, the framework as implemented. Normals: PCA of the k nearest neighbors gives "
    "initial normals. Points whose Qn of the angles to their neighbors is above 5° are sharp; "
    "they get DetMCD and PCA of its inliers. Region growing: the curvature limit is the 95th "
    "percentile, and the seed is the point of minimum curvature. Coplanar neighbors within the "
    "angle join the region. Neighbors that are also connective, with a curvature increment within "
    "the limit, become seeds."
)
SCALES = (1.0, 10.0, 100.0)
"""Values of mu in Figure 2."""

_VIEW = (0.43, -0.75, 0.5)
"""Default view direction of matplotlib in 3-D."""

_FACE_COLORS = ("#c44e52", "#4878a8", "#2a7f3f", "#e39b3d", "#7a4f9a", "#8c8c8c")

_SIDE = 15
"""Half the side of a square of points, which are about one apart."""

_COLORS = {
    "coplanar and connective": "#2a7f3f",
    "coplanar, not connective": "#e39b3d",
    "connective, not coplanar": "#4878a8",
    "neither": "#c44e52",
}
"""Colors of neighbors by the criteria they meet."""


def reproduce(run: Run) -> Record:
    """Make Figures 1, 2, 5 and 6."""
    _draw_weights(run.folder.path_of("figures/figure2.png"))
    _draw_sphere(run.folder.path_of("figures/figure6.png"))
    figure5, counts = _make_figure5(run)
    blocks = [
        text(FRAMEWORK),
        figure(
            "figures/figure2.png",
            "**Figure 2**: Geman-McClure weights, eq. (5), of residuals r. Left: as printed, "
            "(mu / (mu + r))². Right: with r², as in the paper's source and in torchrg.",
        ),
        *figure5,
        figure(
            "figures/figure6.png",
            "**Figure 6**: points of a box; their normals on the Gaussian sphere; center and "
            "distance of two normals, eqs. (16) and (17).",
        ),
    ]
    return section("Figures 1, 2, 5 and 6: the method", blocks, counts)


def _draw_weights(path: Path) -> None:
    """Plot the weight against the residual, for several scales."""
    residuals = np.linspace(-30, 30, 601)
    with settings():
        figure_, axes = plt.subplots(1, 2, figsize=(5, 2.2), sharey=True, layout="constrained")
        for axis, power, title in zip(axes, (1, 2), ("as printed", "squared"), strict=True):
            for mu in SCALES:
                weights = (mu / (mu + np.abs(residuals) ** power)) ** 2
                axis.plot(residuals, weights, label=f"µ = {mu:g}")
            axis.set_title(title)
            axis.set_xlabel("residual")
        axes[0].set_ylabel("weight")
        axes[1].legend()
        figure_.savefig(path)
        plt.close(figure_)


def _draw_sphere(path: Path) -> None:
    """Draw a box, its normals on the sphere, and the center and distance of two normals."""
    box = make_shape("cuboid", 6000, 0.002)
    fit = estimate_normals(box.points, method="paper")
    outwards = (fit.normals * box.normals).sum(dim=1, keepdim=True).sign() * fit.normals
    is_seen = box.normals @ torch.tensor(_VIEW) > 0
    colors = np.array(_FACE_COLORS)[box.labels[is_seen].numpy()]
    with settings():
        figure_ = plt.figure(figsize=(7, 2.5), layout="constrained")
        clouds = (("points of a box", box.points, 1.1), ("their normals", outwards, 1.5))
        for place, (title, points, zoom) in enumerate(clouds, 1):
            axis = figure_.add_subplot(1, 3, place, projection="3d")
            axis.scatter(*points[is_seen].T.numpy(), s=2, c=colors, linewidths=0)
            axis.set_box_aspect(np.ptp(points.numpy(), axis=0), zoom=zoom)
            axis.set_axis_off()
            axis.set_title(title)
        _draw_globe(axis)
        _draw_distance(figure_.add_subplot(1, 3, 3))
        figure_.savefig(path)
        plt.close(figure_)


def _draw_globe(axis: Axes3D) -> None:
    """Draw the wireframe of a sphere."""
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 25j, -np.pi / 2 : np.pi / 2 : 13j]
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    axis.plot_wireframe(x, y, np.sin(latitude), color="#dddddd", linewidth=0.3)


def _draw_distance(axis: plt.Axes) -> None:
    """Draw two directions on a circle, their center, and the angle."""
    ends = np.deg2rad([35, 105])
    around = np.linspace(0, 2 * np.pi, 200)
    axis.plot(np.cos(around), np.sin(around), color="#bbbbbb", linewidth=0.6)
    for angle, name in zip((*ends, ends.mean()), ("$n_1$", "$n_2$", "$c$"), strict=True):
        tip = np.array([np.cos(angle), np.sin(angle)])
        color = "#c44e52" if name == "$c$" else "#333333"
        axis.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": color})
        axis.text(*(1.14 * tip), name, ha="center", va="center", color=color)
    arc = np.linspace(*ends, 40)
    axis.plot(0.4 * np.cos(arc), 0.4 * np.sin(arc), color="#4878a8")
    axis.text(0.0, -0.22, r"$d_{12} = \arccos |n_1 \cdot n_2|$", ha="center", color="#4878a8")
    axis.set_title("center and distance")
    axis.set_aspect("equal")
    axis.set_axis_off()


class Case(NamedTuple):
    """A point and its neighbors, in units of the points."""

    title: str
    axes: tuple[int, int]  # axes of the plot
    cloud: Tensor  # all points relative to the point, (N, 3)
    patch: Tensor  # its neighbors, (K, 3)
    normal: Tensor  # (3,)
    coplanar: Tensor  # by eq. (11), (K,)
    connective: Tensor  # by eq. (10), (K,)
    limit: float  # maximum distance of a coplanar neighbor


def _make_figure5(run: Run) -> tuple[list[Block], Record]:
    """Make Figure 5 and count the neighbors that meet each criterion."""
    floor = _square(-_SIDE, 0)
    wall = _square(0, _SIDE)[:, [2, 1, 0]]
    raised = _square(0, _SIDE) + torch.tensor([0.0, 0.0, 1.5])
    beyond = _square(0, _SIDE) + torch.tensor([0.9, 0.0, 0.0])
    cases = [
        _test("an edge, from the side", torch.cat([floor, wall]), (0, 2)),
        _test("a step, from the side", torch.cat([floor, raised]), (0, 2)),
        _test("a gap, from above", torch.cat([floor, beyond]), (0, 1)),
    ]
    _draw_cases(run.folder.path_of("figures/figure5.png"), cases)
    counts, listed = {}, []
    for case in cases:
        found = case.coplanar, case.connective, case.coplanar & case.connective
        kinds = ("coplanar", "connective", "both")
        counts[case.title] = {
            kind: int(mask.sum()) for kind, mask in zip(kinds, found, strict=True)
        }
        numbers = ", ".join(f"{count} {kind}" for kind, count in counts[case.title].items())
        listed.append(f"{case.title}: {numbers}")
    k = load_config("paper").normals.k
    caption = (
        "**Figure 5**: neighbors of a point (black ring) near an edge, a step and a gap on "
        "synthetic surfaces; gray: other points. The band is the limit of eq. (11)."
    )
    return [
        figure("figures/figure5.png", caption),
        text(
            "A neighbor is connective if it shares 75 % of its neighbors with the point (eq. 10). "
            "It is coplanar if its distance to the plane of the point is at most median + 2 Qn of "
            "the distances in the neighborhood (eq. 11). Normals are the paper's. Counts of "
            f"{k} neighbors: {'; '.join(listed)}."
        ),
    ], counts


def _square(start: int, stop: int) -> Tensor:
    """Return noisy points of a horizontal surface, about one apart."""
    rng = torch.Generator().manual_seed(stop - start)
    places = torch.cartesian_prod(
        torch.arange(start, stop) + 0.5, torch.arange(-_SIDE, _SIDE) + 0.5, torch.zeros(1)
    )
    spread = torch.tensor([0.3, 0.3, 0.03])
    return places + spread * torch.randn(places.shape, generator=rng).clamp(-1.5, 1.5)


def _test(title: str, cloud: Tensor, axes: tuple[int, int]) -> Case:
    """Test the neighbors of the floor point two units from the border."""
    settings_ = load_config("paper")
    neighbors = search_knn(cloud, settings_.normals.k)
    fit = estimate_normals(cloud, config=settings_.normals, neighbors=neighbors)
    row = int((cloud - torch.tensor([-2.0, 0.0, 0.0])).square().sum(dim=1).argmin())
    one = slice(row, row + 1)
    columns = gather_columns(cloud, neighbors.indices[one])
    residuals = project(columns, fit.normals[one]).abs()
    floor = settings_.growing.coplanarity_floor * patch_radii(columns)
    limit = coplanarity_limits(residuals, floor)
    every = torch.ones_like(residuals, dtype=torch.bool)
    min_shared = min_shared_neighbors(settings_.growing.connectivity, settings_.normals.k)
    connective = connected_neighbors(Neighbors(neighbors.indices), min_shared, [], one, every)
    return Case(
        title,
        axes,
        cloud - cloud[row],
        torch.cat(columns).T,
        fit.normals[row],
        (residuals <= limit[:, None])[0],
        connective[0],
        float(limit),
    )


def _draw_cases(path: Path, cases: list[Case]) -> None:
    """Draw a panel per case."""
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
    """Draw a point, its plane and its neighbors."""
    first, second = case.axes
    reach = float(patch_radii(unbind_columns(case.patch[None]))) * 1.3
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
