"""Writer of vertex groups (``.vg``) for PolyFit, abspy and Easy3D.

A group is a plane ``a x + b y + c z + d = 0`` with the indices of its points. A file contains
coordinates, colors, normals and groups, by ascending plane ID; other fields are dropped.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchrg.io.files import atomic_path
from torchrg.structures import UNLABELED, Cloud
from torchrg.structures.colors import read_colors


def write_vg(path: Path, cloud: Cloud) -> None:
    """Write a text file with a group for each label, and its least-squares plane."""
    number = "%.9g" if cloud.coordinates.dtype == np.float32 else "%.17g"
    colors, _ = read_colors(path, cloud.fields.get("color", np.zeros((0, 3), np.uint8)))
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as out:
        for key, rows, fmt in (
            ("points", cloud.coordinates, number),
            ("colors", colors / np.iinfo(colors.dtype).max, "%.9g"),
            ("normals", cloud.fields.get("normals", np.zeros((0, 3))), "%.9g"),
        ):
            out.write(f"num_{key}: {len(rows)}\n")
            np.savetxt(out, rows, fmt=fmt)
        labels = cloud.fields.get("labels", np.full(len(cloud), UNLABELED)).astype(np.int64)
        order = np.argsort(labels, kind="stable")[np.count_nonzero(labels < 0) :]
        _, sizes = np.unique(labels[order], return_counts=True)
        out.write(f"num_groups: {len(sizes)}\n")
        for index, rows in enumerate(np.split(order, np.cumsum(sizes))[:-1]):
            out.write("group_type: 0\nnum_group_parameters: 4\n")  # Type 0 is a plane.
            plane = _fit_plane(cloud.coordinates[rows])
            out.write(f"group_parameters: {' '.join(f'{value:.17g}' for value in plane)}\n")
            # A color that differs from the colors of earlier groups.
            color = [0.2 + 0.7 * ((index + 1) * step % 1) for step in (0.618, 0.382, 0.854)]
            out.write(f"group_label: plane_{index}\n")
            out.write(f"group_color: {' '.join(f'{round(value, 4)}' for value in color)}\n")
            out.write(f"group_num_point: {len(rows)}\n{' '.join(map(str, rows))}\n")
            out.write("num_children: 0\n")


def _fit_plane(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the least-squares plane of points; zero if there are fewer than 3."""
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(points) < 3:
        return np.zeros(4)
    center = points.mean(axis=0)
    normal = np.linalg.eigh((points - center).T @ (points - center))[1][:, 0]
    return np.array([*normal, -normal @ center])
