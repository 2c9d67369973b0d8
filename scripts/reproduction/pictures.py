"""Style of plots, and images of segmentations side by side."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import matplotlib as mpl
import torch
from matplotlib import pyplot as plt
from matplotlib.patches import Patch
from torch import Tensor

from reproduction.clouds import EvalCloud
from reproduction.records import Folder
from torchrg.render import color_planes, render_cloud
from torchrg.render.channels import OUTCOMES, point_outcomes

SETTINGS = {
    "font.family": "serif",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.3,
    "grid.color": "#dddddd",
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    "legend.frameon": False,
    "savefig.dpi": 250,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.04,
}
_GRAY = 190
"""Gray value of the input cloud."""
_WIDTH = 1000
"""Width of an image, in pixels."""
_INCHES = 4.0
"""Width of a tile."""
_LONG = 2.2
"""Aspect ratio from which tiles are placed in two columns."""


def settings() -> AbstractContextManager[None]:
    """Return a context with the style of plots."""
    return mpl.rc_context(SETTINGS)


def write_tiles(
    path: Path,
    tiles: Sequence[tuple[str, Tensor]],
    columns: int,
    legend: Iterable[tuple[tuple[int, ...], str]] = (),
) -> None:
    """Write titled images ``(H, W, 3)`` side by side, with a legend of colors."""
    rows = -(-len(tiles) // columns)
    height, width = tiles[0][1].shape[:2]
    size = (_INCHES * columns, rows * (_INCHES * height / width + 0.25))
    with settings():
        figure, axes = plt.subplots(
            rows, columns, figsize=size, squeeze=False, layout="constrained"
        )
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, (title, image) in zip(axes.flat, tiles, strict=False):
            axis.imshow(image.numpy())
            axis.set_title(title)
        patches = [
            Patch(facecolor=[value / 255 for value in color], edgecolor="#888888", label=meaning)
            for color, meaning in legend
        ]
        if patches:
            figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))
        figure.savefig(path)
        plt.close(figure)


def draw_side_by_side(
    folder: Folder,
    name: str,
    cloud: EvalCloud,
    labelings: Mapping[str, Tensor],
    *,
    with_input: bool = True,
) -> str:
    """Render the input, the ground truth if known, and segmentations of one cloud.

    Args:
        folder: Output folder.
        name: Name of the image.
        cloud: The cloud.
        labelings: Labels by title. A surface has the same color in all images.
        with_input: Whether the first image is the cloud itself.

    Returns:
        The path of the image in the folder.
    """
    reference = cloud.labels if cloud.labels is not None else list(labelings.values())[-1]
    paints = {}
    if with_input:
        paints["input"] = torch.full((len(cloud.points), 3), _GRAY, dtype=torch.uint8)
    if cloud.labels is not None:
        paints["ground truth"] = color_planes(cloud.labels, cloud.points)
    for title, labels in labelings.items():
        paints[title] = color_planes(labels, cloud.points, reference=reference)
    return _tile(folder, name, cloud, paints)


def draw_outcomes(
    folder: Folder, name: str, cloud: EvalCloud, labelings: Mapping[str, Tensor]
) -> str:
    """Render the outcome of every point of a cloud with ground truth, as in :data:`OUTCOMES`."""
    if cloud.labels is None:
        raise ValueError("draw_outcomes: expected a cloud with ground truth.")
    colors = torch.tensor([color for color, _ in OUTCOMES.values()], dtype=torch.uint8)
    paints = {
        title: colors[point_outcomes(labels, cloud.labels)] for title, labels in labelings.items()
    }
    return _tile(folder, name, cloud, paints, legend=OUTCOMES.values())


def _tile(
    folder: Folder,
    name: str,
    cloud: EvalCloud,
    paints: Mapping[str, Tensor],
    legend: Iterable[tuple[tuple[int, ...], str]] = (),
) -> str:
    """Render a cloud in several colorings into one image."""
    images = {
        title: render_cloud(
            cloud.points, paint, normals=cloud.normals, labels=cloud.labels, width=_WIDTH
        )
        for title, paint in paints.items()
    }
    height, width = next(iter(images.values())).shape[:2]
    columns = 2 if width > _LONG * height or len(images) == 4 else 3
    file = f"figures/{name}.png"
    write_tiles(folder.path_of(file), list(images.items()), min(columns, len(images)), legend)
    return file
