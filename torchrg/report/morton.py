"""Morton codes: three coordinates of 16 bits woven into one number."""

from torch import Tensor

_SPREADS = ((16, 0xFF0000FF), (8, 0xF00F00F00F), (4, 0xC30C30C30C3), (2, 0x249249249249))
_EVERY_THIRD = _SPREADS[-1][1]


def spread_bits(values: Tensor) -> Tensor:
    """Put two zero bits between the bits of numbers below 2**16.

    Example:
        >>> import torch
        >>> spread_bits(torch.tensor([0b111])).tolist() == [0b1001001]
        True
    """
    for shift, pattern in _SPREADS:
        values = (values | values << shift) & pattern
    return values


def gather_bits(codes: Tensor) -> Tensor:
    """Return every third bit of codes, the inverse of :func:`spread_bits`.

    Example:
        >>> import torch
        >>> gather_bits(spread_bits(torch.tensor([54321])) | 0b110).tolist()
        [54321]
    """
    codes = codes & _EVERY_THIRD
    patterns = [pattern for _, pattern in _SPREADS[-2::-1]] + [0xFFFF]
    for (shift, _), pattern in zip(reversed(_SPREADS), patterns, strict=True):
        codes = (codes | codes >> shift) & pattern
    return codes


def shift_codes(codes: Tensor, axis: int) -> Tensor:
    """Return the codes of the cubes one further along an axis; past the last one comes the first.

    Example:
        >>> import torch
        >>> shift_codes(torch.tensor([0b000, 0b010, 0b101]), 0).tolist()
        [1, 3, 12]
    """
    mask = _EVERY_THIRD << axis
    moved = ((codes | ~mask) + (1 << axis)) & mask
    return (codes & ~mask) | moved
