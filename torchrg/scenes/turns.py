"""Arcs and turns about an axis: what cones and rings share."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchrg.scenes.frames import Array, Frame, cos_sin

FULL_TURN = 2 * np.pi
SLACK = 1e-9  # rays through a seam must not slip between two pieces; relative

Turn = tuple[float, float]


def solve_quadratic(a: Array, b: Array, c: Array) -> list[Array]:
    """Return both solutions of ``a t^2 + 2 b t + c = 0``, shape ``(N,)`` each; NaN for none.

    Example:
        >>> [float(t[0]) for t in solve_quadratic(*np.array([[1.0], [-3], [5]]))]
        [5.0, 1.0]
    """
    discriminant = b * b - a * c
    root = np.sqrt(np.where(discriminant >= 0, discriminant, np.nan))
    far = -(b + np.where(b < 0, -root, root))
    with np.errstate(divide="ignore", invalid="ignore"):
        return [far / a, c / far]


def within_turn(x: Array, y: Array, turn: Turn) -> NDArray[np.bool_]:
    """Return which directions are in a range of angles, both ends included.

    Example:
        >>> within_turn(np.array([1.0, -1]), np.array([1.0, 0]), (0, np.pi / 2)).tolist()
        [True, False]
    """
    inside: NDArray[np.bool_] = (
        np.mod(np.arctan2(y, x) - turn[0] + SLACK, FULL_TURN) <= turn[1] - turn[0] + 2 * SLACK
    )
    return inside


def draw_angles(rng: np.random.Generator, count: int, turn: Turn) -> Array:
    """Return random angles within a turn, shape ``(count,)``."""
    return turn[0] + (turn[1] - turn[0]) * rng.random(count)


def extremes(turn: Turn) -> tuple[Array, Array]:
    """Return cosines and sines of the ends of a turn and of the quarters between them."""
    quarters = np.arange(-8, 9) * (np.pi / 2)
    between = quarters[(quarters > turn[0]) & (quarters < turn[1])]
    return cos_sin(np.concatenate([turn, between]))


def turned_box(frame: Frame, radii: ArrayLike, heights: ArrayLike, turn: Turn) -> Array:
    """Return a box around what circles of some radii at some heights sweep, shape ``(2, 3)``."""
    cosines, sines = extremes(turn)
    distances = np.asarray(radii)[:, None]
    x, y = distances * cosines, distances * sines
    spans = [(values.min(), values.max()) for values in (x, y, np.asarray(heights))]
    corners = np.stack(np.meshgrid(*spans), axis=-1).reshape(-1, 3)
    world = frame.to_world(corners)
    return np.stack([world.min(axis=0), world.max(axis=0)])
