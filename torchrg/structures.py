"""Data structures passed between pipeline stages."""

import operator
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, SupportsIndex, TypeVar, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg.axes import describe_units
from torchrg.errors import PrecisionWarning, ShapeError, UnitWarning, warn
from torchrg.precision import describe_steps

__all__ = [
    "FARTHEST",
    "MAX_POINTS",
    "PLANE_KINDS",
    "UNLABELED",
    "Cloud",
    "Colors",
    "FilePath",
    "Labels",
    "Neighbors",
    "NormalFit",
    "Plane",
    "PlaneAdjacency",
    "PlaneKind",
    "Planes",
    "Points",
    "Sampling",
    "Segmentation",
    "Superpoints",
    "Values",
]
__dir__ = __all__.copy

if TYPE_CHECKING:
    from torchrg.render.page import Page

UNLABELED = -1
"""Label of points without a region."""
FARTHEST = 1e12
"""Maximum absolute coordinate of a point; files use 1e20, 1e30 or the largest float32 for missing
points."""

MAX_POINTS = 2**31 - 1
"""Maximum number of points of a cloud; neighbor lists are int32."""

Array = NDArray[Any]
"""Array of numbers or text of any shape."""
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
Moved = TypeVar("Moved", bound="_Movable")


@dataclass(frozen=True, eq=False)
class Cloud:
    """A point cloud with its original coordinates, and a float32 copy shifted near the origin.

    Args:
        coordinates: Input coordinates, shape ``(N, 3)``, float32 or float64, an array or a tensor
            (converted to an array). Non-finite rows are kept.
        fields: Further per-point values by name, each of shape ``(N, ...)``: for example
            ``labels``, ``normals``, ``intensity``, ``color`` (``(N, 3)`` uint8 or uint16).
        grid_shape: ``(height, width)`` of an organized cloud (row-major), otherwise None.
        source: Path of the input file, for messages.
        header: File-level metadata: ``viewpoint`` of a PCD file (seven numbers, position and
            quaternion w x y z) and ``las`` (the header of a LAS file), which are written again;
            ``scans`` (names and poses) and ``coordinate_metadata`` of an E57 file.
        notes: Human-readable notes on assumptions made and data skipped while reading, without a
            period.
        front: Direction from each point toward the front of its surface (not normalized), zero if
            unknown, shape ``(N, 3)``, float32; None if the file has none. Computed from the faces
            of a mesh, or from the scanner positions. It is not written with the cloud;
            :func:`torchrg.normals.orient_normals` uses it.
        repairs: Notes on data repaired while reading.

    Raises:
        ShapeError: If ``coordinates`` is neither array nor tensor, or ``front`` has another shape.

    Warns:
        PrecisionWarning: On access to :attr:`points` if :attr:`precision_note` or
            :attr:`unit_note` is not empty.

    Example:
        >>> cloud = Cloud(np.array([[500000.25, 4000000.5, 1.0], [500001.25, 4000000.5, 1.0]]))
        >>> cloud.points.tolist()
        [[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]
    """

    coordinates: NDArray[np.floating]
    fields: Mapping[str, NDArray[np.generic]] = field(default_factory=dict)
    grid_shape: tuple[int, int] | None = None
    source: str = ""
    header: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    front: NDArray[np.float32] | None = None
    repairs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        values: dict[str, Any] = {
            "coordinates": _as_array(self.coordinates),
            "fields": {name: _as_array(field) for name, field in self.fields.items()},
            "front": _as_array(self.front),
        }
        vars(self).update(values)
        if not isinstance(values["coordinates"], np.ndarray):
            raise ShapeError(
                "Cloud: expected coordinates to be a tensor or a NumPy array, got "
                f"{type(self.coordinates).__name__}; use numpy.array."
            )
        if self.front is not None and self.front.shape != (len(self), 3):
            raise ShapeError(
                f"Cloud: expected front of shape {(len(self), 3)}, got {self.front.shape}."
            )

    def __len__(self) -> int:
        return len(self.coordinates)

    def __repr__(self) -> str:
        parts = [
            f"{len(self):,} points",
            *sorted(self.fields),
            *["front"] * (self.front is not None),
        ]
        return f"Cloud({', '.join(parts)})"

    if not TYPE_CHECKING:

        def __getattr__(self, name):  # noqa: ANN001, ANN204
            """Raise an error that lists the fields."""
            names = ", ".join(f"fields[{field!r}]" for field in vars(self).get("fields", ()))
            raise AttributeError(f"Cloud has no attribute {name!r}; it has {names or 'no fields'}.")

    @cached_property
    def finite(self) -> NDArray[np.bool_]:
        """Mask of points with three finite coordinates of at most 1e12, shape ``(N,)``.

        Larger coordinates are codes for missing points.
        """
        with np.errstate(invalid="ignore"):
            finite: NDArray[np.bool_] = (np.abs(self.coordinates) <= FARTHEST).all(axis=1)
        return finite

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """Origin of :attr:`points`, shape ``(3,)``; see ``local_origin``."""
        finite = self.coordinates[self.finite]
        if len(finite) == 0:
            return np.zeros(3)
        return local_origin(*bounding_box(finite))

    @cached_property
    def points(self) -> Tensor:
        """Coordinates relative to :attr:`origin`, shape ``(N, 3)``, float32.

        Rows that are not :attr:`finite` are not finite here either.
        """
        kinds = {UnitWarning: self.unit_note, PrecisionWarning: self.precision_note}
        for kind, note in kinds.items():
            if note:
                warn(f"{self.source or 'Cloud'}: {note}.", kind)
        return self._local

    @cached_property
    def _local(self) -> Tensor:
        """:attr:`points`, without the precision warning."""
        return self.relative_to(self.origin)

    @cached_property
    def precision_note(self) -> str:
        """Note on lost precision, or an empty string.

        Set if the coordinates are float32 far from the origin, LAS with a coarse scale, or too
        extended for float32. Without a period.
        """
        scale = float(max(getattr(self.header.get("las"), "scales", (0.0,))))
        finite = self.coordinates if self.finite.all() else self.coordinates[self.finite]
        if note := describe_steps(finite, scale=scale):
            return note
        if finite.dtype == np.float32:
            return ""
        fix = "leave out points that are far off, or cut the cloud into parts"
        return describe_steps(self._local.numpy(), fix=fix)

    @cached_property
    def unit_note(self) -> str:
        """Note on axes that seem to have different units, or an empty string.

        Judged by the header of the file and by the spans of the axes. Without a period.
        """
        coordinates = self.coordinates if self.finite.all() else self.coordinates[self.finite]
        return describe_units(coordinates, self.header)

    def relative_to(self, origin: NDArray[np.float64]) -> Tensor:
        """Return the coordinates relative to ``origin`` ``(3,)``, float32, shape ``(N, 3)``."""
        coordinates = self.coordinates
        if not self.finite.all() and (is_code := np.abs(coordinates) > FARTHEST).any():
            coordinates = np.where(is_code, coordinates.dtype.type(np.nan), coordinates)
        if coordinates.dtype == np.float32 and not origin.any():
            return torch.from_numpy(np.ascontiguousarray(coordinates))
        return torch.from_numpy((coordinates - origin).astype(np.float32))


