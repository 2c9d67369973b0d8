"""Local frames, arcs and turns."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Triple = tuple[float, float, float]

_QUARTER_TURN = np.pi / 2
_SINE = tuple((-1) ** n / math.factorial(2 * n + 1) for n in range(9))
_COSINE = tuple((-1) ** n / math.factorial(2 * n) for n in range(10))


def cos_sin(angles: ArrayLike) -> tuple[Array, Array]:
    """Return cosine and sine of angles by polynomials, to about one unit in the last place.

    Args:
        angles: Angles in radians, any shape, of at most a few turns.

    Returns:
        Cosines and sines of the same shape.

    Example:
        >>> cosine, sine = cos_sin(np.pi / 3)
        >>> abs(float(cosine) - 0.5) < 1e-15
        True
    """
    angles = np.asarray(angles, dtype=np.float64)
    quarter = np.rint(angles / _QUARTER_TURN)
    rest = angles - quarter * _QUARTER_TURN
    square = rest * rest
    sine, cosine = np.zeros_like(rest), np.zeros_like(rest)
    for factor in reversed(_SINE):
        sine = sine * square + factor
    for factor in reversed(_COSINE):
        cosine = cosine * square + factor
    sine = sine * rest
    turn = quarter.astype(np.int64) % 4
    return (
        np.choose(turn, [cosine, -sine, -cosine, sine]),
        np.choose(turn, [sine, cosine, -sine, -cosine]),
    )


def dot(left: Array, right: Array) -> Array:
    """Return the scalar products of vectors of shape ``(*, 3)``, added in a fixed order.

    Example:
        >>> float(dot(np.array([1.0, 2, 3]), np.array([4.0, 5, 6])))
        32.0
    """
    result: Array = (
        left[..., 0] * right[..., 0] + left[..., 1] * right[..., 1] + left[..., 2] * right[..., 2]
    )
    return result


def unit(vectors: Array) -> Array:
    """Return vectors of shape ``(*, 3)`` divided by their lengths.

    Example:
        >>> unit(np.array([0.0, 3, 4])).tolist()
        [0.0, 0.6, 0.8]
    """
    result: Array = vectors / np.sqrt(dot(vectors, vectors))[..., None]
    return result


def cross(left: Array, right: Array) -> Array:
    """Return the vector product of two vectors of shape ``(3,)``.

    Example:
        >>> cross(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])).tolist()
        [0.0, 0.0, 1.0]
    """
    a, b, c = left
    d, e, f = right
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


@dataclass(frozen=True, eq=False)
class Frame:
    """An origin and three orthonormal axes.

    Args:
        origin: Shape ``(3,)``.
        axes: The axes as rows, shape ``(3, 3)``, right-handed.

    Example:
        >>> frame = Frame.upright(np.array([1.0, 0, 0]), heading_deg=90)
        >>> frame.to_world(np.array([[2.0, 0, 5]])).round(12).tolist()
        [[1.0, 2.0, 5.0]]
    """

    origin: Array
    axes: Array

    @classmethod
    def upright(cls, origin: Array, heading_deg: float = 0.0) -> "Frame":
        """Return a frame whose third axis is up, turned about it by ``heading_deg``."""
        cosine, sine = (float(value) for value in cos_sin(heading_deg * (np.pi / 180)))
        return cls(origin, np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1.0]]))

    @classmethod
    def spanned(cls, origin: Array, first: Array, second: Array) -> "Frame":
        """Return a frame with its first axis along ``first``, whose first plane has ``second``."""
        axis0 = unit(first)
        axis1 = unit(second - dot(second, axis0) * axis0)
        return cls(origin, np.stack([axis0, axis1, cross(axis0, axis1)]))

    def placed(self, origin: Triple, first: Triple, second: Triple) -> "Frame":
        """Return another frame, given in this one by its origin and two directions."""
        local = Frame.spanned(*(np.array(v, dtype=np.float64) for v in (origin, first, second)))
        return local.inside(self)

    def to_world(self, local: Array) -> Array:
        """Return points of shape ``(N, 3)``, given in this frame, in the world."""
        world = np.empty_like(local)
        for axis in range(3):
            world[:, axis] = self.origin[axis] + (
                local[:, 0] * self.axes[0, axis]
                + local[:, 1] * self.axes[1, axis]
                + local[:, 2] * self.axes[2, axis]
            )
        return world

    def to_local(self, world: Array) -> Array:
        """Return points of shape ``(N, 3)``, given in the world, in this frame."""
        return self.turned_back(world - self.origin)

    def turned(self, local: Array) -> Array:
        """Return vectors of shape ``(N, 3)``, given in this frame, in the world."""
        return Frame(np.zeros(3), self.axes).to_world(local)

    def turned_back(self, world: Array) -> Array:
        """Return vectors of shape ``(N, 3)``, given in the world, in this frame."""
        local = np.empty_like(world)
        for axis in range(3):
            local[..., axis] = dot(world, self.axes[axis])
        return local

    def moved(self, *local: float) -> "Frame":
        """Return the same frame with its origin moved by local coordinates."""
        return Frame(self.to_world(np.array([local]))[0], self.axes)

    def inside(self, outer: "Frame") -> "Frame":
        """Return this frame, given in ``outer``, in the world of ``outer``."""
        return Frame(outer.to_world(self.origin[None])[0], outer.turned(self.axes))


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
