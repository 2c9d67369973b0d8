"""Closed shapes with exact normals: what normal estimators are compared on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from tests.made.curved import Cone, Ring
from torchrg.scenes import Scene, SceneModel, sample_scene
from torchrg.scenes.geometry import Doubles, Frame, box_around, unit
from torchrg.scenes.parts import block
from torchrg.scenes.scene import NoiseDirection, Part
from torchrg.scenes.surfaces import Flat, PlaneEquation, Surface, append_zero, rectangle

_HERE = Frame.upright(np.zeros(3))
_QUARTER = np.pi / 2


def make_shape(
    name: str,
    num_points: int = 30_000,
    noise_fraction: float = 0.0,
    seed: int = 0,
    *,
    noise_direction: NoiseDirection = "isotropic",
) -> Scene:
    """Make a cloud of one of ``SHAPES``, of a size of about one, with outward normals.

    The standard deviation of the noise, along each coordinate or along the normal, is a share of
    the diagonal of the box around the shape.

    Example:
        >>> cube = make_shape("cube", 1000)
        >>> float(cube.points.abs().max()), len(cube.kinds)
        (0.5, 6)
    """
    model = SceneModel((Part(SHAPES[name]()),))
    low, high = box_around(np.concatenate([surface.bounds for surface in model.surfaces]))
    noise = noise_fraction * float(np.sqrt(((high - low) ** 2).sum()))
    return sample_scene(model, num_points, noise=noise, seed=seed, noise_direction=noise_direction)


class Fan(Flat):
    """A union of triangles in one plane, each half of a cell."""

    @property
    def area(self) -> float:
        """Its area."""
        return float((self._cell_areas / 2).sum())

    def _corners(self) -> Doubles:
        corner, first, second = self.cells.swapaxes(0, 1)
        return append_zero(np.concatenate([corner, corner + first, corner + second]))

    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
        counts = rng.multinomial(count, self._cell_areas / self._cell_areas.sum())
        fractions = rng.random((2, count))
        first, second = np.where(fractions.sum(axis=0) > 1, 1 - fractions, fractions)
        corner, edge, other = self.cells[np.repeat(np.arange(len(counts)), counts)].swapaxes(0, 1)
        return append_zero(corner + (first[:, None] * edge + second[:, None] * other))


@dataclass(frozen=True, eq=False)
class Outline:
    """A polygon whose corners may be rounded, with round holes.

    Args:
        corners: Counterclockwise, shape ``(M, 2)``.
        radii: Radius at each corner, 0 for a sharp one, shape ``(M,)``; inward corners are rounded
            by fillets.
        holes: Each as (x, y, radius); they meet neither each other nor the edge.
    """

    corners: Doubles
    radii: Doubles
    holes: Sequence[tuple[float, float, float]] = ()

    @cached_property
    def ways(self) -> tuple[Doubles, Doubles]:
        """Unit vectors along the edge into and out of each corner, shape ``(M, 2)`` each."""
        edges = np.roll(self.corners, -1, axis=0) - self.corners
        out = edges / np.sqrt((edges * edges).sum(axis=1))[:, None]
        return np.roll(out, 1, axis=0), out

    @cached_property
    def turns(self) -> tuple[Doubles, Doubles]:
        """Sine, positive to the left, and cosine of the turn at each corner, ``(M,)`` each."""
        into, out = self.ways
        return into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], (into * out).sum(axis=1)

    @cached_property
    def arcs(self) -> tuple[Doubles, Doubles, Doubles]:
        """Start ``(M, 2)``, middle ``(M, 2)`` and unsigned angle ``(M,)`` of each rounding."""
        into, (sines, cosines) = self.ways[0], self.turns
        left = np.stack([-into[:, 1], into[:, 0]], axis=1)
        starts = self.corners - self.tangents[:, None] * into
        middles = starts + (np.sign(sines) * self.radii)[:, None] * left
        return starts, middles, np.arctan2(np.abs(sines), cosines)

    @cached_property
    def tangents(self) -> Doubles:
        """Distance from each corner to where its rounding starts, shape ``(M,)``."""
        sines, cosines = self.turns
        reach: Doubles = self.radii * np.abs(sines) / (1 + cosines)  # tan(turn / 2)
        return reach

    @cached_property
    def area(self) -> float:
        """Area inside."""
        x, y = self.corners.T
        whole = ((x * np.roll(y, -1)) - np.roll(x, -1) * y).sum() / 2
        # Between a corner and its arc: a kite less a sector.
        cut = self.radii * self.tangents - self.radii**2 * self.arcs[2] / 2
        holes = sum(np.pi * radius**2 for _, _, radius in self.holes)
        return float(whole - (np.sign(self.turns[0]) * cut).sum() - holes)

    def contains(self, x: Doubles, y: Doubles) -> NDArray[np.bool_]:
        """Return which places, of shape ``(N,)``, are inside."""
        inside, places, (_, out) = _in_polygon(x, y, self.corners), np.stack([x, y], 1), self.ways
        starts, middles, _ = self.arcs
        ends = self.corners + self.tangents[:, None] * out
        for row in np.flatnonzero(self.radii):
            kite = np.stack([starts[row], self.corners[row], ends[row], middles[row]])
            beyond = ((places - middles[row]) ** 2).sum(axis=1) > self.radii[row] ** 2
            between = _in_polygon(x, y, kite) & beyond
            inside = np.where(between, self.turns[0][row] < 0, inside)
        for *middle, radius in self.holes:
            inside &= ((places - middle) ** 2).sum(axis=1) >= radius**2
        return inside


def _in_polygon(x: Doubles, y: Doubles, corners: Doubles) -> NDArray[np.bool_]:
    """Return which places are inside a polygon: a line to the right crosses it an odd number."""
    inside = np.zeros(len(x), dtype=bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return inside


@dataclass(frozen=True, eq=False)
class Sheet(Surface):
    """The flat inside of an outline in the plane of a frame's first two axes."""

    outline: Outline

    @property
    def plane(self) -> PlaneEquation:
        """Normal and offset of its plane."""
        return self.frame.axes[2], float(np.vecdot(self.frame.axes[2], self.frame.origin))

    @property
    def area(self) -> float:
        """Its area."""
        return self.outline.area

    def normals_at(self, points: Doubles) -> Doubles:
        """Return the outward unit normal at each point, shape ``(N, 3)``."""
        return np.broadcast_to(self.frame.axes[2], points.shape)

    def _corners(self) -> Doubles:
        return append_zero(self.outline.corners)

    def _draw(self, rng: np.random.Generator, count: int) -> Doubles:
        low, high = box_around(self.outline.corners)
        drawn, missing = [np.zeros((0, 2))], count
        while missing > 0:
            tried = low + (high - low) * rng.random((2 * missing + 16, 2))
            drawn.append(tried[self.outline.contains(*tried.T)][:missing])
            missing -= len(drawn[-1])
        return append_zero(np.concatenate(drawn))


