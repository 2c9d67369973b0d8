"""Values that one step gives to the next: clouds, neighbours, fits, planes, segmentations."""

import operator
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, SupportsIndex, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import _display
from torchrg.errors import PrecisionWarning, ShapeError
from torchrg.precision import note_on_steps

UNLABELED = -1
"""Label of a point that belongs to no region."""
FARTHEST = 1e12
"""Largest coordinate of a point. Programs write 1e20, 1e30 or the largest float32 for a missing
one."""

MAX_POINTS = 2**31 - 1
"""Most points of a cloud, as lists of neighbors hold int32."""

Array = NDArray[Any]
"""An array of numbers or text, of any shape."""
Rows = slice | Tensor
"""A block of points, or the row numbers of some."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud as it was read: its coordinates untouched, and points fit for float32 arithmetic.

    Args:
        coordinates: The input's own coordinates, shape ``(N, 3)``, float32 or float64, an array or
            a tensor, which becomes an array. Non-finite rows are kept.
        fields: Further values of each point by name, each of shape ``(N, ...)``: for example
            ``labels``, ``normals``, ``intensity``, ``color`` (``(N, 3)`` uint8 or uint16).
        grid_shape: ``(height, width)`` of an organised cloud (row-major), otherwise None.
        source: The file it came from, for messages.
        header: What the file says about the cloud as a whole: ``viewpoint`` of a PCD file (seven
            numbers, position and quaternion w x y z) and ``las`` (the header of a LAS file), which
            are written again, ``scans`` (names and poses) and ``coordinate_metadata`` of an E57
            file.
        notes: What reading took for granted or left out, a line each without a full stop, for
            people.
        front: Direction from each point to where its surface was seen from, of any length, zero
            where unknown, shape ``(N, 3)``, float32; None where the file does not say. By the faces
            of a mesh, or by where the scanners stood. It is not written with the cloud;
            :func:`torchrg.normals.orient_normals` turns normals by it.
        repairs: What reading put right, a line each.

    Raises:
        ShapeError: If ``coordinates`` is neither array nor tensor, or ``front`` has another shape.

    Warns:
        PrecisionWarning: Where :attr:`points` is taken and :attr:`precision_note` is not empty.

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
                f"{type(self.coordinates).__name__}; numpy.array makes one."
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
            """Say where the values of points are, to who asks for them by name."""
            names = ", ".join(f"fields[{field!r}]" for field in vars(self).get("fields", ()))
            raise AttributeError(f"Cloud has no attribute {name!r}; it has {names or 'no fields'}.")

    @cached_property
    def finite(self) -> NDArray[np.bool_]:
        """Which points have three finite coordinates, none beyond 1e12, shape ``(N,)``.

        Those beyond are codes for a missing point.
        """
        with np.errstate(invalid="ignore"):
            finite: NDArray[np.bool_] = (np.abs(self.coordinates) <= FARTHEST).all(axis=1)
        return finite

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """Origin of :attr:`points`, shape ``(3,)``: that of :func:`origin_of_box`."""
        finite = self.coordinates[self.finite]
        if len(finite) == 0:
            return np.zeros(3)
        return origin_of_box(*bounding_box(finite))

    @cached_property
    def points(self) -> Tensor:
        """Coordinates about :attr:`origin`, shape ``(N, 3)``, float32.

        Rows that are not :attr:`finite` are not finite here either.
        """
        if self.precision_note:
            warnings.warn(
                f"{self.source or 'Cloud'}: {self.precision_note}.", PrecisionWarning, stacklevel=3
            )
        return self._local

    @cached_property
    def _local(self) -> Tensor:
        """:attr:`points`, whatever their precision."""
        return self.about(self.origin)

    @cached_property
    def precision_note(self) -> str:
        """What has cost the coordinates digits that the spacing of the points needs, or nothing.

        A line for people, without a full stop: that they were written as float32 far from the
        origin, or as LAS with too coarse a scale, or reach too far for float32 about any origin.
        """
        scale = float(max(getattr(self.header.get("las"), "scales", (0.0,))))
        finite = self.coordinates if self.finite.all() else self.coordinates[self.finite]
        if note := note_on_steps(finite, scale=scale):
            return note
        if finite.dtype == np.float32:
            return ""
        cure = "leave out points that are far off, or cut the cloud into parts"
        return note_on_steps(self._local.numpy(), cure=cure)

    def about(self, origin: NDArray[np.float64]) -> Tensor:
        """Return the coordinates about an origin of shape ``(3,)``, float32, shape ``(N, 3)``."""
        coordinates = self.coordinates
        if not self.finite.all() and (is_code := np.abs(coordinates) > FARTHEST).any():
            coordinates = np.where(is_code, coordinates.dtype.type(np.nan), coordinates)
        if coordinates.dtype == np.float32 and not origin.any():
            return torch.from_numpy(np.ascontiguousarray(coordinates))
        return torch.from_numpy((coordinates - origin).astype(np.float32))


def _as_array(values: Any) -> Any:  # noqa: ANN401
    """Return a tensor as an array, and anything else as it is."""
    return values.numpy(force=True) if isinstance(values, Tensor) else values


def bounding_box(
    coordinates: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the largest coordinates of points ``(N, 3)``, each ``(3,)``.

    Column by column: along the rows NumPy takes twenty times as long.
    """
    columns = coordinates.T
    low, high = [column.min() for column in columns], [column.max() for column in columns]
    return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)


