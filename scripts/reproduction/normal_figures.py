"""Figures of normal errors, and of sharp feature points."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib import ticker

from reproduction.cells import Record
from torchrg.scenes import Scene

STYLES = {
    "pca": ("PCA", "#4878a8", "o", "-"),
    "jet": ("2-jet", "#7fb2d5", "s", "-"),
    "irls": ("weighted PCA", "#e39b3d", "^", "-"),
    "fastmcd": ("FastMCD", "#bdbdbd", "v", ":"),
    "mve": ("MVE", "#8c8c8c", "<", ":"),
    "detmcd": ("DetMCD", "#b79ac8", "P", "--"),
    "detmm": ("DetMM", "#7a4f9a", "D", "-"),
    "paper": ("PCA + DetMCD (paper)", "#c44e52", "X", "-"),
    "consensus": ("consensus", "#2a7f3f", "*", "-"),
    "adaptive": ("consensus, adaptive k", "#7cc08a", "*", "--"),
}
"""Label, colour, marker and line of each estimator."""

SHARP, REGULAR = "#d62728", "#1b5e20"

SETTINGS = {
    "font.family": "serif",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.linewidth": 0.3,
    "grid.color": "#dddddd",
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "legend.frameon": False,
    "savefig.dpi": 200,
}


def draw_errors(folder: Path, records: list[Record]) -> None:
    """Draw MSAE against noise: ``figure4.png``, and all shapes in ``figure4_all.png``.

    Args:
        folder: Where the pictures go.
        records: What was measured.
    """
    size = max(record["num_points"] for record in records)
    records = [record for record in records if record["num_points"] == size]
    shapes = list(dict.fromkeys(record["shape"] for record in records))
    with mpl.rc_context(SETTINGS):
        _draw_grid(
            folder / "figure4.png", records, [s for s in shapes if s in ("cuboid", "dodecahedron")]
        )
        _draw_grid(folder / "figure4_all.png", records, shapes)


def _draw_grid(path: Path, records: list[Record], shapes: list[str]) -> None:
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
            record["noise_percent"]: record["score"]["msae"]
            for record in records
            if record["variant"] == name
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


def draw_sharp_points(folder: Path, clouds: list[tuple[str, Scene, object]]) -> None:
    """Draw true normals and sharp feature points of shapes: ``figure3.png``.

    Args:
        folder: Where the picture goes.
        clouds: Name, cloud with truth, and mask of sharp points of each shape.
    """
    with mpl.rc_context(SETTINGS):
        figure = plt.figure(figsize=(1.7 * len(clouds), 3.6), layout="constrained")
        for column, (name, scene, sharp) in enumerate(clouds):
            points, normals = scene.points.numpy(), scene.normals.numpy()
            mask = np.asarray(sharp)
            for row, colors in enumerate(
                ((normals + 1) / 2, np.where(mask[:, None], *_rgb(SHARP, REGULAR)))
            ):
                axis = figure.add_subplot(
                    2, len(clouds), row * len(clouds) + column + 1, projection="3d"
                )
                _draw_cloud(axis, points, normals, colors)
                if row == 0:
                    axis.set_title(name.replace("_", " "))
        figure.savefig(folder / "figure3.png")
        plt.close(figure)


def _rgb(*colors: str) -> tuple[np.ndarray, ...]:
    return tuple(np.array(mpl.colors.to_rgb(color)) for color in colors)


def _draw_cloud(
    axis: plt.Axes, points: np.ndarray, normals: np.ndarray, colors: np.ndarray
) -> None:
    """Draw the points that look at the reader, shaded a little."""
    elevation, azimuth = np.radians(25), np.radians(-55)
    to_reader = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    facing = normals @ to_reader
    seen = facing > 0
    shaded = colors[seen] * (0.65 + 0.35 * facing[seen, None])
    axis.scatter(*points[seen].T, c=shaded, s=3, linewidths=0, depthshade=False)
    axis.view_init(np.degrees(elevation), np.degrees(azimuth))
    axis.set_box_aspect(np.ptp(points, axis=0), zoom=1.15)
    axis.set_axis_off()
