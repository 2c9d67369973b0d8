"""Closed shapes with exact normals: what normal estimators are compared on."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tests.made.extrusions import Outline, extrude
from torchrg.errors import ConfigError
from torchrg.scenes import (
    Array,
    Cone,
    Flat,
    Frame,
    Part,
    Ring,
    Scene,
    SceneModel,
    Surface,
    block,
    rectangle,
    sample_scene,
    unit,
)

_NODES = 96
"""Of the quadrature for the area."""
_STEPS = 512
"""Along a ray; a graze shorter than one of them is not seen."""
_HALVINGS = 48
"""Of a step, to find where it crosses the surface."""


@dataclass(frozen=True, eq=False)
class Bumpy:
    """A ball whose radius goes up and down with the direction.

    In the direction d from the middle the radius is ``radius (1 + sum_i a_i T_n(d . e_i))`` with
    Chebyshev polynomials of some degree n: ``T_n(cos t) = cos(n t)``, waves about the axes e_i.

    Args:
        kind: What it is part of.
        frame: The middle, and the axes of the directions.
        radius: Without bumps.
        axes: Unit vectors e_i, shape ``(B, 3)``.
        heights: Of the waves in radii, a_i, shape ``(B,)``; their sum is below one.
        degree: Number of waves along a great circle through their axis.

    Example:
        >>> ball = Bumpy("ball", Frame.upright(np.zeros(3)), 0.5, np.eye(3), np.zeros(3), 4)
        >>> abs(ball.area - np.pi) < 1e-12
        True
    """

    kind: str
    frame: Frame
    radius: float
    axes: Array
    heights: Array
    degree: int

    plane = None

    @cached_property
    def area(self) -> float:
        """Its area, by quadrature."""
        z, weights = np.polynomial.legendre.leggauss(_NODES)
        angle, flat = np.arange(2 * _NODES) * (np.pi / _NODES), np.sqrt(1 - z * z)[:, None]
        sides = (flat * np.cos(angle), flat * np.sin(angle), z[:, None])
        towards = np.stack(np.broadcast_arrays(*sides), axis=-1)
        elements = self._elements(towards.reshape(-1, 3)).reshape(_NODES, 2 * _NODES)
        return float((elements * weights[:, None]).sum() * np.pi / _NODES)

    @property
    def bounds(self) -> Array:
        """Lowest and highest coordinates of a box around it, shape ``(2, 3)``."""
        reach = self.radius * (1 + np.abs(self.heights).sum())
        return np.stack([self.frame.origin - reach, self.frame.origin + reach])

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Return points spread evenly over it, shape ``(count, 3)``."""
        total = np.abs(self.heights).sum()
        reach, slope = self.radius * (1 + total), self.radius * total * self.degree
        most = reach * np.sqrt(reach * reach + slope * slope)
        drawn, missing = [np.zeros((0, 3))], count
        while missing > 0:
            towards = unit(rng.standard_normal((2 * missing + 16, 3)))
            kept = rng.random(len(towards)) * most < self._elements(towards)
            drawn.append(towards[kept][:missing])
            missing -= len(drawn[-1])
        towards = np.concatenate(drawn)
        return self.frame.to_world(self._radius(towards)[0][:, None] * towards)

    def normals_at(self, points: Array) -> Array:
        """Return the outward unit normals at points on it, shape ``(N, 3)``."""
        towards = unit(self.frame.to_local(points))
        radius, slope = self._radius(towards)
        return self.frame.vectors_to_world(unit(radius[:, None] * towards - slope))

    def intersect(self, origins: Array, directions: Array) -> Array:
        """Return how far along each ray it is first met, shape ``(N,)``; infinite where never.

        The ray is followed in small steps, so that it may miss what it only grazes.
        """
        start, step = self.frame.to_local(origins), self.frame.vectors_to_local(directions)
        near, far = self._entry_and_exit(start, step)
        nearest = np.full(len(step), np.inf)
        rows = np.flatnonzero(far > near)
        start = np.broadcast_to(start, step.shape)[rows]
        step, near, far = step[rows], near[rows], far[rows]
        width = (far - near) / _STEPS
        first = np.full(len(rows), _STEPS)
        outside = self._is_outside(start, step, near)
        for number in range(1, _STEPS + 1):
            crossed = self._is_outside(start, step, near + number * width) != outside
            first = np.where(crossed, np.minimum(first, number - 1), first)
        before = near + first * width
        found = self._crossing(start, step, before, before + width, outside)
        nearest[rows] = np.where(first < _STEPS, found, np.inf)
        return nearest

    def _entry_and_exit(self, start: Array, step: Array) -> tuple[Array, Array]:
        """Return where rays are inside the ball around the body; exit before entry if never."""
        reach = self.radius * (1 + np.abs(self.heights).sum())
        a, b = np.vecdot(step, step), np.vecdot(start, step)
        discriminant = b * b - a * (np.vecdot(start, start) - reach * reach)
        half = np.sqrt(np.maximum(discriminant, 0))
        far = np.where(discriminant > 0, (half - b) / a, -np.inf)
        return np.maximum((-half - b) / a, 0), far

    def _is_outside(self, start: Array, step: Array, distance: Array) -> NDArray[np.bool_]:
        """Return whether places along rays are outside of the body."""
        places = start + distance[:, None] * step
        lengths = np.sqrt(np.vecdot(places, places))
        outside: NDArray[np.bool_] = lengths > self._radius(places / lengths[:, None])[0]
        return outside

    def _crossing(
        self, start: Array, step: Array, before: Array, after: Array, outside: NDArray[np.bool_]
    ) -> Array:
        """Return where rays cross the surface between two places, by halving."""
        for _ in range(_HALVINGS):
            middle = (before + after) / 2
            same = self._is_outside(start, step, middle) == outside
            before, after = np.where(same, middle, before), np.where(same, after, middle)
        return (before + after) / 2

    def _radius(self, towards: Array) -> tuple[Array, Array]:
        """Return radius ``(N,)`` and its slope on the unit sphere ``(N, 3)`` in directions."""
        radius, slope = np.ones(len(towards)), np.zeros(towards.shape)
        for axis, height in zip(self.axes, self.heights, strict=True):
            value, derivative = _chebyshev(np.vecdot(towards, axis), self.degree)
            radius += height * value
            across = axis - np.vecdot(towards, axis)[:, None] * towards
            slope += (height * derivative)[:, None] * across
        return self.radius * radius, self.radius * slope

    def _elements(self, towards: Array) -> Array:
        """Return the area of the surface by solid angle in directions, shape ``(N,)``."""
        radius, slope = self._radius(towards)
        elements: Array = radius * np.sqrt(radius * radius + np.vecdot(slope, slope))
        return elements


