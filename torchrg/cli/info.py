"""``torchrg info``: summary of a point cloud file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from torchrg import kernels
from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import print_lines
from torchrg.cli.flags import ColumnsFlag, check_columns, describe_sampling, file_columns
from torchrg.config import load_config
from torchrg.io import read_cloud
from torchrg.neighbors import distinct_points, measure_sampling
from torchrg.neighbors.knn import prepare_search
from torchrg.regions.directions import likely_up
from torchrg.structures import Cloud
from torchrg.structures.points import Array, bounding_box

_DIGITS = {4: 6, 8: 10}
"""Significant digits printed for a coordinate, by its size in bytes. float32 has at most six; ten
resolve a millimeter at a thousand kilometers."""
_NUM_NEIGHBORS = 50
"""Number of neighbors for measuring the surfaces, as in the default preset."""
_NUM_FOR_SPACING = 10_000
"""Number of points, evenly along the canonical order, from which the spacing is measured."""


@dataclass(frozen=True)
class Arguments:
    """Print a summary of a point cloud file and the compiled kernels.

    Points, extent, spacing, duplicates and fields.

    Examples:
        torchrg info scan.ply
        torchrg info scan.txt --columns x,y,z,intensity
    """

    file: Annotated[Path, Argument("FILE", is_positional=True)]
    """Input point cloud."""
    columns: ColumnsFlag = None


def run(argv: list[str]) -> int:
    """Parse the arguments and print the summary."""
    arguments = parse(Arguments, argv, prog="torchrg info")
    check_columns(arguments.columns, [arguments.file])
    cloud = read_cloud(arguments.file, columns=file_columns(arguments.file, arguments.columns))
    for name, value in describe_cloud(cloud).items():
        print_lines(f"{name:<12}{value}")
    for note in filter(None, (*cloud.notes, cloud.unit_note, cloud.precision_note)):
        print_lines(f"{'note':<12}{note}")
    print_lines(f"{'kernels':<12}{kernels.name_of_library() or 'none (several times slower)'}")
    return 0


def _describe_up(positions: Array, rows: Array, near: Array) -> str:
    """Return the axis that is likely up, from planes through the neighbors of some points."""
    local = positions[near].astype(np.float64)
    offsets = local - local.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets)[1][:, :, 0]
    # The square of the radius of a neighborhood is proportional to the area of a point.
    areas = np.square(local[:, -1] - positions[rows]).sum(axis=1)
    axis = likely_up(normals, positions[rows], areas, np.array([0.0, 0, 1]))
    return f"{axis}, whose floor and ceiling are largest; pass --up {axis}" if axis else "z"


def describe_cloud(cloud: Cloud) -> dict[str, str]:
    """Return the properties of a cloud by name."""
    facts = {"points": f"{len(cloud):,} of {cloud.coordinates.dtype}"}
    if cloud.grid_shape:
        facts["grid"] = f"{cloud.grid_shape[0]} rows x {cloud.grid_shape[1]} columns"
    finite = cloud.coordinates if cloud.finite.all() else cloud.coordinates[cloud.finite]
    facts["not finite"] = f"{len(cloud) - len(finite):,}"
    if len(finite):
        low, high = (end.astype(finite.dtype) for end in bounding_box(finite))
        digits = _DIGITS[cloud.coordinates.dtype.itemsize]
        for name, values in (("lowest", low), ("highest", high), ("extent", high - low)):
            facts[name] = " ".join(f"{value:.{digits}g}" for value in values)
        centered = finite - cloud.origin if cloud.origin.any() else finite
        distinct = distinct_points(torch.from_numpy(centered))
        facts["duplicates"] = f"{distinct.num_copies:,}"
        positions = distinct.points.numpy()
        facts["spacing"] = "none"
        if len(positions) > 1:
            search = prepare_search(positions, min(_NUM_NEIGHBORS, len(positions)))
            rows = np.arange(0, len(positions), -(-len(positions) // _NUM_FOR_SPACING))
            near = search(rows)
            steps = positions[rows] - positions[near[:, 1]]
            spacing = np.median(np.linalg.norm(steps, axis=1))
            facts["spacing"] = f"{spacing:.4g} (median to the nearest point)"
            sampling = measure_sampling(torch.from_numpy(positions), search)
            chosen = load_config().measured(sampling)["settings"]
            facts["up axis"] = _describe_up(positions, rows, near)
            facts["height"] = f"{sampling.height:g} (smallest extent along the principal axes)"
            facts["density"] = f"{sampling.density:g} points on a square of side 1"
            facts["surfaces"] = describe_sampling(sampling, chosen)
    for name, values in cloud.fields.items():
        shape = " x ".join(map(str, values.shape[1:])) or "1"
        facts[name] = f"{shape} {values.dtype}"
    return facts
