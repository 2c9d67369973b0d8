"""Poses and times from text files."""

from bisect import bisect_left
from pathlib import Path

import torch
from torch import Tensor

from torchrg.errors import FormatError

MOST_SECONDS = 0.02
"""Images and poses further apart in time do not belong together."""


def read_matrix(path: Path) -> Tensor:
    """Read a matrix of four rows of four numbers.

    Args:
        path: A text file.

    Returns:
        Shape ``(4, 4)``, float64.

    Raises:
        FormatError: If the file is missing or holds something else.
    """
    rows = _rows(path)
    if [len(row) for row in rows] != [4] * 4:
        raise FormatError(f"{path}: expected 4 rows of 4 numbers, got {len(rows)} rows.")
    return torch.tensor(_numbers(path, rows), dtype=torch.float64)


def read_timed(path: Path) -> tuple[list[float], list[str]]:
    """Read a list of times and file names.

    Args:
        path: A text file with a time and a name in each row; ``#`` begins a comment.

    Returns:
        Times, ascending, and names.

    Raises:
        FormatError: If the file is missing or holds something else.
    """
    rows = _rows(path)
    if not rows or any(len(row) != 2 for row in rows):
        raise FormatError(f"{path}: expected a time and a file name in each row.")
    times = [row[0] for row in _numbers(path, [[row[0]] for row in rows])]
    order = sorted(range(len(times)), key=times.__getitem__)
    return [times[i] for i in order], [rows[i][1] for i in order]


def read_trajectory(path: Path) -> tuple[list[float], Tensor]:
    """Read poses by time.

    Args:
        path: A text file with ``time tx ty tz qx qy qz qw`` in each row; ``#`` begins a comment.

    Returns:
        Times, ascending, and matrices from camera to world, shape ``(n, 4, 4)``, float64.

    Raises:
        FormatError: If the file is missing or holds something else.
    """
    rows = _rows(path)
    if not rows or any(len(row) != 8 for row in rows):
        raise FormatError(f"{path}: expected time tx ty tz qx qy qz qw in each row.")
    values = torch.tensor(_numbers(path, rows), dtype=torch.float64)
    values = values[values[:, 0].argsort(stable=True)]
    poses = torch.eye(4, dtype=torch.float64).repeat(len(values), 1, 1)
    poses[:, :3, :3] = _rotations(values[:, 4:])
    poses[:, :3, 3] = values[:, 1:4]
    return values[:, 0].tolist(), poses


def nearest_times(times: list[float], others: list[float]) -> list[int | None]:
    """Return the place of the nearest of ascending times, None where it is too far.

    Example:
        >>> nearest_times([1.0, 2.0], [0.5, 0.99, 1.0625, 2.5])
        [1, None]
    """
    found: list[int | None] = []
    for time in times:
        place = bisect_left(others, time)
        around = [i for i in (place - 1, place) if 0 <= i < len(others)]
        best = min(around, key=lambda i: abs(others[i] - time), default=None)
        near = best is not None and abs(others[best] - time) <= MOST_SECONDS
        found.append(best if near else None)
    return found


def _rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices of quaternions x y z w of any length, shape ``(n, 3, 3)``."""
    x, y, z, w = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(dim=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def _rows(path: Path) -> list[list[str]]:
    """Return the words of each row that is not a comment."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: expected text, got other bytes.") from error
    words = (line.split("#")[0].replace(",", " ").split() for line in lines)
    return [row for row in words if row]


def _numbers(path: Path, rows: list[list[str]]) -> list[list[float]]:
    """Return words as numbers."""
    try:
        return [[float(word) for word in row] for row in rows]
    except ValueError as error:
        raise FormatError(f"{path}: expected numbers: {error}.") from error