def _chebyshev(x: Array, degree: int) -> tuple[Array, Array]:
    """Return the Chebyshev polynomial of a degree and its derivative, by their recurrences."""
    lower, value = np.ones_like(x), x
    lower_derivative, derivative = np.zeros_like(x), np.ones_like(x)
    for _ in range(degree - 1):
        following = 2 * value + 2 * x * derivative - lower_derivative
        lower_derivative, derivative = derivative, following
        lower, value = value, 2 * x * value - lower
    return value, derivative


_HERE = Frame.upright(np.zeros(3))
_QUARTER = np.pi / 2
_VIEWPOINT = np.array([[1.5, -2.0, 1.5]])


def make_shape(
    name: str,
    num_points: int = 100_000,
    noise_fraction: float = 0.0,
    seed: int = 0,
    *,
    noise_direction: Literal["normal", "isotropic"] = "isotropic",
) -> Scene:
    """Make a cloud of a closed shape of about unit size with exact outward normals.

    Args:
        name: One of ``SHAPES``.
        num_points: Number of points, spread evenly.
        noise_fraction: Standard deviation of the noise, as a share of the diagonal of the box
            around the shape.
        seed: Two calls with equal arguments give equal clouds.
        noise_direction: ``"isotropic"``: that deviation along each coordinate; ``"normal"``:
            along the normal only.

    Returns:
        The cloud and its truth.

    Raises:
        ConfigError: If there is no such shape, or a setting is not allowed.

    Example:
        >>> cube = make_shape("cube", 1000)
        >>> float(cube.points.abs().max()), len(cube.kinds)
        (0.5, 6)
    """
    if name not in SHAPES:
        names = ", ".join(SHAPES)
        raise ConfigError(f"make_shape: expected name to be one of {names}, got {name!r}.")
    model = SceneModel((Part(SHAPES[name]()),), _VIEWPOINT)
    diagonal = float(np.sqrt(((model.bounds[1] - model.bounds[0]) ** 2).sum()))
    return sample_scene(
        model,
        num_points,
        noise=noise_fraction * diagonal,
        seed=seed,
        noise_direction=noise_direction,
    )


