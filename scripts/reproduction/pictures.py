"""Pictures of segmentations side by side, and of what is wrong with them."""

from collections.abc import Iterable, Mapping
from importlib.util import find_spec

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from reproduction.cells import Folder
from reproduction.clouds import EvalCloud
from reproduction.tiles import tile_pictures
from torchrg.render import color_planes, make_page, render_cloud, write_page, write_png
from torchrg.render.outcomes import OUTCOMES, outcomes_of
from torchrg.result import Result
from torchrg.structures import Cloud

_GRAY = 190
"""Of the cloud itself."""
_WIDTH = 1000
"""Of a picture, in pixels."""
_LONG = 2.2
"""Width over height of a picture that takes the place of two."""


def draw_side_by_side(
    folder: Folder,
    name: str,
    cloud: EvalCloud,
    labelings: Mapping[str, Tensor],
    *,
    with_input: bool = True,
) -> str:
    """Draw the input, the true faces if they are known, and segmentations of one cloud.

    Args:
        folder: Where the picture goes.
        name: Of the picture.
        cloud: The cloud.
        labelings: Labels by title. The same face has one colour in all pictures.
        with_input: Whether the cloud itself is the first picture.

    Returns:
        The name of the file.
    """
    reference = cloud.labels if cloud.labels is not None else list(labelings.values())[-1]
    paints = {}
    if with_input:
        paints["input"] = torch.full((len(cloud.points), 3), _GRAY, dtype=torch.uint8)
    if cloud.labels is not None:
        paints["true faces"] = color_planes(cloud.labels, cloud.points)
    for title, labels in labelings.items():
        paints[title] = color_planes(labels, cloud.points, reference=reference)
    return _tile(folder, name, cloud, paints)


def write_pair(folder: Folder, name: str, cloud: EvalCloud, labelings: Mapping[str, Tensor]) -> str:
    """Write a page of the last segmentation beside the true faces, or beside the first one.

    Returns:
        The name of the file; empty where pydeck, which pages need, is not installed.
    """
    if find_spec("pydeck") is None:
        return ""
    first, *_, last = [*labelings, *labelings]
    pair = {last: labelings[last]}
    if cloud.labels is not None:
        pair["true faces"] = cloud.labels
    elif first != last:
        pair[first] = labelings[first]
    normals = {} if cloud.normals is None else {"normals": cloud.normals.numpy()}
    results = [
        Result(Cloud(cloud.points.numpy(), {"labels": labels.numpy(), **normals}, source=title))
        for title, labels in pair.items()
    ]
    truth = None if cloud.labels is None else results[-1].cloud
    file = f"figures/{name}.html"
    page = make_page(results[0], beside=results[1] if len(results) > 1 else None, truth=truth)
    write_page(folder.place(file), page)
    return file


def draw_outcomes(
    folder: Folder, name: str, cloud: EvalCloud, labelings: Mapping[str, Tensor]
) -> str:
    """Draw what became of every point of a cloud with truth, in the colours of :data:`OUTCOMES`."""
    if cloud.labels is None:
        raise ValueError("draw_outcomes: expected a cloud with truth.")
    colors = torch.tensor([color for color, _ in OUTCOMES.values()], dtype=torch.uint8)
    paints = {
        title: colors[outcomes_of(labels, cloud.labels)] for title, labels in labelings.items()
    }
    return _tile(folder, name, cloud, paints, legend=OUTCOMES.values())


def _tile(
    folder: Folder,
    name: str,
    cloud: EvalCloud,
    paints: Mapping[str, Tensor],
    legend: Iterable[tuple[tuple[int, ...], str]] = (),
) -> str:
    """Render a cloud in several colourings, and write them as one picture."""
    pictures = [
        render_cloud(cloud.points, paint, normals=cloud.normals, width=_WIDTH)
        for paint in paints.values()
    ]
    height, width = pictures[0].shape[:2]
    columns = 2 if width > _LONG * height or len(pictures) == 4 else 3
    picture = tile_pictures(pictures, titles=list(paints), columns=columns)
    if legend:
        picture = torch.cat([picture, _draw_legend(legend, picture.shape[1])])
    file = f"figures/{name}.png"
    write_png(folder.place(file), picture)
    return file


def _draw_legend(entries: Iterable[tuple[tuple[int, ...], str]], width: int) -> Tensor:
    """Return a strip that says what colours mean, shape ``(h, width, 3)``, uint8."""
    figure = Figure(figsize=(width / 100, width / 3400), dpi=100)
    patches = [
        Patch(facecolor=[value / 255 for value in color], edgecolor="#888888", label=meaning)
        for color, meaning in entries
    ]
    figure.legend(
        handles=patches, loc="center", ncols=len(patches), frameon=False, fontsize=width / 115
    )
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    strip = torch.from_numpy(np.array(canvas.buffer_rgba())[..., :3])
    return strip[:, :width]
