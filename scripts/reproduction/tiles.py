"""Several pictures in one, for figures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrg._checks import check_shapes
from torchrg._optional import require
from torchrg.errors import ConfigError

_GAP = 0.02  # between pictures, in widths
_TITLE = 0.035  # size of the letters, in widths


def tile_pictures(
    pictures: Sequence[Tensor], *, titles: Sequence[str] | None = None, columns: int | None = None
) -> Tensor:
    """Put pictures side by side on white, each in the middle of its tile.

    Args:
        pictures: Each of shape ``(H, W, 3)``, uint8; at least one. Sizes may differ.
        titles: A line of text over each; needs matplotlib, of the extra ``report``.
        columns: Pictures in a row. Default: all.

    Returns:
        Shape ``(height, width, 3)``, uint8.

    Raises:
        ShapeError: If a picture has another shape.
        ConfigError: If there is no picture, ``columns`` is below 1, or the number of titles is
            wrong.
        MissingDependencyError: If there are titles and matplotlib is not installed.

    Example:
        >>> picture = torch.zeros(30, 50, 3, dtype=torch.uint8)
        >>> tile_pictures([picture, picture, picture], columns=2).shape
        torch.Size([61, 101, 3])
    """
    for picture in pictures:
        check_shapes("tile_pictures", pictures=(picture, "H W 3"))
    columns = len(pictures) if columns is None else columns
    if columns < 1:
        raise ConfigError("tile_pictures: expected at least one picture and column, got none.")
    if titles is not None and len(titles) != len(pictures):
        raise ConfigError(
            f"tile_pictures: expected {len(pictures)} titles, one for each picture, got "
            f"{len(titles)}."
        )
    width = max(picture.shape[1] for picture in pictures)
    gap = max(1, round(_GAP * width))
    rows = []
    for start in range(0, len(pictures), columns):
        row = pictures[start : start + columns]
        height = max(picture.shape[0] for picture in row)
        tiles = [_center(picture, height, width) for picture in row]
        if titles is not None:
            lines = (_draw_text(title, width) for title in titles[start : start + columns])
            tiles = [
                torch.cat([line.to(tile), tile]) for line, tile in zip(lines, tiles, strict=True)
            ]
        tiles += [torch.full_like(tiles[0], 255)] * (columns - len(tiles))
        rows.append(_join(tiles, gap, axis=1))
    return _join(rows, gap, axis=0)


def _center(picture: Tensor, height: int, width: int) -> Tensor:
    """Return a picture in the middle of a white one."""
    tile = picture.new_full((height, width, 3), 255)
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    tile[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return tile


def _join(pictures: Sequence[Tensor], gap: int, *, axis: int) -> Tensor:
    """Join pictures along an axis, white between them."""
    parts = [pictures[0]]
    for picture in pictures[1:]:
        shape = list(picture.shape)
        shape[axis] = gap
        parts += [picture.new_full(shape, 255), picture]
    return torch.cat(parts, dim=axis)


def _draw_text(text: str, width: int) -> Tensor:
    """Return a line of text in the middle of a white strip, shape ``(h, width, 3)``, uint8."""
    require("matplotlib", extra="report", purpose="write titles on pictures")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = max(8.0, _TITLE * width)
    canvas: Any = FigureCanvasAgg(Figure(figsize=(width / 72, round(1.8 * size) / 72), dpi=72))
    canvas.figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=size)
    canvas.draw()
    line = torch.from_numpy(np.array(canvas.buffer_rgba())[..., :3])
    return _center(line[:, :width], line.shape[0], width)