def _box(*size: float) -> tuple[Surface, ...]:
    """Return a block about the origin."""
    x, y, z = size
    return block("side", _HERE.moved(0, 0, -z / 2), (x, y, z)).surfaces


def _convex(corners: Array, directions: Array) -> tuple[Surface, ...]:
    """Return the faces of a convex body, given its corners and a normal of each face."""
    faces: list[Surface] = []
    for normal in unit(directions):
        heights = corners @ normal
        face = corners[heights > heights.max() - 1e-6]
        frame = Frame.spanned(face.mean(axis=0), face[0] - face.mean(axis=0), face[1] - face[0])
        x, y, z = (*frame.to_local(face).T[:2], frame.axes[2] @ normal)
        faces.append(_polygon("side", face[np.argsort(np.arctan2(y * np.sign(z), x))]))
    return tuple(faces)


def _polygon(kind: str, corners: Array) -> Flat:
    """Return a convex polygon, given its corners counterclockwise seen from outside."""
    frame = Frame.spanned(corners[0], corners[1] - corners[0], corners[2] - corners[0])
    flat = frame.to_local(corners)[:, :2]
    fan = [[(0.0, 0.0), tuple(left), tuple(right)] for left, right in pairwise(flat[1:])]
    return Flat(kind, frame, np.array(fan), triangular=True)


def _signs(*values: float) -> Array:
    """Return the vector with all signs of its components, each once."""
    return np.unique(np.array(list(product(*((-value, value) for value in values)))), axis=0)


def _cycled(corners: Array) -> Array:
    """Return vectors with their components moved on by none, one and two places."""
    return np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])


def _octahedron() -> tuple[Surface, ...]:
    return _convex(_cycled(_signs(0.7, 0, 0)), _signs(1, 1, 1))


def _dodecahedron() -> tuple[Surface, ...]:
    golden = (1 + np.sqrt(5)) / 2
    corners = np.concatenate([_signs(1, 1, 1), _cycled(_signs(0, 1 / golden, golden))])
    return _convex(corners * 0.35, _cycled(_signs(0, golden, 1)))


def _hexagonal_prism() -> tuple[Surface, ...]:
    angles = np.arange(6) * (np.pi / 3)
    corners = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return extrude("side", _HERE, Outline(corners, np.zeros(6)), 0.7)


def _bracket() -> tuple[Surface, ...]:
    """Return an angle with a rounded heel, a fillet, one rounded toe and one sharp."""
    corners = np.array([(0, 0), (1, 0), (1, 0.25), (0.25, 0.25), (0.25, 0.9), (0, 0.9)])
    return extrude("side", _HERE, Outline(corners, np.array([0.2, 0, 0.1, 0.12, 0, 0])), 0.5)


def _stairs() -> tuple[Surface, ...]:
    steps = [(1, 0), (1, 0.2), (0.75, 0.2), (0.75, 0.4), (0.5, 0.4), (0.5, 0.6), (0.25, 0.6)]
    corners = np.array([(0, 0), *steps, (0.25, 0.8), (0, 0.8)])
    return extrude("side", _HERE, Outline(corners, np.zeros(len(corners))), 0.6)