def origin_of_box(low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return about what a cloud with this box is kept in float32: zero, or the middle if it is far.

    A cloud is far when moving it to its middle makes its largest coordinate less than a quarter as
    large; a near cloud is left where it is, so that float32 files keep their coordinates bit for
    bit. A box that is not finite, as that of no points, is near.

    Example:
        >>> origin_of_box(np.array([10.0, 10.0, 0.0]), np.array([12.0, 12.0, 3.0])).tolist()
        [11.0, 11.0, 1.5]
    """
    low, high = low.astype(np.float64), high.astype(np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return np.zeros(3)
    middle = low + (high - low) / 2
    reach, half_extent = np.abs([low, high]).max(), (high - low).max() / 2
    return middle if half_extent * 4 < reach else np.zeros(3)


class Neighbors(NamedTuple):
    """The nearest points of each point; see :func:`torchrg.search_knn`.

    Attributes:
        indices: Rows of the neighbours, shape ``(N, K)``, int32. The first column is the point
            itself, the rest is sorted by distance. Where ``valid`` is False: the point itself.
        valid: Which entries are neighbours, shape ``(N, K)``, bool; None when all are.
    """

    indices: Tensor
    valid: Tensor | None = None

    def at(self, rows: Rows) -> "Neighbors":
        """Return the neighbours of some of the points."""
        return Neighbors(self.indices[rows], None if self.valid is None else self.valid[rows])

    def of(self, values: Tensor, rows: Rows = slice(None)) -> Tensor:
        """Return the values ``(N,)`` of the neighbours of some points, shape ``(n, K)``.

        Example:
            >>> Neighbors(torch.tensor([[0, 1], [1, 0]])).of(torch.tensor([0.5, 2.5])).tolist()
            [[0.5, 2.5], [2.5, 0.5]]
        """
        indices = self.indices[rows]
        return values.index_select(0, indices.reshape(-1)).view(indices.shape)

    def counted(self, rows: Rows = slice(None)) -> Tensor:
        """Return which entries of some points are neighbours, shape ``(n, K)``, bool."""
        if self.valid is not None:
            return self.valid[rows]
        first = self.indices[rows, :1]
        shape = first.shape[0], self.indices.shape[1]
        return torch.ones(shape, dtype=torch.bool, device=first.device)


class Sampling(NamedTuple):
    """How a cloud samples its surfaces; see :func:`torchrg.neighbors.measure_sampling`.

    Attributes:
        whiteness: Deviation from a plane of 16 points by that of 100, in [0, 1]: 1 for noise that
            is independent from point to point, near 0 for facets and bent surfaces.
        variation: Standard deviation by mean of the distances to the nearest point: 0.25 to 0.35
            for vertices of a mesh and for grids, about 0.5 for points drawn at random.
        exactness: Share of points that lie with their 8 nearest in one plane, to a thousandth of
            their distance: 0.3 to 0.7 for points drawn from the triangles of a mesh, else near 0.
        density: Points in a square of side 1 on a surface, in the unit of the cloud.
        height: Least extent along the principal axes of the cloud, in its unit: of a room mostly
            its height.
    """

    whiteness: float = 1.0
    variation: float = 1.0
    exactness: float = 0.0
    density: float = 0.0
    height: float = 0.0


class NormalFit(NamedTuple):
    """Normals and what else the fit of a plane to each neighbourhood gives.

    Attributes:
        normals: Unit normals of arbitrary sign, shape ``(*, 3)``; zero where not ``valid``.
        curvature: Surface variation in [0, 1/3], shape ``(*)``; 0 where not ``valid``.
        valid: Whether there is a plane, shape ``(*)``, bool.
        residual_rms: Root mean square distance of the fitted points to the plane, shape ``(*)``,
            in the unit of the cloud; 0 where not ``valid``.
        sharp: Sharp feature points, shape ``(*)``, bool; None for methods of one stage.
    """

    normals: Tensor
    curvature: Tensor
    valid: Tensor
    residual_rms: Tensor
    sharp: Tensor | None = None

    def each(self, change: Callable[[Tensor], Tensor]) -> "NormalFit":
        """Return a fit whose tensors are changed by one function, None left alone."""
        sharp = None if self.sharp is None else change(self.sharp)
        normals, curvature, valid, residual_rms = (change(values) for values in self[:4])
        return NormalFit(normals, curvature, valid, residual_rms, sharp)


PlaneKind = Literal["other", "floor", "ceiling", "wall", "horizontal", "vertical", "oblique"]
"""Class of a plane."""
PLANE_KINDS: tuple[PlaneKind, ...] = get_args(PlaneKind)
"""Classes of planes; see :func:`torchrg.regions.classes.classify_planes`. Curved planes are
"other", "horizontal" and "vertical" ones neither floor nor ceiling nor wall."""


class PlaneAdjacency(NamedTuple):
    """Pairs of planes that meet.

    Attributes:
        pairs: Rows of the plane table, the smaller first, ascending, shape ``(E, 2)``, int64.
        boundary_length: Length along which they meet, shape ``(E,)``, in the unit of the cloud.
        dihedral_deg: Angle between the planes, in [0, 90], shape ``(E,)``.
    """

    pairs: Tensor
    boundary_length: Tensor
    dihedral_deg: Tensor


@dataclass(frozen=True, eq=False)
class Plane:
    """One plane of a table, as ``seg.planes[0]``: its row of :class:`Planes`, with the same names.

    Attributes:
        id: Label of its points.
        normal: Shape ``(3,)``; so are ``centroid`` and ``center``. ``extent`` is ``(2,)``, and
            ``axes`` is ``(2, 3)``.
        offset: A number of Python, as are ``area``, ``count``, ``rms`` and ``curved``.
        kind: One of :data:`PLANE_KINDS`; None where the up direction was not given.
        outline: Rings around it, of shape ``(V, 3)``; None where not asked for.
        object: Number of its object; None where planes were not kept within objects.
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


@dataclass(frozen=True, eq=False)
class Planes:
    """The plane table: one row for each region, in the order of the labels.

    Its planes are gone through as those of a list; its columns are tensors of all of them. Lengths
    are in the unit of the cloud. Values are computed in float64 and given in the dtype of the
    points. Copies of a point count once in all columns except ``count``.

    Attributes:
        normal: Unit normals, shape ``(M, 3)``; the sign makes the first of z, y, x that is not
            zero positive.
        offset: Signed distance of the plane from the origin, shape ``(M,)``: a point x of the plane
            has ``normal . x = offset``.
        centroid: Mean of the region's points, shape ``(M, 3)``.
        area: Area that the points cover on the plane, shape ``(M,)``.
        count: Number of points, copies included, shape ``(M,)``, int64.
        rms: Root mean square distance of the points to the plane, shape ``(M,)``.
        extent: Long and short side of the smallest rectangle in the plane that holds the points'
            projections, shape ``(M, 2)``.
        axes: Unit directions of those sides, shape ``(M, 2, 3)``.
        center: Center of that rectangle, shape ``(M, 3)``.
        curved: Whether the region is one smooth surface but not a plane, shape ``(M,)``, bool: a
            column, a bent wall. Its plane is the best there is, no more.
        kind: Class of each plane as a place in :data:`PLANE_KINDS`, shape ``(M,)``, int64; None
            where the up direction was not given.
        outline: Rings around each region, of shape ``(V, 3)``: outer ones counter-clockwise seen
            against the normal, holes clockwise; None where not asked for.
        adjacency: Which planes meet; None where the neighbours were not given.
        object: Object that each plane is of, shape ``(M,)``, int64; None where planes were not kept
            within objects.

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
    kind: Tensor | None = None
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
        """Return a plane by its number."""
        try:
            row = range(len(self))[operator.index(row)]
        except TypeError:
            raise TypeError(
                f"Planes: expected the number of a plane, got {type(row).__name__}; columns take "
                "slices and masks, as in planes.normal[planes.area > 1]."
            ) from None
        except IndexError:
            raise IndexError(f"Planes: expected one of {len(self)} planes, got {row}.") from None
        columns = {name: getattr(self, name)[row] for name in PLANE_COLUMNS}
        values = {name: value if value.ndim else value.item() for name, value in columns.items()}
        kind = None if self.kind is None else PLANE_KINDS[int(self.kind[row])]
        outline = None if self.outline is None else self.outline[row]
        within = None if self.object is None else int(self.object[row])
        return Plane(row, **values, kind=kind, outline=outline, object=within)

    def to(self, device: torch.device | str) -> "Planes":
        """Return the table on a device."""
        return replace(self, **{name: moved(value, device) for name, value in vars(self).items()})

    def to_pandas(self) -> Any:  # noqa: ANN401
        """Return a ``pandas.DataFrame``, the columns of :data:`torchrg.plane_table.CSV_COLUMNS`.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        return _display.call("as_frame", self)


def _count_points(labels: Tensor) -> str:
    """Return the number of points, or the size of an image, in words."""
    if labels.ndim == 2:
        return f"{labels.shape[0]:,} x {labels.shape[1]:,} pixels"
    return f"{len(labels):,} points"


def moved(value: Any, device: torch.device | str) -> Any:  # noqa: ANN401
    """Return tensors, and tuples and tables of them, on a device; anything else as it is."""
    if isinstance(value, Tensor | Planes):
        return value.to(device)
    if isinstance(value, tuple):
        parts = [moved(item, device) for item in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


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
"""Columns that every plane table has, in files too: kind of numbers, and shape of a row."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What :func:`torchrg.segment_planes` returns: labels, normals, and the plane table.

    Attributes:
        labels: Region of each point, shape ``(N,)``, int64: 0 to M-1 by descending size, or
            :data:`UNLABELED`.
        normals: Unit normals, shape ``(N, 3)``; zero where not ``valid``.
        curvature: Surface variation in [0, 1/3], shape ``(N,)``; 0 where not ``valid``.
        sharp: Sharp feature points, shape ``(N,)``, bool.
        valid: Points that are finite and have a normal, shape ``(N,)``, bool.
        planes: The plane table, M rows.
        points: What was segmented, shape ``(N, 3)``, to show it; None where it is not known.
        neighbors: Neighbors of the distinct finite points in canonical order, as
            :func:`torchrg.search_knn` finds them there; None where they were not kept. See
            :func:`torchrg.neighbors.distinct_points`.
        sampling: What was measured of the cloud, by which settings were chosen; None where it was
            not.
        num_copies: Number of points that repeat the coordinates of another point.
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

    def to(self, device: torch.device | str) -> "Segmentation":
        """Return the segmentation on a device."""
        return replace(self, **{name: moved(value, device) for name, value in vars(self).items()})

    def cpu(self) -> "Segmentation":
        """Return the segmentation on the CPU."""
        return self.to("cpu")

    def show(self, **settings: Any) -> Any:  # noqa: ANN401
        """Return the page of the browser, which a notebook shows; needs ``torchrg[view]``.

        Args:
            settings: Those of :func:`torchrg.render.make_page`.

        Returns:
            A :class:`torchrg.render.page.Page`; :func:`torchrg.render.write_page` keeps it.

        Raises:
            ConfigError: If ``points`` is None.
            MissingDependencyError: If pages cannot be made.
        """
        return _display.call("show", self, **settings)

    def _repr_html_(self) -> str:
        """Return a picture and the table of planes, as a notebook shows them."""
        text: str = _display.call("as_html", self)
        return text


@dataclass(frozen=True, eq=False)
class Superpoints:
    """What :func:`torchrg.make_superpoints` returns: a partition of all points, and coarser ones.

    Attributes:
        labels: Superpoint of each point, shape ``(N,)``, int64: 0 to M-1 by descending size; -1 for
            points that are not finite, and for no others.
        plane: Plane that more than half of the points of each superpoint are on, shape ``(M,)``,
            int64, or -1.
        levels: Coarser partitions, numbered likewise, each shape ``(N,)``: each of their parts is
            made of whole parts of the one before.
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
        """Return all partitions by the names that they have in files.

        Example:
            >>> one = torch.tensor([0, 0, 1])
            >>> list(Superpoints(one, torch.tensor([-1, -1]), (one // 2, one // 2)).by_level())
            ['superpoint', 'superpoint_1', 'superpoint_2']
        """
        return {
            "superpoint" if i == 0 else f"superpoint_{i}": level.numpy(force=True).astype(np.int32)
            for i, level in enumerate((self.labels, *self.levels))
        }
