"""A cloud in tiles: steps of the pipeline as tasks for a range of rows, and what only files need.

A tile is worked on by the functions that serve clouds in memory too, on the tile with the points
around it that these look at; arrays of the whole cloud take a few bytes a point.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._compile import compiled
from torchrg._parallel import sequential_operations
from torchrg.config import GrowingConfig, NormalsConfig, PipelineConfig
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

Work = Callable[[Any, slice, int, PipelineConfig], None]
"""A step on the rows of a block, which has a number, of a store."""


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
        store = TileStore(self.folder)
        with sequential_operations(), torch.no_grad(), compiled(self.config.compile):
            self.work(store, slice(*self.rows), self.number, self.config)
        return store.written


class TileStore(FolderStore):
    """The arrays of a run in a folder, worked on tile by tile: boxes of points that lie together.

    See :class:`torchrg.store.FolderStore` for its arguments and errors.
    """

    in_one_block = False

    def run_blocks(self, name: str, work: Work, config: PipelineConfig) -> None:
        """Run a step on each tile that it is not done on."""
        bounds = enumerate(itertools.pairwise(self.known("order")["bounds"]))
        tasks = [TileTask(self.folder, name, number, config, rows, work) for number, rows in bounds]
        left = [task for task in tasks if not self.is_done(task.name)]
        self.on_progress(name, len(tasks) - len(left), len(tasks))
        if left or not tasks:
            _BEGIN[name](self, config)
        for done, (task, written) in enumerate(self.run(left), len(tasks) - len(left) + 1):
            self.note(task.name, written)
            self.on_progress(name, done, len(tasks))

    def choose_blocks(self, points: Tensor, k: int, config: PipelineConfig) -> list[int]:
        """Find boxes about the points, and return where tiles end: where boxes do."""
        edge_bytes = 0 if is_order_free(config.growing) else 5 * k
        wider_bytes = 4 * (config.normals.adaptive_k or 0) if _adapts(config.normals) else 0
        row_bytes = _ROW_BYTES + 4 * k + wider_bytes + edge_bytes
        check_space(self.folder, len(points) * row_bytes, "the work")
        boxes = find_boxes(points.numpy())
        for name, values in boxes._asdict().items():
            self.save(f"boxes_{name}", values)
        wanted = np.arange(0, len(points), self.tile_size)
        ends = boxes.starts[np.searchsorted(boxes.starts, wanted)]
        # Tiles that are done stay, where the order alone is made again.
        found = np.unique(np.append(ends, len(points))).tolist()
        return list(self.known("order").get("bounds", found))

    def search_neighbors(self, tile: slice, k: int, name: str = "neighbors") -> None:
        """Search the nearest neighbours of the points of a tile."""
        boxes = Boxes(*(self.get(f"boxes_{part}").numpy() for part in Boxes._fields))
        self.write(name, tile.start, search_tile(self.lazy("cloud"), boxes, tile, k))

    def widen_neighbors(self, config: PipelineConfig) -> None:
        """Search more neighbours where the noise of the whole cloud, which no tile tells, asks."""
        if _adapts(config.normals):
            self.run_blocks("noise", _measure_noise, config)
            self.once("width", partial(_choose_width, self, config))
            self.run_blocks("wider_neighbors", _search_wider, config)

    def neighbors_for_normals(self, config: NormalsConfig) -> tuple[str, NormalsConfig]:
        """Return the array of the neighbours that normals are estimated from, and settings."""
        is_wider = self.known("width").get("k", 0) > self.known("order")["k"]
        return "wider_neighbors" if is_wider else "neighbors", replace(config, adaptive_k=None)

    def around(self, tile: slice, steps: int, lists: str = "neighbors") -> Part:
        """Return a tile with all points that so many steps from neighbour to neighbour lead to."""
        return cut_part(self.lazy(lists), tile, steps)

    def keep_edges(self, found: GrowthEdges, part: Part, tile: slice, number: int) -> None:
        """Write the edges of a tile: those of seeds without what reaches one another."""
        if found.claims is not None:
            self.write("claims", tile.start, found.claims[part.own])
        if found.of_seeds is not None:
            condensed = condense(found.of_seeds, part)
            self.write("components", tile.start, condensed.components)
            self.save(f"sources_{number}", condensed.sources)
            self.save(f"targets_{number}", condensed.targets)
        coded = _own_edges(found.coded, part)
        self.save(f"edges_{number}", coded.targets)
        self.write("counts", tile.start, np.diff(coded.starts))

    def grow(self, order: GrowthOrder, config: GrowingConfig) -> NDArray[np.int32]:
        """Grow along the edges of tiles: condensed ones in memory, all of them read in parts."""
        starts, lists = self._join_edges(), self.read("neighbors")
        if not is_order_free(config):
            claims = self.read("claims") if promotes_late(config) else None
            edges = GrowthEdges(EdgeLists(starts, self.read("edges")), claims=claims)
            return grow_along(edges, order, lists, config)
        components = self.get("components").numpy()
        parts = [
            Condensed(
                components[slice(*rows)],
                self.get(f"sources_{number}").numpy(),
                self.get(f"targets_{number}").numpy(),
            )
            for number, rows in enumerate(itertools.pairwise(self.known("order")["bounds"]))
        ]
        edges = GrowthEdges(EdgeLists(starts, self.get("edges").numpy()))
        return grow_along(edges, order, lists, config, partial(join_condensed, parts))

    def _join_edges(self) -> NDArray[np.int64]:
        """Put the edges of all tiles into one file; return where those of each point start."""
        counts = self.get("counts").numpy()
        starts = np.zeros(len(counts) + 1, dtype=np.int64)
        np.cumsum(counts, out=starts[1:])
        self.create("edges", np.int32, (int(starts[-1]),))
        for number, start in enumerate(self.known("order")["bounds"][:-1]):
            self.write("edges", int(starts[start]), self.get(f"edges_{number}"))
        return starts


def _begin_neighbors(store: TileStore, config: PipelineConfig) -> None:
    order = store.known("order")
    store.create("neighbors", np.int32, (order["num_points"], order["k"]))


def _begin_noise(store: TileStore, config: PipelineConfig) -> None:
    store.create("noise", store.read("cloud").dtype, (store.known("order")["num_points"],))


def _begin_wider(store: TileStore, config: PipelineConfig) -> None:
    shape = (store.known("order")["num_points"], store.known("width")["k"])
    store.create("wider_neighbors", np.int32, shape)


def _begin_normals(store: TileStore, config: PipelineConfig) -> None:
    num_points, kind = store.known("order")["num_points"], store.read("cloud").dtype
    for name, dtype in zip(FIT, (kind, kind, np.bool_, kind, np.bool_), strict=True):
        store.create(name, dtype, (num_points, 3) if name == "normals" else (num_points,))


def _begin_edges(store: TileStore, config: PipelineConfig) -> None:
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


def _adapts(config: NormalsConfig) -> bool:
    """Return whether the noise of the whole cloud decides how many neighbours normals have."""
    return config.method == "consensus" and config.adaptive_k is not None


def _measure_noise(store: TileStore, tile: slice, number: int, config: PipelineConfig) -> None:
    part = store.around(tile, NOISE_STEPS)
    shares = share_of_noise(store.lazy("cloud")[part.rows], part.neighbors, config.chunk_size)
    store.write("noise", tile.start, shares[part.own])


def _choose_width(store: TileStore, config: PipelineConfig) -> None:
    k = wanted_neighbors(store.get("noise"), store.known("order")["k"], config.normals)
    store.note("width", k=k)


def _search_wider(store: TileStore, tile: slice, number: int, config: PipelineConfig) -> None:
    k = store.known("width")["k"]
    if k > store.known("order")["k"]:
        store.search_neighbors(tile, k, "wider_neighbors")


def _own_edges(edges: EdgeLists, part: Part) -> EdgeLists:
    """Return the coded edges of the points of the tile, with targets in the whole cloud."""
    starts = edges.starts[part.own.start : part.own.stop + 1]
    targets = edges.targets[starts[0] : starts[-1]]
    rows = part.numbers.astype(np.int32)
    return EdgeLists(starts - starts[0], rows[targets >> 1] * 2 + (targets & 1))
