"""Pictures of segmentations side by side, and of what is wrong with them."""

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from torch import Tensor

from reproduction.cells import Folder
from reproduction.clouds import EvalCloud
from reproduction.tiles import tile_pictures
from torchrg.metrics import contingency_table, match_regions
from torchrg.render import color_planes, render_cloud, write_png
from torchrg.structures import UNLABELED

_GRAY = 190
"""Of clouds without colours."""
_WIDTH = 1000
"""Of a picture, in pixels."""
_LONG = 2.2
"""Width over height of a picture that takes the place of two."""

OUTCOMES = {
    "right": ((214, 224, 214), "in the region of their face"),
    "part": ((245, 170, 40), "in a second region of their face"),
    "other": ((205, 45, 60), "in the region of another face"),
    "none": ((50, 95, 190), "in no region"),
}
"""What can become of a point: colour, and what it means."""


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
        gray = torch.full((len(cloud.points), 3), _GRAY, dtype=torch.uint8)
        paints["input"] = gray if cloud.colors is None else cloud.colors
    if cloud.labels is not None:
        paints["true faces"] = color_planes(cloud.labels, cloud.points)
    for title, labels in labelings.items():
        paints[title] = color_planes(labels, cloud.points, reference=reference)
    return _tile(folder, name, cloud, paints)


def draw_outcomes(
    folder: Folder, name: str, cloud: EvalCloud, labelings: Mapping[str, Tensor]
) -> str:
    """Draw what became of every point of a cloud with truth, in the colours of :data:`OUTCOMES`."""
    colors = torch.tensor([color for color, _ in OUTCOMES.values()], dtype=torch.uint8)
    paints = {
        title: colors[outcomes_of(labels, cloud.labels)] for title, labels in labelings.items()
    }
    return _tile(folder, name, cloud, paints, legend=OUTCOMES.values())


def outcomes_of(labels: Tensor, truth: Tensor | None) -> Tensor:
    """Return what became of each point, as a place in :data:`OUTCOMES`.

    Args:
        labels: Regions, shape ``(N,)``.
        truth: Faces, shape ``(N,)``.

    Returns:
        Shape ``(N,)``, int64: 0 where the region of the point is the partner of its face, 1 where
        it is another one whose largest part is that face, 2 where it is mostly of other faces, 3
        where the point is in no region.
    """
    if truth is None:
        raise ValueError("outcomes_of: expected a cloud with truth.")
    table = contingency_table(labels, truth)
    pairs = match_regions(table)
    partner = torch.full_like(table.region_labels, UNLABELED - 1)
    partner[table.regions[pairs]] = table.face_labels[table.faces[pairs]]
    # Overlaps by region, the largest first; the first of each region is that with its main face.
    order = np.lexsort((-table.overlaps.numpy(), table.regions.numpy()))
    regions, first = np.unique(table.regions.numpy()[order], return_index=True)
    main = torch.full_like(table.region_labels, UNLABELED - 1)
    main[regions] = table.face_labels[table.faces[order[first]]]
    outcome = torch.full_like(labels, 3)
    labeled = labels != UNLABELED
    rows = torch.searchsorted(table.region_labels, labels[labeled])
    faces = truth[labeled]
    outcome[labeled] = torch.where(
        partner[rows] == faces, 0, torch.where(main[rows] == faces, 1, 2)
    )
    return outcome


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