def _as_array(values: Any) -> Any:  # noqa: ANN401
    """Convert a tensor to an array; return anything else unchanged."""
    return values.numpy(force=True) if isinstance(values, Tensor) else values


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

    Example:
        >>> local_origin(np.array([10.0, 10.0, 0.0]), np.array([12.0, 12.0, 3.0])).tolist()
        [11.0, 11.0, 1.5]
    """
    low, high = low.astype(np.float64), high.astype(np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return np.zeros(3)
    midpoint = low + (high - low) / 2
    reach, half_extent = np.abs([low, high]).max(), (high - low).max() / 2
    return midpoint if half_extent * 4 < reach else np.zeros(3)


class Neighbors(NamedTuple):
    """Nearest neighbors of each point; see :func:`torchrg.search_knn`.

    Attributes:
        indices: Rows of the neighbors, shape ``(N, K)``, int32. The first column is the point
            itself, the other columns are sorted by distance. Invalid entries contain the point
            itself.
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
        first = self.indices[rows, :1]
        shape = first.shape[0], self.indices.shape[1]
        return torch.ones(shape, dtype=torch.bool, device=first.device)


class Sampling(NamedTuple):
    """Sampling of the surfaces of a cloud; see :func:`torchrg.neighbors.measure_sampling`.

    Attributes:
        whiteness: Ratio of the deviations from a plane of 16 and of 100 points, in [0, 1]: 1 for
            noise that is independent between points, near 0 for facets and bent surfaces.
        variation: Coefficient of variation of the distances to the nearest point: 0.25 to 0.35 for
            mesh vertices and grids, about 0.5 for points sampled at random.
        exactness: Fraction of points coplanar with their 8 nearest neighbors, within a thousandth
            of their distance: 0.3 to 0.7 for points sampled from the triangles of a mesh, else near
            0.
        density: Number of points per unit of area on a surface.
        height: Smallest extent along the principal axes, in units of the cloud; the height of most
            rooms.
    """

    whiteness: float = 1.0
    variation: float = 1.0
    exactness: float = 0.0
    density: float = 0.0
    height: float = 0.0


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
        sharp = None if self.sharp is None else change(self.sharp)
        normals, curvature, valid, residual_rms = (change(values) for values in self[:4])
        return NormalFit(normals, curvature, valid, residual_rms, sharp)


