"""Planes, segmentations and superpoints."""

import operator
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, SupportsIndex, TypeVar, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.structures.points import Explained, Neighbors, Sampling, short_repr

if TYPE_CHECKING:
    from torchrg.render.page import Page

PlaneKind = Literal["other", "floor", "ceiling", "wall", "horizontal", "vertical", "oblique"]
"""Class of a plane."""
PLANE_KINDS: tuple[PlaneKind, ...] = get_args(PlaneKind)
"""Classes of planes; see :func:`torchrg.regions.classes.classify_planes`. Curved planes are
"other"; "horizontal" and "vertical" planes are neither floor nor ceiling nor wall."""
Moved = TypeVar("Moved", bound="_Movable")


@short_repr
class PlaneAdjacency(NamedTuple):
    """Pairs of adjacent planes.

    Attributes:
        pairs: Rows of the plane table, the smaller first, ascending, shape ``(E, 2)``, int64.
        boundary_length: Length of the common boundary, shape ``(E,)``, in units of the cloud.
        dihedral_deg: Angle between the planes, in degrees, in [0, 90], shape ``(E,)``.
    """

    pairs: Tensor
    boundary_length: Tensor
    dihedral_deg: Tensor


class Deferred:
    """A column that is computed on first access.

    Args:
        compute: Function of the object that has the column. It is called once and then dropped,
            with the points that it holds. A pickled object contains the value alone.
    """

    def __init__(self, compute: Callable[[Any], object]) -> None:
        self._compute: Callable[[Any], object] | None = compute
        self._value: object = None

    def get(self, owner: object) -> object:
        """Return the value in an object."""
        if (compute := self._compute) is not None:  # Another thread may set it meanwhile.
            self._value = compute(owner)
            self._compute = None
        return self._value


class _Column:
    """Descriptor of a field that may be :class:`Deferred`."""

    def __init__(self, *default: object) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, table: object, owner: type | None = None) -> Any:  # noqa: ANN401
        if table is None:
            if not self._default:  # The field has no default.
                raise AttributeError(self._name)
            return self._default[0]
        value = vars(table)[self._name]
        return value.get(table) if isinstance(value, Deferred) else value

    def __set__(self, table: object, value: object) -> None:
        vars(table)[self._name] = value


@dataclass(frozen=True, eq=False)
class Plane(Explained):
    """One plane: a row of :class:`Planes`, with the same names, as returned by ``seg.planes[0]``.

    Attributes:
        id: Label of its points.
        normal: Shape ``(3,)``; so are ``centroid`` and ``center``. ``extent`` is ``(2,)``, and
            ``axes`` is ``(2, 3)``.
        offset: A Python number, as are ``area``, ``count``, ``rms`` and ``curved``.
        kind: One of :data:`PLANE_KINDS`; None in depth images with an unknown up axis.
        outline: Rings of its polygon, of shape ``(V, 3)``; None if not requested.
        object: Object ID; None without objects.
    """

    id: int
    normal: Tensor
    offset: float
    centroid: Tensor
    area: float
    count: int
    rms: float
    extent: Tensor
    axes: Tensor
    center: Tensor
    curved: bool
    kind: str | None = None
    outline: tuple[Tensor, ...] | None = None
    object: int | None = None

    @property
    def equation(self) -> Tensor:
        """Coefficients a, b, c, d with a x + b y + c z + d = 0, as in Open3D; shape ``(4,)``."""
        return torch.cat([self.normal, self.normal.new_tensor([-self.offset])])

    def __repr__(self) -> str:
        normal = ", ".join(f"{value + 0:.3f}" for value in self.normal.tolist())
        kind = "" if self.kind is None else f"{self.kind}, "
        return (
            f"Plane({self.id}, {kind}{self.count:,} points, area {self.area:.4g}, "
            f"normal ({normal}), offset {self.offset:.4g})"
        )


