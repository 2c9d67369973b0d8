"""Figures 1, 2, 5 and 6: the method and its indices."""

from pathlib import Path

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.patches import FancyArrowPatch, Rectangle
from mpl_toolkits.mplot3d import Axes3D

from reproduction.cells import Record
from reproduction.criteria import make_figure5
from reproduction.plotting import settings
from reproduction.runs import Run
from reproduction.sections import figure, section
from tests.made import make_shape
from torchrg import estimate_normals

NORMALS = (
    "k nearest\nneighbours",
    "PCA: initial\nnormals",
    "Qn of angles\n> 5°: sharp",
    "DetMCD and\nPCA of inliers\nat sharp points",
)
"""First half of Figure 1."""

GROWTH = (
    "curvature limit:\n95th percentile",
    "seed of least\ncurvature",
    "neighbours within\nangle, coplanar: join\nthe region",
    "connective, increment\nwithin the limit:\nbecome seeds",
)
"""Second half of Figure 1."""

SCALES = (1.0, 10.0, 100.0)
"""Values of mu in Figure 2."""

_VIEW = (0.43, -0.75, 0.5)
"""Where matplotlib looks from at scenes in space."""

_FACES = ("#c44e52", "#4878a8", "#2a7f3f", "#e39b3d", "#7a4f9a", "#8c8c8c")


def reproduce(run: Run) -> Record:
    """Make Figures 1, 2, 5 and 6."""
    _draw_framework(run.folder.place("figures/figure1.png"))
    _draw_weights(run.folder.place("figures/figure2.png"))
    _draw_sphere(run.folder.place("figures/figure6.png"))
    figure5, counts = make_figure5(run)
    blocks = [
        figure("figures/figure1.png", "**Figure 1**: the framework, as it is built here."),
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


def _draw_framework(path: Path) -> None:
    """Draw two rows of boxes, joined by arrows."""
    width, height, gap = 0.86, 0.6, 0.14
    with settings():
        figure_, axis = plt.subplots(figsize=(7.5, 2.6), layout="constrained")
        for bottom, title, steps in ((1.25, "Normals", NORMALS), (0, "Region growing", GROWTH)):
            frame = (-gap, bottom - gap), len(steps) + gap, height + 0.4
            axis.add_patch(Rectangle(*frame, fill=False, linestyle="--", linewidth=0.6))
            axis.text(0, bottom + height + 0.12, title, fontstyle="italic", va="center")
            middle = bottom + height / 2
            for place, words in enumerate(steps):
                box = Rectangle((place, bottom), width, height, facecolor="#eef3f8")
                axis.add_patch(box)
                axis.text(place + width / 2, middle, words, ha="center", va="center", fontsize=7)
                if place:
                    _draw_arrow(axis, (place - gap, middle), (place, middle))
        _draw_arrow(axis, (2 - gap / 2, 1.25 - gap), (2 - gap / 2, height + 0.4 - gap))
        axis.set_xlim(-0.2, 4.05)
        axis.set_ylim(-0.2, 2.2)
        axis.set_axis_off()
        figure_.savefig(path)
        plt.close(figure_)


def _draw_arrow(axis: plt.Axes, begin: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow."""
    axis.add_patch(
        FancyArrowPatch(
            begin, end, arrowstyle="-|>", mutation_scale=8, shrinkA=0, shrinkB=0, color="#333333"
        )
    )


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