PlaneKind = Literal["other", "floor", "ceiling", "wall", "horizontal", "vertical", "oblique"]
"""Class of a plane."""
PLANE_KINDS: tuple[PlaneKind, ...] = get_args(PlaneKind)
"""Classes of planes; see :func:`torchrg.regions.classes.classify_planes`. Curved planes are
"other"; "horizontal" and "vertical" planes are neither floor nor ceiling nor wall."""


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


class DeferredKind:
    """Classes of planes that are computed on first access, with z up.

    Args:
        classify: Function that returns the classes of a plane table. It is called once and then
            dropped, with the points that it holds. A pickled object contains the classes alone.
    """

    def __init__(self, classify: Callable[["Planes"], Tensor]) -> None:
        self._classify: Callable[[Planes], Tensor] | None = classify
        self._kind: Tensor | None = None

    def get(self, planes: "Planes") -> Tensor | None:
        """Return the class of each plane."""
        if self._classify is not None:
            self._kind, self._classify = self._classify(planes), None
        return self._kind


class _KindColumn:
    """Descriptor of :attr:`Planes.kind`, which may be a :class:`DeferredKind`."""

    def __get__(self, planes: "Planes | None", owner: type | None = None) -> Tensor | None:
        if planes is None:  # The default of the field.
            return None
        value: Tensor | DeferredKind | None = vars(planes)["kind"]
        return value.get(planes) if isinstance(value, DeferredKind) else value

    def __set__(self, planes: "Planes", value: Tensor | DeferredKind | None) -> None:
        vars(planes)["kind"] = value


@dataclass(frozen=True, eq=False)
class Plane:
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


