"""What a batch is made of: scans, where they come from, and how their results are written."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchrg.batch.task import Converted
from torchrg.datasets.pointcept import write_arrays
from torchrg.errors import FormatError
from torchrg.io import CloudStream
from torchrg.io.stream import Extent
from torchrg.result import describe_planes
from torchrg.structures import FARTHEST, Cloud, Segmentation

_LOOKED_AT = 10_000
"""Points, spread over a cloud or its first chunk, that tell where most are."""
_MIDDLE = (0.25, 0.75)
_FAR_OFF = 1000
"""Extent of a cloud over that of its middle half, along any axis: float32 has seven digits, so that
beyond it steps are 1e-4 of where most points are."""


@dataclass(frozen=True)
class Scan:
    """One scan of a data set, as far as can be told without reading it.

    Attributes:
        name: Folder of its results below the output directory, with forward slashes.
        inputs: The files that it is made of.
        num_points: Its number of points by the headers or sizes of its files.
        item: What else its source needs to read it; plain values that travel between processes.
    """

    name: str
    inputs: tuple[Path, ...]
    num_points: int
    item: Any = None


class Source(Protocol):
    """A data set that can be converted: it lists its scans, and reads and writes one of them.

    Sources travel to other processes, so they hold settings and paths but no open files.
    """

    @property
    def root(self) -> Path:
        """The directory of the data set."""

    @property
    def in_place(self) -> bool:
        """Whether results may go into :attr:`root` itself."""

    @property
    def settings(self) -> Any:  # noqa: ANN401
        """A dataclass of settings of the segmentation."""

    @property
    def bytes_per_point(self) -> int:
        """Space that the results of one point take, to see beforehand whether the disk has it."""

    def describe(self) -> dict[str, Any]:
        """Return the kind of the source and what else decides results, for JSON."""

    def list_scans(self) -> list[Scan]:
        """Return the scans in natural order."""

    def convert(self, scan: Scan, folder: Path, begin: Callable[[str], None]) -> Converted:
        """Read a scan, segment it, and write its results, each file whole or not at all.

        The folder exists; ``begin`` is to be called with the name of each stage when it starts.
        """


def check_finite(cloud: Cloud | CloudStream) -> tuple[str, ...]:
    """Return a warning if points of a cloud are missing or far off; raise FormatError if all are.

    Example:
        >>> check_finite(Cloud(np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]])))
        ('2 of 3 points are not finite or beyond 1e+12; they stay in place, unlabelled',)
    """
    extent = Extent.of(cloud) if isinstance(cloud, Cloud) else cloud.extent
    num_points, num_bad = extent.num_points, extent.num_points - extent.num_finite
    if extent.num_finite == 0:
        raise FormatError(
            f"{cloud.source}: expected finite points, got none in {num_bad:,} points; those beyond "
            f"{FARTHEST:g} count as missing: use another unit, or look where they come from."
        )
    notes = []
    if num_bad:
        notes.append(
            f"{num_bad:,} of {num_points:,} points are not finite or beyond {FARTHEST:g}; they "
            "stay in place, unlabelled"
        )
    first = cloud if isinstance(cloud, Cloud) else next(iter(cloud))
    known = first.coordinates[first.finite][:: max(len(first) // _LOOKED_AT, 1)]
    if len(known):
        low, high = np.quantile(known, _MIDDLE, axis=0)
        size, width = (extent.high - extent.low).max(), float((high - low).max())
        if width > 0 and size > _FAR_OFF * width:
            notes.append(
                f"half of its points lie within {width:.3g}, single ones {size:.3g} apart, which "
                "costs the others their precision; remove those that are none"
            )
    return tuple(notes)


def write_results(
    folder: Path,
    coord: NDArray[np.floating],
    segmentation: Segmentation,
    *,
    fields: Mapping[str, NDArray[Any]] | None = None,
    origin: Sequence[float] | None = None,
) -> list[str]:
    """Write ``coord``, ``normal``, ``curvature``, ``plane`` as ``.npy``, and ``planes.json``.

    Into a folder that exists; ``coord`` ``(*, 3)`` in the dtype to be written, the segmentation of
    the same leading axes, further ``fields`` by name. ``origin`` is where the origin of the
    segmentation is, in the coordinates of ``coord``. Returns the names of the files; those of
    others are never replaced, see :func:`torchrg.datasets.pointcept.write_arrays`.
    """
    arrays: dict[str, NDArray[Any]] = {
        "coord": coord,
        "normal": segmentation.normals.numpy(),
        "curvature": segmentation.curvature.numpy(),
        "plane": segmentation.labels.numpy().astype(np.int32),
        **(fields or {}),
    }
    arrays = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    return write_arrays(folder, arrays, describe_planes(segmentation.planes, origin=origin))