def _plate() -> tuple[Surface, ...]:
    """Return a plate with two rounded and two sharp corners and two holes."""
    corners = np.array([(0, 0), (1, 0), (1, 0.7), (0, 0.7)])
    holes = [(0.3, 0.35, 0.15), (0.72, 0.35, 0.1)]
    return extrude("side", _HERE, Outline(corners, np.array([0.15, 0.15, 0, 0]), holes), 0.15)


def _rounded_box() -> tuple[Surface, ...]:
    half, radius = np.array([0.5, 0.35, 0.25]), 0.1
    inner, faces = half - radius, list[Surface]()
    for axis, sign in product(range(3), (-1, 1)):
        first, second = np.roll(np.eye(3), axis, axis=1)[1:]
        second = second * sign
        a, b = inner[(axis + 1) % 3], inner[(axis + 2) % 3]
        middle = sign * half[axis] * np.eye(3)[axis]
        frame = Frame.spanned(middle - a * first - b * second, first, second)
        faces.append(rectangle("side", frame, 2 * a, 2 * b))
    for axis, first_sign, second_sign in product(range(3), (-1, 1), (-1, 1)):
        first, second = np.roll(np.eye(3), axis, axis=1)[1:] * [[first_sign], [second_sign]]
        middle = np.abs(first) * inner * first_sign + np.abs(second) * inner * second_sign
        frame, reach = Frame.spanned(middle, first, second), float(inner[axis])
        faces.append(Cone("edge", frame, (radius, -reach), (radius, reach), (0, _QUARTER)))
    for signs in product((-1, 1), repeat=3):
        axes = np.diag(np.array(signs, dtype=np.float64))
        axes = axes if np.prod(signs) > 0 else axes[[1, 0, 2]]
        frame = Frame(inner * signs, axes)
        faces.append(Ring("corner", frame, 0, radius, (0, _QUARTER), (0, _QUARTER)))
    return tuple(faces)


def _cylinder() -> tuple[Surface, ...]:
    radius, half = 0.3, 0.5
    profile = [(0, -half), (radius, -half), (radius, half), (0, half)]
    return _lathe(profile)


def _cone() -> tuple[Surface, ...]:
    return _lathe([(0, 0), (0.4, 0), (0, 1)])


def _lathe(profile: list[tuple[float, float]]) -> tuple[Surface, ...]:
    """Return a body turned from a profile, from the lower to the upper end of its axis."""
    return tuple(Cone("side", _HERE, start, end) for start, end in pairwise(profile))


def _capsule() -> tuple[Surface, ...]:
    radius, half = 0.25, 0.3
    return (
        Ring("end", _HERE.moved(0, 0, -half), 0, radius, (-_QUARTER, 0)),
        Cone("side", _HERE, (radius, -half), (radius, half)),
        Ring("end", _HERE.moved(0, 0, half), 0, radius, (0, _QUARTER)),
    )


def _bumpy(radius: float, height: float, degree: int) -> tuple[Surface, ...]:
    """Return a ball with waves about four axes."""
    axes = unit(np.array([(1.0, 0.3, 0.2), (-0.4, 1, 0.1), (0.2, -0.3, 1), (1, 1, -1)]))
    return (Bumpy("ball", _HERE, radius, axes, np.full(4, height), degree),)


SHAPES: dict[str, Callable[[], tuple[Surface, ...]]] = {
    "cube": lambda: _box(1, 1, 1),
    "cuboid": lambda: _box(1, 0.6, 0.35),
    "thin_plate": lambda: _box(1, 0.8, 0.02),
    "octahedron": _octahedron,
    "dodecahedron": _dodecahedron,
    "hexagonal_prism": _hexagonal_prism,
    "stairs": _stairs,
    "bracket": _bracket,
    "plate": _plate,
    "rounded_box": _rounded_box,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "cone": _cone,
    "sphere": lambda: (Ring("ball", _HERE, 0, 0.5),),
    "torus": lambda: (Ring("torus", _HERE, 0.35, 0.15, (-np.pi, np.pi)),),
    "pebble": lambda: _bumpy(0.45, 0.04, 3),
    "coral": lambda: _bumpy(0.4, 0.05, 7),
}
"""The shapes :func:`make_shape` knows, each with what builds it."""
