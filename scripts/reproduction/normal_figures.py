"""Figures of normal errors, and of sharp feature points."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib import ticker
from torch import Tensor

from reproduction.cells import Record
from reproduction.normal_tables import mean_score, where
from reproduction.pictures import settings, write_tiles
from torchrg.render import color_normals, color_sharp, render_cloud
from torchrg.scenes import Scene

STYLES = {
    "pca": ("PCA", "#4878a8", "o", "-"),
    "jet": ("2-jet", "#7fb2d5", "s", "-"),
    "irls": ("weighted PCA", "#e39b3d", "^", "-"),
    "detmm": ("DetMM", "#7a4f9a", "D", "-"),
    "paper": ("PCA + DetMCD (paper)", "#c44e52", "X", "-"),
    "libra": ("the same, DetMCD of LIBRA", "#c44e52", "x", "--"),
    "consensus": ("consensus", "#2a7f3f", "*", "-"),
    "adaptive": ("consensus, adaptive k", "#7cc08a", "*", "--"),
}
"""Label, colour, marker and line of each estimator."""

_WIDTH = 700


def draw_errors(path: Path, records: list[Record], shapes: Sequence[str]) -> None:
    """Draw MSAE against noise, of one number of points, a panel for each shape."""
    with settings():
        _draw_grid(path, records, shapes)


def _draw_grid(path: Path, records: list[Record], shapes: Sequence[str]) -> None:
    """Draw one panel for each shape."""
    columns = min(len(shapes), 4)
    rows = -(-len(shapes) // columns)
    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(2.6 * columns + 0.2, 2.3 * rows + 0.7),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat[len(shapes) :]:
        axis.set_axis_off()
    for axis, shape in zip(axes.flat, shapes, strict=False):
        _draw_panel(axis, [record for record in records if record["shape"] == shape])
        axis.set_title(shape.replace("_", " "))
    for axis in axes[:, 0]:
        axis.set_ylabel("MSAE (degrees²)")
    for axis in axes[-1]:
        axis.set_xlabel("noise (% of the diagonal)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3 if columns <= 2 else 5)
    figure.savefig(path)
    plt.close(figure)


def _draw_panel(axis: plt.Axes, records: list[Record]) -> None:
    """Draw one line for each estimator, noise levels evenly apart."""
    noises = sorted({record["noise_percent"] for record in records})
    for name, (label, color, marker, line) in STYLES.items():
        found = {
            noise: mean_score(records, "msae", noise_percent=noise, variant=name)
            for noise in noises
            if where(records, noise_percent=noise, variant=name)
        }
        if found:
            heights = [max(found[noise], 0.1) for noise in noises]
            places = range(len(noises))
            axis.plot(places, heights, line, color=color, marker=marker, label=label)
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_minor_locator(ticker.NullLocator())
    axis.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axis.set_xticks(range(len(noises)), [f"{noise:g}" for noise in noises])


def draw_sharp_points(path: Path, clouds: list[tuple[str, Scene, Tensor]]) -> None:
    """Draw true normals, and below them the sharp feature points, of shapes.

    Args:
        path: The picture to write.
        clouds: Name, cloud with truth, and mask of sharp points of each shape.
    """
    pictures = [
        render_cloud(
            scene.points, paint, normals=scene.normals, view="outside", width=_WIDTH, height=_WIDTH
        )
        for paints in (
            [color_normals(scene.normals) for _, scene, _ in clouds],
            [color_sharp(sharp) for _, _, sharp in clouds],
        )
        for paint, (_, scene, _) in zip(paints, clouds, strict=True)
    ]
    titles = [*(name.replace("_", " ") for name, _, _ in clouds), *("" for _ in clouds)]
    write_tiles(path, list(zip(titles, pictures, strict=True)), columns=len(clouds))
