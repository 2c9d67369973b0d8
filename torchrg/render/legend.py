"""Legend below an image: a title, the scale, and colors with their meaning."""

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

_GLYPHS = "".join(map(chr, range(32, 127))) + "²"
"""Characters in ``font.png``, see ``scripts/font.py``."""
_INK, _PAPER = 35, 255
"""Brightness of text and background."""
_ROW, _CHIP, _GAP = 32, 18, 10
"""Height of a row, side of a color sample, and space between them, in pixels of the font."""
_COLUMN = 276
"""Width of an entry: five in an image of 1,400 pixels."""
_MAX_BAR = 150
"""Maximum length of the scale bar."""


class Legend(NamedTuple):
    """Legend of an image.

    Attributes:
        title: First line.
        entries: Colors, shape ``(3,)``, and their meaning.
        unit: Unit of the cloud.
    """

    title: str
    entries: Sequence[tuple[Tensor, str]]
    unit: str


@functools.cache
def _glyphs() -> dict[str, Tensor]:
    """Return the coverage of each character, shape ``(height, width)``, in [0, 1]."""
    from kornia_rs import io

    image = torch.from_numpy(
        io.read_image_png_u8(str(Path(__file__).with_name("font.png")), "mono")
    )
    starts = image[0, :, 0].nonzero().squeeze(1).tolist()
    ends = [*starts[1:], image.shape[1]]
    parts = [image[1:, a:b, 0].float() / 255 for a, b in zip(starts, ends, strict=True)]
    return dict(zip(_GLYPHS, parts, strict=True))


def _write(image: Tensor, text: str, row: int, column: int) -> None:
    """Write text into an image ``(H, W, 3)``, up to its right edge; "?" for other characters."""
    glyphs = _glyphs()
    line = torch.cat([glyphs.get(character, glyphs["?"]) for character in text or " "], dim=1)
    box = image[row : row + len(line), column : column + line.shape[1]]
    ink = line[:, : box.shape[1], None]
    box.copy_((box * (1 - ink) + _INK * ink).round())


def add_legend(image: Tensor, legend: Legend, pixels_per_unit: float) -> Tensor:
    """Return an image ``(H, W, 3)`` with a legend below it; unchanged if too narrow for one.

    The scale bar has ``pixels_per_unit`` pixels per unit of the cloud, at the center of the scene.
    """
    entries = legend.entries
    scale = max(1, round(image.shape[1] / (5 * _COLUMN)))
    width = image.shape[1] // scale
    num_columns = (width - _GAP) // _COLUMN
    if num_columns == 0:
        return image
    num_rows = 1 + math.ceil((1 + len(entries)) / num_columns)
    strip = torch.full((num_rows * _ROW + _GAP, width, 3), _PAPER, dtype=torch.uint8)
    _write(strip, legend.title, _GAP // 2, _GAP)
    length, bar = _scale_bar(pixels_per_unit / scale)
    top = _ROW + _ROW // 2
    strip[top - 2 : top + 2, _GAP : _GAP + bar] = _INK
    strip[top - 6 : top + 6, [_GAP, _GAP + bar - 1]] = _INK
    _write(strip, f"{length:g} {legend.unit} (center)", _ROW + 2, _GAP + bar + _GAP)
    for number, (color, text) in enumerate(entries, start=1):
        row, column = divmod(number, num_columns)
        top, left = (row + 1) * _ROW, _GAP + column * _COLUMN
        strip[top + 6 : top + 6 + _CHIP, left : left + _CHIP] = color.cpu()
        cell = strip[:, : left + _COLUMN - _GAP]
        _write(cell, text, top + 2, left + _CHIP + _GAP)
    strip = strip.repeat_interleave(scale, dim=0).repeat_interleave(scale, dim=1)
    strip = torch.nn.functional.pad(strip, (0, 0, 0, image.shape[1] - strip.shape[1]), value=_PAPER)
    return torch.cat([image, strip.to(image.device)])


def _scale_bar(pixels_per_unit: float) -> tuple[float, int]:
    """Return the length of the scale bar, 1, 2 or 5 times a power of ten, and its pixels."""
    power = 10.0 ** math.floor(math.log10(_MAX_BAR / pixels_per_unit))
    length = max(step * power for step in (1, 2, 5) if step * power * pixels_per_unit <= _MAX_BAR)
    return length, round(length * pixels_per_unit)
