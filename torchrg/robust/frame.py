"""Coordinates of many patches brought to one size about one middle, and back."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrg.robust.flats import flatness_tolerance
from torchrg.robust.lanes import join_columns, median_points, split_columns


class Frame(NamedTuple):
    """Where lanes lie in their patches: ``point = (lane / zoom + middle) / unit``.

    The factors are powers of two, which change no digit.
    """

    middle: Tensor
    unit: Tensor
    zoom: Tensor

    def of(self, rows: Tensor) -> "Frame":
        """The frames of some of the patches."""
        return Frame(*(field[rows] for field in self))

    def point(self, lanes: Tensor) -> Tensor:
        """Bring points ``(B, P)`` back to the coordinates of their patches."""
        return (lanes / self.zoom[:, None] + self.middle) / self.unit[:, None]

    def matrix(self, lanes: Tensor) -> Tensor:
        """Bring scatter matrices ``(B, P, P)`` back to the unit of their patches."""
        length = (self.zoom * self.unit)[:, None, None]
        return lanes / length / length


def to_lanes(patches: Tensor) -> tuple[list[Tensor], Frame, Tensor]:
    """Columns about each patch's median, of size 1/2 to 1, with their frame and tolerance."""
    unit = _power_of_two(patches.abs().amax(dim=(1, 2)))
    patches = patches * unit[:, None, None]
    columns = split_columns(patches)
    middle = [median_points(column) for column in columns]
    columns = [column - center for column, center in zip(columns, middle, strict=True)]
    extent = torch.stack([column.abs().amax(dim=0) for column in columns]).amax(dim=0)
    zoom = _power_of_two(extent)
    tolerance = flatness_tolerance(patches, extent) * zoom
    columns = [column * zoom for column in columns]
    return columns, Frame(join_columns(middle), unit, zoom), tolerance


def _power_of_two(length: Tensor) -> Tensor:
    """The power of two that brings a length to between 1/2 and 1; a finite one for zero."""
    length = length.clamp(min=4 * torch.finfo(length.dtype).tiny)
    return torch.frexp(length).mantissa / length
