"""A cloud in tiles: steps of the pipeline as tasks for a range of rows, and what only files need.

A tile is worked on by the functions that serve clouds in memory too, on the tile with the points
around it that these look at; arrays of the whole cloud take a few bytes a point.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchrg._parallel import sequential_operations
from torchrg.config import NormalsConfig, PipelineConfig
from torchrg.io.files import check_space
from torchrg.neighbors.octree import Boxes, find_boxes
from torchrg.neighbors.tiles import Part, cut_part, search_tile
from torchrg.normals import NOISE_STEPS
from torchrg.normals.consensus import share_of_noise, wanted_neighbors
from torchrg.regions.condensed import Condensed, condense, join_condensed
from torchrg.regions.edges import EdgeLists, is_order_free, promotes_late
from torchrg.regions.growth import GrowthEdges, GrowthOrder, grow_along
from torchrg.store import FolderStore, Written

BYTES_PER_TILE_POINT = 2_000
"""Memory that a tile takes for each of its own points, with those around it."""
BYTES_PER_POINT = 100
"""Memory that the stages on the whole cloud take for each of its points: the regions of
``consensus``, or the table of planes, 55, with 150 for each point of the largest region, which may
be a third of all."""
BYTES_AT_ONCE, POINTS_AT_ONCE = 250, 1_500_000
"""Memory beside that for each point up to so many: regions that are measured together."""

_ROW_BYTES = 150
"""Of a point on disk beside its neighbours and edges: coordinates, normals, results."""
FIT = ("normals", "curvature", "valid", "residual_rms", "sharp")
"""Arrays of a fit of normals, in its order."""

Work = Callable[[FolderStore, slice, int, PipelineConfig], None]
"""A step on the rows of the tile of a number."""


@dataclass(frozen=True)
class TileTask:
    """One step on one tile: all that a process on any machine that sees the folder needs."""

    folder: Path
    stage: str
    number: int
    config: PipelineConfig
    rows: tuple[int, int]
    work: Work

    @property
    def name(self) -> str:
        """Stage and tile, for messages and the record of what is done."""
        return f"{self.stage} {self.number}"

    @property
    def num_points(self) -> int:
        """Points of the tile."""
        return self.rows[1] - self.rows[0]

    def run(self) -> list[Written]:
        """Do the work, and write what it found; the same again does no harm.

        Returns:
            What has been written, to be noted with the task.
        """
        store = FolderStore(self.folder)
        with sequential_operations(), torch.no_grad():
            self.work(store, slice(*self.rows), self.number, self.config)
        return store.written


def run_tiles(store: FolderStore, name: str, work: Work, config: PipelineConfig) -> None:
    """Run a step on each tile that it is not done on."""
    bounds = enumerate(itertools.pairwise(store.known("order")["bounds"]))
    tasks = [TileTask(store.folder, name, number, config, rows, work) for number, rows in bounds]
    left = [task for task in tasks if not store.is_done(task.name)]
    store.on_progress(name, len(tasks) - len(left), len(tasks))
    if left or not tasks:
        _BEGIN[name](store, config)
    for done, (task, written) in enumerate(store.run(left), len(tasks) - len(left) + 1):
        store.note(task.name, written)
        store.on_progress(name, done, len(tasks))


def choose_tiles(
    store: FolderStore, points: NDArray[np.floating], k: int, config: PipelineConfig
) -> list[int]:
    """Find boxes about the points, and return where tiles end: where boxes do."""
    edge_bytes = 0 if is_order_free(config.growing) else 5 * k
    wider_bytes = 4 * (config.normals.adaptive_k or 0) if adapts(config.normals) else 0
    row_bytes = _ROW_BYTES + 4 * k + wider_bytes + edge_bytes
    check_space(store.folder, len(points) * row_bytes, "the work")
    boxes = find_boxes(points)
    for name, values in boxes._asdict().items():
        store.save(f"boxes_{name}", values)
    wanted = np.arange(0, len(points), store.tile_size)
    ends = boxes.starts[np.searchsorted(boxes.starts, wanted)]
    # Tiles that are done stay, where the order alone is made again.
    found = np.unique(np.append(ends, len(points))).tolist()
    return list(store.known("order").get("bounds", found))


def _begin_neighbors(store: FolderStore, config: PipelineConfig) -> None:
    order = store.known("order")
    store.create("neighbors", np.int32, (order["num_points"], order["k"]))


def _begin_noise(store: FolderStore, config: PipelineConfig) -> None:
    store.create("noise", store.read("cloud").dtype, (store.known("order")["num_points"],))


def _begin_wider(store: FolderStore, config: PipelineConfig) -> None:
    shape = (store.known("order")["num_points"], store.known("width")["k"])
    store.create("wider_neighbors", np.int32, shape)


def _begin_normals(store: FolderStore, config: PipelineConfig) -> None:
    num_points, kind = store.known("order")["num_points"], store.read("cloud").dtype
    for name, dtype in zip(FIT, (kind, kind, np.bool_, kind, np.bool_), strict=True):
        store.create(name, dtype, (num_points, 3) if name == "normals" else (num_points,))


def _begin_edges(store: FolderStore, config: PipelineConfig) -> None:
    order = store.known("order")
    num_points, tiles = order["num_points"], range(len(order["bounds"]) - 1)
    lists = ("edges", "sources", "targets")
    store.reserve(*(store.path(f"{name}_{number}").name for name in lists for number in tiles))
    store.create("counts", np.int32, (num_points,))
    store.create("components", np.int32, (num_points,))
    store.create("reach", store.read("cloud").dtype, (num_points,))
    if promotes_late(config.growing):
        store.create("claims", np.bool_, (num_points, order["k"]))


_BEGIN = {
    "neighbors": _begin_neighbors,
    "noise": _begin_noise,
    "wider_neighbors": _begin_wider,
    "normals": _begin_normals,
    "edges": _begin_edges,
}
"""Make the files whose rows the tiles write; those of a run that ended early keep their rows."""


def search_neighbors(store: FolderStore, tile: slice, name: str, k: int) -> None:
    """Search the nearest neighbours of the points of a tile."""
    boxes = Boxes(*(store.get(f"boxes_{part}").numpy() for part in Boxes._fields))
    store.write(name, tile.start, search_tile(store.lazy("cloud"), boxes, tile, k))


def adapts(config: NormalsConfig) -> bool:
    """Return whether the noise of the whole cloud decides how many neighbours normals have."""
    return config.method == "consensus" and config.adaptive_k is not None


def measure_noise(store: FolderStore, tile: slice, number: int, config: PipelineConfig) -> None:
    """Measure the noise about the points of a tile."""
    part = cut_part(store.lazy("neighbors"), tile, NOISE_STEPS)
    shares = share_of_noise(store.lazy("cloud")[part.rows], part.neighbors, config.chunk_size)
    store.write("noise", tile.start, shares[part.own])


def choose_width(store: FolderStore, config: PipelineConfig) -> None:
    """Choose the number of neighbours that normals are estimated from."""
    k = wanted_neighbors(store.get("noise"), store.known("order")["k"], config.normals)
    store.note("width", k=k)


def search_wider(store: FolderStore, tile: slice, number: int, config: PipelineConfig) -> None:
    """Search so many neighbours of the points of a tile, if they are more than there are."""
    k = store.known("width")["k"]
    if k > store.known("order")["k"]:
        search_neighbors(store, tile, "wider_neighbors", k)


def wider_neighbors(store: FolderStore, config: NormalsConfig) -> tuple[str, NormalsConfig]:
    """Return the array of the neighbours that normals are estimated from, and settings for them."""
    is_wider = store.known("width").get("k", 0) > store.known("order")["k"]
    return "wider_neighbors" if is_wider else "neighbors", replace(config, adaptive_k=None)


def keep_edges(
    store: FolderStore, found: GrowthEdges, part: Part, tile: slice, number: int
) -> None:
    """Write the edges of a tile: those of seeds without what reaches one another."""
    if found.claims is not None:
        store.write("claims", tile.start, found.claims[part.own])
    if found.of_seeds is not None:
        condensed = condense(found.of_seeds, part)
        store.write("components", tile.start, condensed.components)
        store.save(f"sources_{number}", condensed.sources)
        store.save(f"targets_{number}", condensed.targets)
    coded = _own_edges(found.coded, part)
    store.save(f"edges_{number}", coded.targets)
    store.write("counts", tile.start, np.diff(coded.starts))


def _own_edges(edges: EdgeLists, part: Part) -> EdgeLists:
    """Return the coded edges of the points of the tile, with targets in the whole cloud."""
    starts = edges.starts[part.own.start : part.own.stop + 1]
    targets = edges.targets[starts[0] : starts[-1]]
    rows = part.numbers.astype(np.int32)
    return EdgeLists(starts - starts[0], rows[targets >> 1] * 2 + (targets & 1))


def grow_on_disk(
    store: FolderStore, order: GrowthOrder, config: PipelineConfig
) -> NDArray[np.int32]:
    """Grow along the edges of tiles: condensed ones in memory, all of them read in parts."""
    starts, lists = _join_edges(store), store.read("neighbors")
    if not is_order_free(config.growing):
        claims = store.read("claims") if promotes_late(config.growing) else None
        edges = GrowthEdges(EdgeLists(starts, store.read("edges")), claims=claims)
        return grow_along(edges, order, lists, config.growing)
    components = store.get("components").numpy()
    parts = [
        Condensed(
            components[slice(*rows)],
            store.get(f"sources_{number}").numpy(),
            store.get(f"targets_{number}").numpy(),
        )
        for number, rows in enumerate(itertools.pairwise(store.known("order")["bounds"]))
    ]
    edges = GrowthEdges(EdgeLists(starts, store.get("edges").numpy()))
    return grow_along(edges, order, lists, config.growing, partial(join_condensed, parts))


def _join_edges(store: FolderStore) -> NDArray[np.int64]:
    """Put the edges of all tiles into one file; return where those of each point start."""
    counts = store.get("counts").numpy()
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=starts[1:])
    bounds = store.known("order")["bounds"]
    store.create("edges", np.int32, (int(starts[-1]),))
    for number, start in enumerate(bounds[:-1]):
        store.write("edges", int(starts[start]), store.get(f"edges_{number}"))
    return starts
