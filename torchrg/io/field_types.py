"""The types of the fields that have a meaning: labels, normals, colours."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.structures import UNLABELED


def are_whole(values: NDArray[Any]) -> bool:
    """Whether all values are finite whole numbers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def _reach(values: NDArray[Any]) -> float:
    """Return the largest magnitude, 0 for none."""
    return float(np.abs(values.astype(np.float64)).max(initial=0))


def are_unit(rows: NDArray[Any]) -> bool:
    """Whether rows are unit vectors up to 1e-3, or zero or not numbers where there is none."""
    squares = np.square(rows.astype(np.float64)).sum(axis=1)
    rest = squares[np.isfinite(squares) & (squares != 0)]
    return len(rest) > 0 and bool((np.abs(rest - 1) < 2e-3).all())


def as_labels(path: Path, labels: NDArray[Any]) -> NDArray[np.int64]:
    """Return labels as int64, shape ``(N,)``; not-a-number means no label, as in CloudCompare."""
    flat = labels.reshape(-1) if labels.shape[1:] == (1,) else labels
    if flat.ndim != 1 or flat.dtype.kind not in "biuf":
        raise FormatError(
            f"{path}: expected one whole number a point as labels, got shape {labels.shape} "
            f"of {labels.dtype}; rename or remove that field."
        )
    if flat.dtype.kind == "f":
        flat = np.where(np.isnan(flat), flat.dtype.type(UNLABELED), flat)
    if not are_whole(flat) or (flat.dtype.kind in "uf" and _reach(flat) >= 2.0**63):
        raise FormatError(
            f"{path}: expected labels to be whole numbers of 64 bits; rename or remove that field."
        )
    return flat.astype(np.int64)


def as_normals(path: Path, normals: NDArray[Any]) -> NDArray[np.floating]:
    """Return normals as float32 or float64, shape ``(N, 3)``."""
    if normals.ndim != 2 or normals.shape[1] != 3 or normals.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected normals to be three numbers a point, got shape {normals.shape} "
            f"of {normals.dtype}; rename or remove that field."
        )
    return normals.astype(np.float64 if normals.dtype.itemsize > 4 else np.float32, copy=False)


def as_color(path: Path, color: NDArray[Any]) -> NDArray[Any]:
    """Return colours as uint8 0..255, shape ``(N, 3)``; uint16 where 8 bits do not hold them.

    Floating-point colours are 0..1 if none is larger, otherwise 0..255.
    """
    if color.ndim != 2 or color.shape[1] != 3 or color.dtype.kind not in "fiu":
        raise FormatError(
            f"{path}: expected color to be three numbers a point, got shape {color.shape} "
            f"of {color.dtype}; rename or remove that field."
        )
    if color.dtype == np.uint8 or color.size == 0:
        return color.astype(np.uint8)
    values = np.nan_to_num(color, copy=True) if color.dtype.kind == "f" else color
    low, high = values.min(), values.max()
    if low < 0 or high > (255 if color.dtype.kind == "f" else 65535):
        raise FormatError(
            f"{path}: expected color in 0..255, got {low} to {high}; rename or remove that field."
        )
    if color.dtype.kind == "f":
        scaled: NDArray[Any] = np.rint(values * 255 if high <= 1 else values)
        return scaled.astype(np.uint8)
    if high <= 255:
        return values.astype(np.uint8)
    # 65535 / 255 = 257: what eight bits become in sixteen, and back without loss.
    quotient, remainder = np.divmod(values.astype(np.uint16), np.uint16(257))
    return values.astype(np.uint16) if remainder.any() else quotient.astype(np.uint8)
