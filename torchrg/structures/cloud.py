"""Point cloud with fields and notes, as files store it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg import scratch
from torchrg._parallel import ROWS_AT_ONCE, split_rows
from torchrg.errors import PrecisionWarning, ShapeError, UnitWarning, warn
from torchrg.structures.points import FARTHEST, Explained, bounding_box, local_origin
from torchrg.structures.precision import describe_steps, describe_units


@dataclass(frozen=True, eq=False)
class Cloud(Explained):
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
        notes: Notes on assumptions made and data skipped while reading, without a period.
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
        vars(self)["coordinates"] = coordinates = _as_array(self.coordinates)
        if not isinstance(coordinates, np.ndarray):
            raise ShapeError(
                "Cloud: expected coordinates to be a tensor or a NumPy array, got "
                f"{type(self.coordinates).__name__}; use numpy.array, or torchrg.read_cloud(path)."
            )
        if coordinates.shape[1:] != (3,) or not isinstance(self.fields, Mapping):
            raise ShapeError(
                f"Cloud: expected coordinates of shape (N, 3) and a dictionary of fields, got "
                f"{coordinates.shape} and {type(self.fields).__name__}; pass Cloud(points[:, :3], "
                "{'color': colors})."
            )
        fields = {name: _as_array(field) for name, field in self.fields.items()}
        vars(self).update(fields=fields, front=_as_array(self.front))
        if self.front is not None and self.front.shape != (len(self), 3):
            raise ShapeError(
                f"Cloud: expected front of shape {(len(self), 3)}, got {self.front.shape}."
            )

    def __len__(self) -> int:
        return len(self.coordinates)

    def __repr__(self) -> str:
        parts = [*sorted(self.fields), *["front"] * (self.front is not None)]
        return f"Cloud({', '.join([f'{len(self):,} points', *parts])})"

    def _attributes(self) -> dict[str, str]:
        """Return the fields by name; the other attributes are found by :func:`dir`."""
        return super()._attributes() | {name: f"fields[{name!r}]" for name in self.fields}

    @cached_property
    def finite(self) -> NDArray[np.bool_]:
        """Mask of points with three finite coordinates of at most 1e12, shape ``(N,)``.

        Larger coordinates are codes for missing points.
        """
        finite = np.empty(len(self), dtype=bool)
        with np.errstate(invalid="ignore"):
            for rows in split_rows(len(self), ROWS_AT_ONCE):
                x, y, z = (np.abs(column) <= FARTHEST for column in self.coordinates[rows].T)
                finite[rows] = x & y & z
        return finite

    @property
    def _finite_coordinates(self) -> NDArray[np.floating]:
        """Coordinates of the finite points, not copied if all are."""
        return self.coordinates if self.finite.all() else self.coordinates[self.finite]

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """Origin of :attr:`points`, shape ``(3,)``; see ``local_origin``."""
        finite = self._finite_coordinates
        return local_origin(*bounding_box(finite)) if len(finite) else np.zeros(3)

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
        finite = self._finite_coordinates
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
        return describe_units(self._finite_coordinates, self.header)

    def relative_to(self, origin: NDArray[np.float64]) -> Tensor:
        """Return the coordinates relative to ``origin`` ``(3,)``, float32, shape ``(N, 3)``."""
        coordinates, is_near = self.coordinates, not origin.any()
        if coordinates.dtype == np.float32 and is_near and self.finite.all():
            return torch.from_numpy(np.ascontiguousarray(coordinates))
        local = scratch.empty(coordinates.shape, np.float32)
        with np.errstate(invalid="ignore"):
            for rows in split_rows(len(local), ROWS_AT_ONCE):
                is_code = np.abs(coordinates[rows]) > FARTHEST
                local[rows] = np.where(is_code, np.nan, coordinates[rows] - origin)
        return torch.from_numpy(local)


def _as_array(values: Any) -> Any:  # noqa: ANN401
    """Convert a tensor to an array; return anything else unchanged."""
    return values.numpy(force=True) if isinstance(values, Tensor) else values