def extrude(outline: Outline, height: float) -> tuple[Surface, ...]:
    """Return the faces of a body with the same outline at every height.

    These are the bottom, the top, the straight sides, the roundings, the holes.
    """
    mirrored = Outline(
        (outline.corners * [1, -1])[::-1],
        outline.radii[::-1],
        [(x, -y, radius) for x, y, radius in outline.holes],
    )
    upside_down = Frame(_HERE.origin, _HERE.axes * np.array([[1], [-1], [-1]]))
    faces: list[Surface] = [
        Sheet("side", upside_down, mirrored),
        Sheet("side", _HERE.moved(0, 0, height), outline),
    ]
    after = outline.corners + outline.tangents[:, None] * outline.ways[1]
    before, middles, angles = outline.arcs
    for start, end in zip(after, np.roll(before, -1, axis=0), strict=True):
        edge = end - start
        span = Frame.spanned(np.array([*start, 0]), np.array([*edge, 0]), np.array([0, 0, 1.0]))
        span = span.inside(_HERE)
        faces.append(rectangle("side", span, float(np.sqrt((edge * edge).sum())), height))
    for row in np.flatnonzero(outline.radii * outline.turns[0]):
        # From the first point of the arc the turn is to the left, or for a fillet to the right:
        # then the third axis points down, so up is towards negative heights.
        side = int(np.sign(outline.turns[0][row]))
        x, y = before[row] - middles[row]
        span = Frame.spanned(
            np.array([*middles[row], 0]), np.array([x, y, 0]), side * np.array([-y, x, 0])
        )
        radius, turn = float(outline.radii[row]), (0.0, float(angles[row]))
        span = span.inside(_HERE)
        faces.append(Cone("side", span, (radius, 0), (radius, side * height), turn))
    return (
        *faces,
        *(Cone("side", _HERE.moved(x, y), (r, height), (r, 0)) for x, y, r in outline.holes),
    )


