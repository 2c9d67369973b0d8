"""Points, their neighbors and fits as tensors and arrays."""

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.errors import MAX_SHOWN, shown

UNLABELED = -1
"""Label of points without a region."""
FARTHEST = 1e12
"""Maximum absolute coordinate; files use 1e20, 1e30 or the largest float32 for missing points."""
MAX_POINTS = 2**31 - 1
"""Maximum number of points of a cloud; neighbor lists are int32."""
Array = NDArray[Any]
"""Array of numbers or text of any shape."""
Kind = TypeVar("Kind")
Rows = slice | Tensor
"""A block of points, or row indices."""
Points = Tensor | NDArray[np.floating]
"""Coordinates or vectors, shape ``(N, 3)``, as a tensor or an array."""
Values = Tensor | NDArray[np.floating]
"""Numbers, shape ``(N,)``, as a tensor or an array."""
Labels = Tensor | NDArray[np.integer]
"""Integers, as a tensor or an array."""
Colors = Tensor | NDArray[np.generic]
"""Colors, shape ``(N, 3)``, as a tensor or an array."""
FilePath = str | os.PathLike[str]
"""Path of a file."""


def bounding_box(
    coordinates: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the minimum and maximum coordinates of points ``(N, 3)``, each ``(3,)``.

    Reduced column by column, since NumPy takes twenty times as long along rows.
    """
    columns = coordinates.T
    low, high = [column.min() for column in columns], [column.max() for column in columns]
    return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)


def local_origin(low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the origin of a cloud with this box: zero, or the center if the cloud is far away.

    A cloud is far away if centering makes its largest coordinate less than a quarter as large. A
    near cloud is not shifted, so that float32 coordinates stay bit-identical. A box that is not
    finite counts as near.
    """
    low, high = low.astype(np.float64), high.astype(np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return np.zeros(3)
    midpoint = low + (high - low) / 2
    reach, half_extent = np.abs([low, high]).max(), (high - low).max() / 2
    return midpoint if half_extent * 4 < reach else np.zeros(3)


def are_integers(values: Array) -> bool:
    """Whether all values are finite integers."""
    if values.dtype.kind in "iub":
        return True
    return bool(np.isfinite(values).all() and (values == np.floor(values)).all())


def short_repr(kind: type[Kind]) -> type[Kind]:
    """Decorate a class of results so that it prints in one line, with the shapes of its tensors."""

    def describe(result: Any) -> str:  # noqa: ANN401
        values = {name: getattr(result, name) for name in result.__match_args__}
        shown = (f"{key}={_format(value)}" for key, value in values.items() if value is not None)
        return f"{kind.__name__}({', '.join(shown)})"

    kind.__repr__ = describe  # type: ignore[method-assign]
    return kind


def _format(value: object) -> str:
    """Format a tensor by its dtype and shape, a number in four digits, and long values briefly."""
    if isinstance(value, Tensor):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, float):
        return f"{value:.4g}"
    text = "" if isinstance(value, Mapping) else repr(value)
    return text if 0 < len(text) <= MAX_SHOWN else f"a {type(value).__name__}"


class Explained:
    """Base of classes that name what to use in place of an attribute that they lack."""

    def _attributes(self) -> dict[str, str]:
        """Return the public attributes by name, in the form in which they are used."""
        return {name: name for name in dir(self) if not name.startswith("_")}


def _raise_missing(owner: Explained, name: str) -> NoReturn:
    """Raise an error that names the nearest attribute, or what replaces a name of others."""
    if name.startswith("_"):
        raise AttributeError(name)
    from torchrg._synonyms import describe_missing

    known = owner._attributes()  # noqa: SLF001 Part of this class.
    raise AttributeError(describe_missing(type(owner).__name__, name, known))


def _raise_not_indexed(owner: Explained, key: object) -> NoReturn:
    """Raise an error that names the attribute to use."""
    known, name = owner._attributes(), type(owner).__name__  # noqa: SLF001 Part of this class.
    use = known.get(key if isinstance(key, str) else "", "its attributes")
    raise TypeError(f"{name} has attributes, not items, got [{shown(key)}]; use {use}.")


Explained.__getattr__ = _raise_missing  # type: ignore[attr-defined]
Explained.__getitem__ = _raise_not_indexed  # type: ignore[misc]


@short_repr
class Neighbors(NamedTuple):
    """Nearest neighbors of each point; see :func:`torchrg.search_knn`.

    Attributes:
        indices: Rows of the neighbors, shape ``(N, K)``, int32. The first column is the point
            itself, the other columns are sorted by distance. Invalid entries are the point.
        valid: Mask of the valid entries, shape ``(N, K)``, bool; None if all are valid.
    """

    indices: Tensor
    valid: Tensor | None = None

    def select(self, rows: Rows) -> "Neighbors":
        """Return the neighbors of the selected points."""

        def take(table: Tensor) -> Tensor:
            if isinstance(rows, Tensor) and rows.dtype == torch.int64:
                return table.index_select(0, rows)  # A third faster than indexing.
            return table[rows]

        return Neighbors(take(self.indices), None if self.valid is None else take(self.valid))

    def gather(self, values: Tensor, rows: Rows = slice(None)) -> Tensor:
        """Gather the values ``(N,)`` of the neighbors of the selected points, shape ``(n, K)``.

        Example:
            >>> Neighbors(torch.tensor([[0, 1], [1, 0]])).gather(torch.tensor([0.5, 2.5])).tolist()
            [[0.5, 2.5], [2.5, 0.5]]
        """
        indices = self.indices[rows]
        return values.index_select(0, indices.reshape(-1)).view(indices.shape)

    def mask(self, rows: Rows = slice(None)) -> Tensor:
        """Return the mask of valid entries of the selected points, shape ``(n, K)``, bool."""
        if self.valid is not None:
            return self.valid[rows]
        num_rows, num_neighbors = len(self.indices[rows, :1]), self.indices.shape[1]
        return self.indices.new_ones((num_rows, num_neighbors), dtype=torch.bool)


class Sampling(NamedTuple):
    """Sampling of the surfaces of a cloud; see :func:`torchrg.neighbors.measure_sampling`.

    Attributes:
        whiteness: Ratio of the deviations from a plane of 16 and of 100 points, in [0, 1]: 1 for
            noise that is independent between points, near 0 for facets and bent surfaces.
        variation: Coefficient of variation of the distances to the nearest point: 0.25 to 0.35 for
            mesh vertices and grids, about 0.5 for points sampled at random.
        exactness: Fraction of points coplanar with their 8 nearest neighbors, within a thousandth
            of their distance: 0.3 to 0.7 for points sampled from triangles of a mesh, else near 0.
        density: Number of points per unit of area on a surface.
        height: Smallest extent along the principal axes, in units of the cloud; a room's height.
        deviation: RMS distance of 100 neighboring points from their plane, in units of the cloud.
    """

    whiteness: float = 1.0
    variation: float = 1.0
    exactness: float = 0.0
    density: float = 0.0
    height: float = 0.0
    deviation: float = 0.0


@short_repr
class NormalFit(NamedTuple):
    """Fit of a plane to each neighborhood.

    Attributes:
        normals: Unit normals of arbitrary sign, shape ``(*, 3)``; zero where not ``valid``.
        curvature: Surface variation in [0, 1/3], shape ``(*)``; 0 where not ``valid``.
        valid: Whether there is a plane, shape ``(*)``, bool.
        residual_rms: RMS distance of the fitted points to the plane, shape ``(*)``, in units of the
            cloud; 0 where not ``valid``.
        sharp: Sharp feature points, shape ``(*)``, bool; None for methods of one stage.
    """

    normals: Tensor
    curvature: Tensor
    valid: Tensor
    residual_rms: Tensor
    sharp: Tensor | None = None

    def map(self, change: Callable[[Tensor], Tensor]) -> "NormalFit":
        """Apply a function to all tensors; None stays None."""
        return NormalFit(*(change(values) for values in self if values is not None))
