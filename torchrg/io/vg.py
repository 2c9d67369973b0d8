"""Vertex groups, ``.vg``: planes of a cloud for PolyFit, abspy and Easy3D. They are written only.

A group is a plane ``a x + b y + c z + d = 0`` with the rows of its points. A file holds
coordinates, colours, normals and groups; other fields are left out. Groups have no numbers: labels
are written in ascending order.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchrg.io.colors import read_colors
from torchrg.io.fields import Values
from torchrg.io.files import atomic_path
from torchrg.structures import UNLABELED, Cloud

_PLANE = 0
"""Type of a group that is a plane."""


def write_vg(path: Path, cloud: Cloud, planes: NDArray[np.floating] | None = None) -> None:
    """Write text; ``planes`` ``(M, 4)`` are those of the labels, else they are fitted."""
    number = "%.9g" if cloud.coordinates.dtype == np.float32 else "%.17g"
    colors: Values = cloud.fields.get("color", np.zeros((0, 3), np.uint8))
    colors, _ = read_colors(path, colors)
    with atomic_path(path) as beside, beside.open("w", encoding="ascii", newline="\n") as file:
        for key, rows, form in (
            ("points", cloud.coordinates, number),
            ("colors", colors / np.iinfo(colors.dtype).max, "%.9g"),
            ("normals", cloud.fields.get("normals", np.zeros((0, 3))), "%.9g"),
        ):
            file.write(f"num_{key}: {len(rows)}\n")
            np.savetxt(file, rows, fmt=form)
        groups = _groups(cloud, planes)
        file.write(f"num_groups: {len(groups)}\n")
        for place, (plane, rows) in enumerate(groups):
            file.write(f"group_type: {_PLANE}\nnum_group_parameters: 4\n")
            file.write(f"group_parameters: {' '.join(f'{value:.17g}' for value in plane)}\n")
            file.write(f"group_label: plane_{place}\ngroup_color: {_group_color(place)}\n")
            file.write(f"group_num_point: {len(rows)}\n{' '.join(map(str, rows))}\n")
            file.write("num_children: 0\n")


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


def _group_color(place: int) -> str:
    """Return a colour that differs from those of the planes before."""
    colors = (0.2 + 0.7 * ((place + 1) * step % 1) for step in (0.618, 0.382, 0.854))
    return " ".join(f"{round(color, 4)}" for color in colors)