class _Movable:
    """Base of dataclasses of tensors on one device."""

    def to(self: Moved, device: torch.device | str) -> Moved:
        """Move all tensors to a device."""
        columns = {name: moved(value, device) for name, value in vars(self).items()}
        return cast(Moved, replace(cast(Any, self), **columns))

    def cpu(self: Moved) -> Moved:
        """Move all tensors to the CPU."""
        return self.to("cpu")


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
        extent: Long and short side of the minimum bounding rectangle of the projected points, shape
            ``(M, 2)``.
        axes: Unit directions of those sides, shape ``(M, 2, 3)``.
        center: Center of that rectangle, shape ``(M, 3)``.
        curved: Mask of smooth but nonplanar regions (a column, a bent wall), shape ``(M,)``, bool.
            Their plane is only a best fit.
        kind: Class of each plane as an index of :data:`PLANE_KINDS`, shape ``(M,)``, int64. Unless
            an up axis was set, :func:`torchrg.segment_planes` classifies on first access, with z
            up. None for depth images with an unknown up axis.
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
    kind: Tensor | None = cast("Tensor | None", _KindColumn())  # noqa: RUF009 A descriptor.
    outline: tuple[tuple[Tensor, ...], ...] | None = None
    adjacency: PlaneAdjacency | None = None
    object: Tensor | None = None

    def __len__(self) -> int:
        return len(self.normal)

    def __repr__(self) -> str:
        counts = [] if self.kind is None else torch.bincount(self.kind).tolist()
        named = sorted((-count, kind) for count, kind in zip(counts, PLANE_KINDS, strict=False))
        classes = ", ".join(f"{-count:,} {kind}" for count, kind in named if count)
        return f"Planes({len(self):,} planes{': ' * bool(classes)}{classes})"

    def __iter__(self) -> Iterator[Plane]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, row: SupportsIndex) -> Plane:
        """Return a plane by its row."""
        try:
            row = range(len(self))[operator.index(row)]
        except TypeError:
            raise TypeError(
                f"Planes: expected an integer row, got {type(row).__name__}; index columns with "
                "slices and masks, as in planes.normal[planes.area > 1]."
            ) from None
        except IndexError:
            raise IndexError(f"Planes: expected a row below {len(self)}, got {row}.") from None
        columns = {name: getattr(self, name)[row] for name in PLANE_COLUMNS}
        values = {name: value if value.ndim else value.item() for name, value in columns.items()}
        kind = None if self.kind is None else PLANE_KINDS[int(self.kind[row])]
        outline = None if self.outline is None else self.outline[row]
        within = None if self.object is None else int(self.object[row])
        return Plane(row, **values, kind=kind, outline=outline, object=within)

    def to(self, device: torch.device | str) -> "Planes":
        """Move the table to a device."""
        columns = {name: moved(value, device) for name, value in vars(self).items()}
        if isinstance(columns["kind"], DeferredKind):
            columns["kind"] = DeferredKind(lambda _: cast(Tensor, moved(self.kind, device)))
        return replace(self, **columns)

    def __getstate__(self) -> dict[str, Any]:
        """Return the columns with their classes, instead of the points that define them."""
        return vars(self) | {"kind": self.kind}

    def to_pandas(self) -> Any:  # noqa: ANN401
        """Convert to a ``pandas.DataFrame`` with :data:`torchrg.plane_table.CSV_COLUMNS`.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        from torchrg.render.notebook import as_frame

        return as_frame(self)


def _count_points(labels: Tensor) -> str:
    """Return the number of points, or the size of an image, as text."""
    if labels.ndim == 2:
        return f"{labels.shape[0]:,} x {labels.shape[1]:,} pixels"
    return f"{len(labels):,} points"


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
        labels: Region of each point, shape ``(N,)``, int64: 0 to M-1 by descending size, or
            :data:`UNLABELED`.
        normals: Unit normals, shape ``(N, 3)``; zero where not ``valid``.
        curvature: Surface variation in [0, 1/3], shape ``(N,)``; 0 where not ``valid``.
        sharp: Sharp feature points, shape ``(N,)``, bool.
        valid: Finite points with a normal, shape ``(N,)``, bool.
        planes: The plane table, M rows.
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
    planes: Planes
    points: Tensor | None = None
    neighbors: Neighbors | None = None
    sampling: Sampling | None = None
    num_copies: int = 0

    def __repr__(self) -> str:
        labeled = 100 * torch.count_nonzero(self.labels >= 0).item() / max(self.labels.numel(), 1)
        return (
            f"Segmentation({_count_points(self.labels)}, {len(self.planes):,} planes, "
            f"{labeled:.1f} % labeled)"
        )

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
        counts = ", ".join(
            f"{int(level.max()) + 1 if len(level) else 0:,}"
            for level in (self.labels, *self.levels)
        )
        return f"Superpoints({_count_points(self.labels)}, {counts} superpoints)"

    def by_level(self) -> dict[str, NDArray[np.int32]]:
        """Return all partitions by their field names in files.

        Example:
            >>> one = torch.tensor([0, 0, 1])
            >>> list(Superpoints(one, torch.tensor([-1, -1]), (one // 2, one // 2)).by_level())
            ['superpoint', 'superpoint_1', 'superpoint_2']
        """
        return {
            "superpoint" if i == 0 else f"superpoint_{i}": level.numpy(force=True).astype(np.int32)
            for i, level in enumerate((self.labels, *self.levels))
        }


# Lets torch.load(weights_only=True) read results and samples.
torch.serialization.add_safe_globals(
    [Neighbors, NormalFit, Plane, PlaneAdjacency, Planes, Sampling, Segmentation, Superpoints]
)
