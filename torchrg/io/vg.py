"""Vertex groups, ``.vg`` and ``.bvg``: planes of a cloud for PolyFit, abspy and Easy3D.

A group is a plane ``a x + b y + c z + d = 0`` with the rows of its points. The files hold
coordinates, normals, groups and, ``.vg`` alone, colours; other fields are left out. Groups have no
numbers: labels are written in ascending order and read back as 0, 1, 2. Groups inside of groups are
read too, and a point has the innermost.
"""

import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrg.errors import FormatError
from torchrg.io.fields import Columns
from torchrg.io.files import DAMAGES, atomic_path, check_promise, refusing
from torchrg.io.stream import CloudStream, Table, slices
from torchrg.structures import UNLABELED, Cloud

_PLANE = 0
"""Type of a group that is a plane."""
_LEAST_BYTES = 2
"""A number of a text and the blank after it take as much, which bounds what a count promises."""


class _Groups(NamedTuple):
    """A file: points and colours and normals ``(N, 3)``, the latter of no rows where unknown."""

    points: NDArray[np.floating]
    colors: NDArray[np.floating]
    normals: NDArray[np.floating]
    labels: NDArray[np.int64]

    def columns(self) -> Columns:
        """Return the columns of the cloud."""
        found: dict[str, NDArray[np.generic]] = {"points": self.points, "label": self.labels}
        if len(self.colors):
            found["color"] = np.rint(self.colors.clip(0, 1) * 255).astype(np.uint8)
        if len(self.normals):
            found["normals"] = self.normals.astype(np.float32)
        return found


class _Numbers:
    """Numbers of a file one after the other: words of a text, or little-endian bytes."""

    def __init__(self, path: Path, content: bytes, *, is_text: bool) -> None:
        self._path, self._content, self._is_text = path, content, is_text
        self._words = content.split() if is_text else []
        self._place = 0

    def whole(self, key: bytes) -> int:
        """Return the number after a key, which a text has and bytes have not."""
        if self._is_text:
            found = self._words[self._place]
            if not found.startswith(key):
                raise ValueError(f"{found[:40]!r} for {key.decode()!r}")
            self._place += 1
        return int(self.array(1, "i4")[0])

    def array(self, count: int, code: str) -> NDArray[Any]:
        """Return so many numbers."""
        size, before = (_LEAST_BYTES, 0) if self._is_text else (4, self._place)
        left = len(self._content) - before
        check_promise(self._path, before, count * size, f"{count:,} numbers", available=left)
        if self._is_text:
            words = self._words[self._place : self._place + max(count, 0)]
            self._place += len(words)
            found: NDArray[Any] = np.array(words, "S").astype("f8" if code == "f4" else "i8")
        else:
            found = np.frombuffer(self._content, f"<{code}", max(count, 0), self._place)
            self._place += found.nbytes
        if len(found) != count:
            raise EOFError(f"{len(found):,} of {count:,} numbers")
        return found

    def skip_label(self) -> None:
        """Pass over the name of a group, which may have blanks."""
        if self._is_text:
            while not self._words[self._place].startswith(b"group_color"):
                self._place += 1
        else:
            length = self.whole(b"")
            self._place += max(length, 0)

    def skip_key(self) -> None:
        """Pass over a key of a text."""
        self._place += self._is_text


def _read(path: Path, is_text: bool) -> _Groups:
    """Read a file."""
    message = f"{path}: expected vertex groups, got: "
    with refusing(message, *DAMAGES, repair="; write the file again"):
        numbers = _Numbers(path, path.read_bytes(), is_text=is_text)
        points, colors, normals = (
            numbers.array(3 * numbers.whole(key), "f4").reshape(-1, 3)
            for key in (b"num_points", b"num_colors", b"num_normals")
        )
        for part in (colors, normals):
            if len(part) not in (0, len(points)):
                raise ValueError(f"{len(part):,} rows for {len(points):,} points")
        labels = np.full(len(points), UNLABELED, dtype=np.int64)
        waiting, count = numbers.whole(b"num_groups"), 0
        while waiting:
            numbers.whole(b"group_type")
            num_parameters = numbers.whole(b"num_group_parameters")
            numbers.skip_key()
            numbers.array(num_parameters, "f4")
            numbers.skip_label()
            numbers.skip_key()
            numbers.array(3, "f4")
            labels[numbers.array(numbers.whole(b"group_num_point"), "i4")] = count
            waiting += numbers.whole(b"num_children") - 1
            count += 1
    return _Groups(points, colors, normals, labels)


def _open(is_text: bool, path: Path, size: int) -> Table:
    """Open a file."""

    def read(chunk_size: int) -> Iterator[Columns]:
        columns = _read(path, is_text).columns()
        for rows in slices(len(columns["points"]), chunk_size):
            yield {name: values[rows] for name, values in columns.items()}

    with path.open("rb") as stream:
        num_points = _count(stream.read(64), is_text)
    return Table(read, num_points, coordinates="points")


