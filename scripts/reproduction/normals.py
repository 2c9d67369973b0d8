"""Figures 3 and 4 and Table 1: errors and times of normals on shapes with known ones."""

import dataclasses
import json
import time
from itertools import product
from typing import NamedTuple

import torch

from reproduction.cells import Folder, Record
from reproduction.normal_figures import draw_errors, draw_sharp_points
from reproduction.normal_tables import write_tables
from torchrg.config import NormalsConfig
from torchrg.linalg import unsigned_angle_deg
from torchrg.metrics import score_normals
from torchrg.neighbors import search_knn
from torchrg.normals import estimate_normals
from torchrg.scenes import Scene, make_shape

K = 50
EDGE_DEG = 20.0
"""A point is at an edge if the true normal of a neighbour differs by more than this."""


_NUM_DRAWN = 6


class Grid(NamedTuple):
    """What is compared.

    Attributes:
        shapes: Names of shapes, those with edges first.
        noises: Standard deviations of the noise, in percent of the diagonal of the bounding box.
        sizes: Numbers of points.
        variants: Names of :data:`VARIANTS`.
    """

    shapes: tuple[str, ...]
    noises: tuple[float, ...]
    sizes: tuple[int, ...]
    variants: tuple[str, ...]


VARIANTS = {
    "pca": NormalsConfig(method="pca", k=K),
    "jet": NormalsConfig(method="jet", k=K),
    "detmcd": NormalsConfig(method="detmcd", k=K),
    "paper": NormalsConfig(method="paper", k=K),
    "consensus": NormalsConfig(method="consensus", k=K),
    "adaptive": NormalsConfig(method="consensus", k=K, adaptive_k=300),
    "detmm": NormalsConfig(method="detmm", k=K),
    "irls": NormalsConfig(method="irls", k=K),
    "mve": NormalsConfig(method="mve", k=K),
    "fastmcd": NormalsConfig(method="fastmcd", k=K),
}
"""Estimators by the name they have in tables, the cheap ones first; ``adaptive`` is consensus with
up to 300 neighbours."""

FULL = Grid(
    (
        *("cuboid", "dodecahedron", "octahedron", "hexagonal_prism", "stairs", "bracket", "plate"),
        *("rounded_box", "cylinder", "sphere", "torus"),
    ),
    (0.0, 0.25, 0.6, 1.2, 2.4),
    (5000, 35_000),
    tuple(VARIANTS),
)
QUICK = Grid(
    ("cuboid", "dodecahedron", "bracket", "torus"),
    (0.25, 1.2, 2.4),
    (3000,),
    tuple(name for name in VARIANTS if name not in ("fastmcd", "mve")),
)


def reproduce(folder: Folder, quick: bool) -> None:
    """Fill the grid, and write tables and figures of it.

    Args:
        folder: Where they go.
        quick: Whether a small grid will do.
    """
    grid = QUICK if quick else FULL
    records = []
    for size, name, shape, noise in product(grid.sizes, grid.variants, grid.shapes, grid.noises):
        cell = f"{shape}-{noise}-{size}-{name}"
        records.append(
            folder.cell(cell, lambda s=shape, n=noise, m=size, v=name: _measure(s, n, m, v))
        )
        print(f"{cell}: MSAE {records[-1]['score']['msae']:.1f}", flush=True)
    folder.write("normals.json", json.dumps(records, indent=1))
    write_tables(folder, records)
    draw_errors(folder.path, records)
    draw_sharp_points(folder.path, _sharp_clouds(grid))


def _measure(shape: str, noise: float, num_points: int, variant: str) -> Record:
    """Return errors and time of one estimator on one cloud."""
    scene = make_shape(shape, num_points, noise / 100)
    at_edges = _near_edges(scene)
    begin = time.perf_counter()
    fit = estimate_normals(scene.points, config=VARIANTS[variant])
    seconds = time.perf_counter() - begin
    score = score_normals(fit.normals, scene.normals, at_edges, valid=fit.valid)
    return {
        "shape": shape,
        "noise_percent": noise,
        "num_points": num_points,
        "variant": variant,
        "config": dataclasses.asdict(VARIANTS[variant]),
        "seconds": seconds,
        "score": score._asdict(),
    }


def _near_edges(scene: Scene) -> torch.Tensor:
    """Return the points whose neighbourhood holds clearly different true normals."""
    indices = search_knn(scene.points, K).indices.long()
    angles = unsigned_angle_deg(scene.normals[:, None], scene.normals[indices])
    return angles.amax(dim=1) > EDGE_DEG


def _sharp_clouds(grid: Grid) -> list[tuple[str, Scene, torch.Tensor]]:
    """Return shapes with little noise, and their sharp feature points."""
    clouds = []
    for shape in grid.shapes[:_NUM_DRAWN]:
        scene = make_shape(shape, max(FULL.sizes), 0.001)
        sharp = estimate_normals(scene.points, config=VARIANTS["paper"]).sharp
        clouds.append((shape, scene, sharp))
    return clouds