def moved(value: Any, device: torch.device | str) -> Any:  # noqa: ANN401
    """Move tensors, and tuples and tables of tensors, to a device; return others unchanged."""
    if isinstance(value, Tensor | _Movable):
        return value.to(device)
    if isinstance(value, tuple):
        parts = [moved(item, device) for item in value]
        if all(map(operator.is_, parts, value)):
            return value
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


class _Movable(Explained):
    """Base of dataclasses of tensors on one device."""

    def to(self: Moved, device: torch.device | str) -> Moved:
        """Move all tensors to a device."""

        def move(name: str, value: object) -> object:
            if isinstance(value, Deferred):
                return Deferred(lambda _: moved(getattr(self, name), device))
            return moved(value, device)

        columns = {name: move(name, value) for name, value in vars(self).items()}
        return cast(Moved, replace(cast(Any, self), **columns))

    def cpu(self: Moved) -> Moved:
        """Move all tensors to the CPU."""
        return self.to("cpu")

    def __getstate__(self) -> dict[str, Any]:
        """Return all columns, instead of what defines deferred ones."""
        return {name: getattr(self, name) for name in vars(self)}


@dataclass(frozen=True, eq=False)
class Planes(_Movable):
    """Plane table with one row per region, in the order of the labels.

    Iterating yields :class:`Plane` objects; attributes are tensors with one row per plane. Lengths
    are in units of the cloud. Values are computed in float64 and returned in the dtype of the
    points. Duplicate points count once, except in ``count``.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``, with a positive first nonzero component of z, y, x.
        offset: Signed distance of the plane from the origin, shape ``(M,)``: points x on the plane
            have ``normal . x = offset``.
        centroid: Mean of the region's points, shape ``(M, 3)``.
        area: Area covered by the points on the plane, shape ``(M,)``.
        count: Number of points, including duplicates, shape ``(M,)``, int64.
        rms: RMS distance of the points to the plane, shape ``(M,)``.
        extent: Long and short side of the points' minimum bounding rectangle, shape ``(M, 2)``.
        axes: Unit directions of those sides, shape ``(M, 2, 3)``.
        center: Center of that rectangle, shape ``(M, 3)``.
        curved: Mask of smooth but nonplanar regions (a column, a bent wall), shape ``(M,)``, bool.
        kind: Class of each plane as an index of :data:`PLANE_KINDS`, shape ``(M,)``, int64. Unless
            an up axis was set, :func:`torchrg.segment_planes` classifies on first access, with z
            up. Numbers equal no word: use ``torchrg.select_planes(seg, kinds="wall")``, or
            ``plane.kind`` of each plane. None for depth images with an unknown up axis.
        outline: Polygon of each region as rings of shape ``(V, 3)``: seen against the normal, outer
            rings are counter-clockwise and holes clockwise; None if not requested.
        adjacency: Adjacent planes; None without neighbors.
        object: Object ID of each plane, shape ``(M,)``, int64; None without objects.

    Example:
        >>> from torchrg import segment_planes
        >>> floor = torch.cartesian_prod(torch.arange(9.0), torch.arange(9.0), torch.ones(1))
        >>> planes = segment_planes(floor).planes
        >>> len(planes), planes.normal.shape, planes[0].normal.tolist()
        (1, torch.Size([1, 3]), [0.0, 0.0, 1.0])
        >>> [(plane.count, plane.offset) for plane in planes]
        [(81, 1.0)]
    """

    normal: Tensor
    offset: Tensor
    centroid: Tensor
    area: Tensor
    count: Tensor
    rms: Tensor
    extent: Tensor
    axes: Tensor
    center: Tensor
    curved: Tensor
    kind: Tensor | None = cast("Tensor | None", _Column(None))  # noqa: RUF009 A descriptor.
    outline: tuple[tuple[Tensor, ...], ...] | None = None
    adjacency: PlaneAdjacency | None = None
    object: Tensor | None = None

    def __len__(self) -> int:
        return len(self.normal)

    @property
    def equation(self) -> Tensor:
        """Coefficients a, b, c, d with a x + b y + c z + d = 0, as in Open3D; ``(M, 4)``."""
        return torch.cat([self.normal, -self.offset[:, None]], dim=1)

    def __str__(self) -> str:
        counts = [0] * len(PLANE_KINDS) if self.kind is None else torch.bincount(self.kind).tolist()
        named = [*zip(PLANE_KINDS, counts, strict=False)]
        kinds = [_plural(count, kind) for kind, count in (*named[1:], *named[:1]) if count]
        return f"{_plural(len(self), 'plane')}{': ' * bool(kinds)}{', '.join(kinds)}"

    def __repr__(self) -> str:
        return f"Planes({self})"

    def __iter__(self) -> Iterator[Plane]:
        return map(self.__getitem__, range(len(self)))

    @typing.overload
    def __getitem__(self, row: SupportsIndex) -> Plane: ...
    @typing.overload
    def __getitem__(self, row: slice) -> list[Plane]: ...
    def __getitem__(self, row: SupportsIndex | slice) -> Plane | list[Plane]:
        """Return a plane by its row, or a list of the planes of a slice."""
        if isinstance(row, slice):
            return [self[index] for index in range(len(self))[row]]
        row = _find_row("Planes", row, -len(self), len(self))
        columns = {name: getattr(self, name)[row] for name in PLANE_COLUMNS}
        values = {name: value if value.ndim else value.item() for name, value in columns.items()}
        kind = None if self.kind is None else PLANE_KINDS[int(self.kind[row])]
        outline = None if self.outline is None else self.outline[row]
        within = None if self.object is None else int(self.object[row])
        return Plane(row, **values, kind=kind, outline=outline, object=within)

    def to_pandas(self) -> Any:  # noqa: ANN401
        """Convert to a ``pandas.DataFrame`` with :data:`torchrg.io.plane_table.CSV_COLUMNS`.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        from torchrg.render.notebook import as_frame

        return as_frame(self)


def _find_row(caller: str, row: SupportsIndex, lowest: int, num_planes: int) -> int:
    """Return the row of a plane, counted from the end if negative, or raise."""
    try:
        index = operator.index(row)
    except TypeError:
        raise TypeError(
            f"{caller}: expected an integer row or a slice, got {type(row).__name__}; index "
            "columns with masks, as in planes.normal[planes.area > 1]; a plane has an id."
        ) from None
    if not lowest <= index < num_planes:
        fix = "; for points of no plane use seg.labels == -1" * (index == -1)
        raise IndexError(f"{caller}: expected a row in [{lowest}, {num_planes}), got {row}{fix}.")
    return index % num_planes


def _plural(count: int, noun: str) -> str:
    """Return a count with a noun, or with an adjective, which has no plural."""
    has_plural = noun in ("point", "plane", "floor", "ceiling", "wall")
    return f"{count:,} {noun}{'s' * (count != 1 and has_plural)}"


def _count_points(labels: Tensor) -> str:
    """Return the number of points, or the size of an image, as text."""
    if labels.ndim == 2:
        return f"{labels.shape[0]:,} x {labels.shape[1]:,} pixels"
    return _plural(len(labels), "point")


PLANE_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "normal": ("f8", (3,)),
    "offset": ("f8", ()),
    "centroid": ("f8", (3,)),
    "area": ("f8", ()),
    "count": ("i8", ()),
    "rms": ("f8", ()),
    "extent": ("f8", (2,)),
    "axes": ("f8", (2, 3)),
    "center": ("f8", (3,)),
    "curved": ("?", ()),
}
"""Columns of every plane table, including files: kind of numbers, and shape of a row."""


@dataclass(frozen=True, eq=False)
class Segmentation(_Movable):
    """Plane segmentation: per-point labels and normals, and the plane table.

    Attributes:
        labels: Region of each point, shape ``(N,)``, int64: 0 to M-1 by descending size, or -1.
        normals: Unit normals, shape ``(N, 3)``; zero where not ``valid``.
        curvature: Surface variation in [0, 1/3], shape ``(N,)``; 0 where not ``valid``.
        sharp: Sharp feature points, shape ``(N,)``, bool.
        valid: Finite points with a normal, shape ``(N,)``, bool.
        planes: The plane table, M rows; of a depth image, it is measured on first access.
        points: Input points for visualization, shape ``(N, 3)``; None if unknown.
        neighbors: Neighbors of the distinct finite points in canonical order, as
            :func:`torchrg.search_knn` returns them; None if not kept. See
            :func:`torchrg.neighbors.distinct_points`.
        sampling: Measured sampling from which settings were chosen; None if not measured.
        num_copies: Number of points that duplicate the coordinates of another point.
    """

    labels: Tensor
    normals: Tensor
    curvature: Tensor
    sharp: Tensor
    valid: Tensor
    planes: Planes = cast(Planes, _Column())  # noqa: RUF009 A descriptor.
    points: Tensor | None = None
    neighbors: Neighbors | None = None
    sampling: Sampling | None = None
    num_copies: int = 0

    def __repr__(self) -> str:
        labeled = 100 * torch.count_nonzero(self.labels >= 0).item() / max(self.labels.numel(), 1)
        size = f"{_count_points(self.labels)}, {_plural(len(self.planes), 'plane')}"
        return f"Segmentation({size}, {labeled:.1f} % labeled)"

    def inliers(self, plane: SupportsIndex) -> Tensor:
        """Return the rows of the points of a plane (of flattened pixels), ``(n,)``, int64.

        ``plane`` is an ID from 0 to M-1. Others raise IndexError, and -1 too: it means no plane.
        """
        row = _find_row("inliers", plane, 0, len(self.planes))
        return (self.labels.flatten() == row).nonzero().squeeze(1)

    def show(self, **settings: Any) -> "Page":  # noqa: ANN401
        """Return an interactive viewer, displayed by notebooks; needs ``torchrg[view]``.

        Args:
            settings: Keyword arguments of :func:`torchrg.render.make_page`.

        Returns:
            A :class:`torchrg.render.page.Page`; save it with :func:`torchrg.render.write_page`.

        Raises:
            ConfigError: If ``points`` is None.
            MissingDependencyError: If the viewer cannot be created.
        """
        from torchrg.render.notebook import show

        return show(self, **settings)

    def _repr_html_(self) -> str:
        """Return an image and the plane table, as displayed by notebooks."""
        from torchrg.render.notebook import as_html

        return as_html(self)


@dataclass(frozen=True, eq=False)
class Superpoints(_Movable):
    """Partition of all points into superpoints, in levels from fine to coarse.

    Attributes:
        labels: Superpoint of each point, shape ``(N,)``, int64: 0 to M-1 by descending size; -1
            only for points that are not finite.
        plane: Plane with the majority of the points of each superpoint, shape ``(M,)``, int64, or
            -1.
        levels: Coarser partitions with the same numbering, each shape ``(N,)``; each superpoint is
            a union of superpoints of the previous level.
    """

    labels: Tensor
    plane: Tensor
    levels: tuple[Tensor, ...]

    def __repr__(self) -> str:
        levels = (self.labels, *self.levels)
        counts = ", ".join(f"{int(each.max()) + 1 if len(each) else 0:,}" for each in levels)
        return f"Superpoints({_count_points(self.labels)}, {counts} superpoints)"

    def by_level(self) -> dict[str, NDArray[np.int32]]:
        """Return all partitions by their field names in files."""
        return {
            "superpoint" if i == 0 else f"superpoint_{i}": level.numpy(force=True).astype(np.int32)
            for i, level in enumerate((self.labels, *self.levels))
        }