def _count(head: bytes, is_text: bool) -> int | None:
    """Return the number of points that the beginning of a file says."""
    if not is_text:
        return int(struct.unpack("<i", head[:4])[0]) if len(head) >= 4 else None
    words = head.split()
    return int(words[1]) if len(words) > 1 and words[1].isdigit() else None


open_vg: Callable[[Path, int], Table] = partial(_open, True)
open_bvg: Callable[[Path, int], Table] = partial(_open, False)


def write_vg(path: Path, stream: CloudStream, planes: NDArray[np.floating] | None = None) -> None:
    """Write text; ``planes`` ``(M, 4)`` are those of the labels, else they are fitted."""
    cloud = stream.read()
    number = "%.9g" if cloud.coordinates.dtype == np.float32 else "%.17g"
    colors, normals = _colors(cloud), _normals(cloud)
    with atomic_path(path) as beside, beside.open("w", encoding="ascii", newline="\n") as file:
        for key, rows, form in (
            ("points", cloud.coordinates, number),
            ("colors", colors, "%.9g"),
            ("normals", normals, "%.9g"),
        ):
            file.write(f"num_{key}: {len(rows)}\n")
            np.savetxt(file, rows, fmt=form)
        groups = _groups(cloud, planes)
        file.write(f"num_groups: {len(groups)}\n")
        for place, (plane, rows) in enumerate(groups):
            red, green, blue = _group_color(place)
            file.write(f"group_type: {_PLANE}\nnum_group_parameters: 4\n")
            file.write(f"group_parameters: {' '.join(f'{value:.17g}' for value in plane)}\n")
            file.write(f"group_label: plane_{place}\ngroup_color: {red} {green} {blue}\n")
            file.write(f"group_num_point: {len(rows)}\n{' '.join(map(str, rows))}\n")
            file.write("num_children: 0\n")


def write_bvg(path: Path, stream: CloudStream, planes: NDArray[np.floating] | None = None) -> None:
    """Write bytes, as :func:`write_vg` but for colours, which abspy does not expect there."""
    cloud = stream.read()
    if cloud.origin.any():
        raise FormatError(
            f"{path}: expected coordinates near the origin, which float32 holds, got some about "
            f"{' '.join(f'{value:.9g}' for value in cloud.origin)}; write .vg, or move them."
        )
    with atomic_path(path) as beside, beside.open("wb") as file:
        for rows in (cloud.coordinates, np.zeros((0, 3)), _normals(cloud)):
            file.write(struct.pack("<i", len(rows)) + rows.astype("<f4").tobytes())
        groups = _groups(cloud, planes)
        file.write(struct.pack("<i", len(groups)))
        for place, (plane, rows) in enumerate(groups):
            label = f"plane_{place}".encode()
            file.write(struct.pack("<ii4fi", _PLANE, 4, *plane, len(label)) + label)
            file.write(struct.pack("<3fi", *_group_color(place), len(rows)))
            file.write(rows.astype("<i4").tobytes() + struct.pack("<i", 0))


def _colors(cloud: Cloud) -> NDArray[Any]:
    """Return the colours in [0, 1], none where they are not known."""
    values: NDArray[Any] = cloud.fields.get("color", np.zeros((0, 3), np.uint8))
    return values / np.iinfo(values.dtype).max


def _normals(cloud: Cloud) -> NDArray[Any]:
    """Return the normals, none where they are not known."""
    return cloud.fields.get("normals", np.zeros((0, 3), np.float32))


def _groups(
    cloud: Cloud, planes: NDArray[np.floating] | None
) -> list[tuple[NDArray[np.floating], NDArray[np.integer]]]:
    """Return the plane of each label and the rows of its points, labels ascending."""
    labels = cloud.fields.get("labels", np.full(len(cloud), UNLABELED)).astype(np.int64)
    order = np.argsort(labels, kind="stable")
    order = order[labels[order] >= 0]
    names, starts = np.unique(labels[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(names) else []
    return [
        (_fitted(cloud.coordinates[rows]) if planes is None else planes[name], rows)
        for name, rows in zip(names, parts, strict=True)
    ]


def _fitted(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the least-squares plane of points, zero where they have none."""
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(points) < 3:
        return np.zeros(4)
    middle = points.mean(axis=0)
    normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    return np.array([*normal, -normal @ middle])


def _group_color(place: int) -> tuple[float, float, float]:
    """Return a colour that differs from those of the planes before."""
    return tuple(round((0.2 + 0.7 * ((place + 1) * step % 1)), 4) for step in (0.618, 0.382, 0.854))  # type: ignore[return-value]