def _box(*size: float) -> tuple[Surface, ...]:
    """Return a block about the origin."""
    x, y, z = size
    return block("side", _HERE.moved(0, 0, -z / 2), (x, y, z)).surfaces


def _convex(corners: Doubles, directions: Doubles) -> tuple[Surface, ...]:
    """Return the faces of a convex body, from its corners and a normal of each face."""
    faces: list[Surface] = []
    for normal in unit(directions):
        heights = corners @ normal
        face = corners[heights > heights.max() - 1e-6]
        frame = Frame.spanned(face.mean(axis=0), face[0] - face.mean(axis=0), face[1] - face[0])
        x, y, z = (*frame.to_local(face).T[:2], frame.axes[2] @ normal)
        ring = face[np.argsort(np.arctan2(y * np.sign(z), x))]
        frame = Frame.spanned(ring[0], ring[1] - ring[0], ring[2] - ring[0])
        flat = frame.to_local(ring)[:, :2]
        fan = [[(0.0, 0.0), tuple(left), tuple(right)] for left, right in pairwise(flat[1:])]
        faces.append(Fan("side", frame, np.array(fan)))
    return tuple(faces)


def _signs(*values: float) -> Doubles:
    """Return the vector with all signs of its components, each once."""
    return np.unique(np.array(list(product(*((-value, value) for value in values)))), axis=0)


def _cycled(corners: Doubles) -> Doubles:
    """Return vectors with their components moved on by none, one and two places."""
    return np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])


def _dodecahedron() -> tuple[Surface, ...]:
    golden = (1 + np.sqrt(5)) / 2
    corners = np.concatenate([_signs(1, 1, 1), _cycled(_signs(0, 1 / golden, golden))])
    return _convex(corners * 0.35, _cycled(_signs(0, golden, 1)))


def _hexagonal_prism() -> tuple[Surface, ...]:
    angles = np.arange(6) * (np.pi / 3)
    corners = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return extrude(Outline(corners, np.zeros(6)), 0.7)


def _bracket() -> tuple[Surface, ...]:
    """Return an angle with a rounded heel, a fillet, one rounded toe and one sharp."""
    corners = np.array([(0, 0), (1, 0), (1, 0.25), (0.25, 0.25), (0.25, 0.9), (0, 0.9)])
    return extrude(Outline(corners, np.array([0.2, 0, 0.1, 0.12, 0, 0])), 0.5)


def _stairs() -> tuple[Surface, ...]:
    steps = [(1, 0), (1, 0.2), (0.75, 0.2), (0.75, 0.4), (0.5, 0.4), (0.5, 0.6), (0.25, 0.6)]
    corners = np.array([(0, 0), *steps, (0.25, 0.8), (0, 0.8)])
    return extrude(Outline(corners, np.zeros(len(corners))), 0.6)


def _plate() -> tuple[Surface, ...]:
    """Return a plate with two rounded and two sharp corners and two holes."""
    corners = np.array([(0, 0), (1, 0), (1, 0.7), (0, 0.7)])
    holes = [(0.3, 0.35, 0.15), (0.72, 0.35, 0.1)]
    return extrude(Outline(corners, np.array([0.15, 0.15, 0, 0]), holes), 0.15)


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


def _lathe(*profile: tuple[float, float]) -> tuple[Surface, ...]:
    """Return a body turned from a profile, from the lower to the upper end of its axis."""
    return tuple(Cone("side", _HERE, start, end) for start, end in pairwise(profile))


SHAPES: dict[str, Callable[[], tuple[Surface, ...]]] = {
    "cube": lambda: _box(1, 1, 1),
    "cuboid": lambda: _box(1, 0.6, 0.35),
    "thin_plate": lambda: _box(1, 0.8, 0.02),
    "octahedron": lambda: _convex(_cycled(_signs(0.7, 0, 0)), _signs(1, 1, 1)),
    "dodecahedron": _dodecahedron,
    "hexagonal_prism": _hexagonal_prism,
    "stairs": _stairs,
    "bracket": _bracket,
    "plate": _plate,
    "rounded_box": _rounded_box,
    "cylinder": lambda: _lathe((0, -0.5), (0.3, -0.5), (0.3, 0.5), (0, 0.5)),
    "sphere": lambda: (Ring("ball", _HERE, 0, 0.5),),
    "torus": lambda: (Ring("torus", _HERE, 0.35, 0.15, (-np.pi, np.pi)),),
}
"""The shapes :func:`make_shape` knows, each with what builds it."""
