"""Figures 1, 2, 5 and 6: the method and its indices."""

from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt
from mpl_toolkits.mplot3d import Axes3D

from reproduction.cells import Record
from reproduction.criteria import make_figure5
from reproduction.pictures import settings
from reproduction.runs import Run
from reproduction.sections import figure, section, text
from tests.made import make_shape
from torchrg import estimate_normals

FRAMEWORK = (
    "**Figure 1**, the framework, as it is built here. Normals: k nearest neighbours; PCA gives "
    "initial normals; points whose Qn of the angles to their neighbours is above 5° are sharp; "
    "there DetMCD, and PCA of its inliers. Region growing: the limit of curvature is its 95th "
    "percentile; the seed is the point of least curvature; neighbours within the angle that are "
    "coplanar join the region; those that are connective too, and whose increment is within the "
    "limit, become seeds."
)
SCALES = (1.0, 10.0, 100.0)
"""Values of mu in Figure 2."""

_VIEW = (0.43, -0.75, 0.5)
"""Where matplotlib looks from at scenes in space."""

_FACES = ("#c44e52", "#4878a8", "#2a7f3f", "#e39b3d", "#7a4f9a", "#8c8c8c")


def reproduce(run: Run) -> Record:
    """Make Figures 1, 2, 5 and 6."""
    _draw_weights(run.folder.place("figures/figure2.png"))
    _draw_sphere(run.folder.place("figures/figure6.png"))
    figure5, counts = make_figure5(run)
    blocks = [
        text(FRAMEWORK),
        figure(
            "figures/figure2.png",
            "**Figure 2**: weights of Geman-McClure, eq. (5), of residuals r. Left as printed, "
            "(mu / (mu + r))²; right with the square of r, as in the source that the paper cites "
            "and here.",
        ),
        *figure5,
        figure(
            "figures/figure6.png",
            "**Figure 6**: points of a box; their normals on the Gaussian sphere; centre and "
            "distance of two of them, eqs. (16) and (17).",
        ),
    ]
    return section("Figures 1, 2, 5 and 6: the method", blocks, counts)


def _draw_weights(path: Path) -> None:
    """Draw the weight against the residual, for some scales."""
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
    """Draw a box, its normals as points of the sphere, and what centre and distance are."""
    box = make_shape("cuboid", 6000, 0.002)
    fit = estimate_normals(box.points, method="paper")
    outwards = (fit.normals * box.normals).sum(dim=1, keepdim=True).sign() * fit.normals
    is_seen = box.normals @ torch.tensor(_VIEW) > 0
    colors = np.array(_FACES)[box.labels[is_seen].numpy()]
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
    """Draw the lines of a sphere."""
    longitude, latitude = np.mgrid[0 : 2 * np.pi : 25j, -np.pi / 2 : np.pi / 2 : 13j]
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    axis.plot_wireframe(x, y, np.sin(latitude), color="#dddddd", linewidth=0.3)


def _draw_distance(axis: plt.Axes) -> None:
    """Draw two directions on a circle, the one between them, and the angle."""
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
    axis.set_title("centre and distance")
    axis.set_aspect("equal")
    axis.set_axis_off()
