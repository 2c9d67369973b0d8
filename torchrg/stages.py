"""The stages of the pipeline, functions of a store and of a block of rows or of the whole cloud.

Each reads the arrays of the stages before it and writes its own. Stages of the first kind work on
a block with the points around it that decide what is found there: as many steps from neighbour to
neighbour away as is said beside the functions that they call. In memory the block is the cloud.
"""

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import return_freed_memory, sequential_operations
from torchrg.config import PipelineConfig
from torchrg.errors import ConfigError
from torchrg.io.files import check_space
from torchrg.neighbors import (
    canonical_order,
    finite_rows,
    restore_points,
    restore_rows,
    sample_voxels,
    search_knn,
)
from torchrg.neighbors.octree import Boxes, find_boxes
from torchrg.neighbors.tiles import Part, cut_part, search_tile
from torchrg.normals import ESTIMATORS, STEPS
from torchrg.regions import summarize_planes
from torchrg.regions.condensed import Condensed, condense, join_condensed
from torchrg.regions.edges import (
    EDGE_STEPS,
    EdgeLists,
    GrowingCloud,
    is_order_free,
    promotes_late,
)
from torchrg.regions.growth import (
    GrowthEdges,
    GrowthOrder,
    by_column,
    checked_cloud,
    find_growth_edges,
    grow_along,
    growth_order,
    label_regions,
)
from torchrg.store import FolderStore, MemoryStore, Written
from torchrg.structures import UNLABELED, Neighbors, PlaneAdjacency, Segmentation

Store = MemoryStore | FolderStore

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

_FIT = ("normals", "curvature", "valid", "residual_rms", "sharp")
_RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


def begin(store: Store, config: PipelineConfig, voxel: float | None) -> None:
    """Tell a store what decides the result."""
    if isinstance(store, MemoryStore):
        return
    if config.normals.adaptive_k is not None:
        raise ConfigError(
            "segment_planes: expected normals.adaptive_k of none, got "
            f"{config.normals.adaptive_k}: in tiles k is known before the noise of the whole cloud "
            "is; choose k, or give the cloud memory."
        )
    settings = dataclasses.asdict(config)
    del settings["chunk_size"]
    store.begin(config=settings, voxel=voxel)


def sort_points(store: Store, config: PipelineConfig, voxel: float | None) -> None:
    """Sort the finite points, or those that stand for voxels, and choose the blocks of rows."""
    points = store.get("points")
    if voxel is None:
        rows = finite_rows(points)
    else:
        voxels = sample_voxels(points, voxel)
        order = canonical_order(points[voxels.rows])
        rows = voxels.rows[order]
        places = torch.cat([order.argsort(), order.new_tensor([UNLABELED])])
        store.save("inverse", places[voxels.inverse])
    num_points, k = len(rows), max(min(config.normals.k, len(rows)), 1)
    bounds = [0, num_points]
    if isinstance(store, FolderStore):
        edge_bytes = 0 if is_order_free(config.growing) else 5 * k
        check_space(store.folder, num_points * (_ROW_BYTES + 4 * k + edge_bytes), "the work")
    store.save("rows", rows)
    store.save("cloud", points[rows])
    if isinstance(store, FolderStore):
        bounds = _choose_tiles(store, points[rows].numpy())
    store.note("order", num_points=num_points, k=k, bounds=bounds)


def _choose_tiles(store: FolderStore, points: NDArray[np.floating]) -> list[int]:
    """Find boxes about the points, and return where tiles end: where boxes do."""
    boxes = find_boxes(points)
    for name, values in boxes._asdict().items():
        store.save(f"boxes_{name}", values)
    wanted = np.arange(0, len(points), store.tile_size)
    ends = boxes.starts[np.searchsorted(boxes.starts, wanted)]
    # Tiles that are done stay, where the order alone is made again.
    found = np.unique(np.append(ends, len(points))).tolist()
    return list(store.known("order").get("bounds", found))


@dataclass(frozen=True)
class Stage:
    """A stage that runs block by block: the files it needs before, and its work on a block.

    Those that are there already, of a run that ended early, keep their rows.
    """

    begin: Callable[[FolderStore, PipelineConfig], None]
    work: Callable[[Store, slice, int, PipelineConfig], None]


@dataclass(frozen=True)
class TileTask:
    """One stage of one tile: all that a process on any machine that sees the folder needs."""

    folder: Path
    stage: str
    number: int
    config: PipelineConfig

    rows: tuple[int, int]

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
            BLOCK_STAGES[self.stage].work(store, slice(*self.rows), self.number, self.config)
        return store.written


def run_blocks(store: Store, name: str, config: PipelineConfig) -> None:
    """Run a stage on each block that it is not done on."""
    stage, bounds = BLOCK_STAGES[name], store.known("order")["bounds"]
    if isinstance(store, MemoryStore):
        stage.work(store, slice(*bounds), 0, config)
        return
    tiles = enumerate(itertools.pairwise(bounds))
    tasks = [TileTask(store.folder, name, number, config, rows) for number, rows in tiles]
    left = [task for task in tasks if not store.is_done(task.name)]
    store.on_progress(name, len(tasks) - len(left), len(tasks))
    if left or not tasks:
        stage.begin(store, config)
    for done, (task, written) in enumerate(store.run(left), len(tasks) - len(left) + 1):
        store.note(task.name, written)
        store.on_progress(name, done, len(tasks))


def run_once(store: Store, name: str, step: Callable[[], None]) -> None:
    """Run a stage on the whole cloud unless it is done."""
    if isinstance(store, FolderStore):
        store.on_progress(name, 0, 1)
        if store.is_done(name):
            return
        # Beside the arrays of the whole cloud, what tiles have freed would be too much.
        return_freed_memory()
    step()


def _begin_neighbors(store: FolderStore, config: PipelineConfig) -> None:
    order = store.known("order")
    store.create("neighbors", np.int32, (order["num_points"], order["k"]))


def _search(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    k = store.known("order")["k"]
    if isinstance(store, FolderStore):
        boxes = Boxes(*(store.get(f"boxes_{name}").numpy() for name in Boxes._fields))
        store.write("neighbors", block.start, search_tile(store.lazy("cloud"), boxes, block, k))
        return
    points = store.get("cloud")
    found = torch.empty(0, 1, dtype=torch.int32, device=points.device)
    if len(points):
        found = search_knn(points, k, canonical=True).indices
    store.write("neighbors", block.start, found)


def _around(store: Store, block: slice, steps: int) -> Part:
    """Return a block with all points that so many steps from neighbour to neighbour lead to."""
    if isinstance(store, FolderStore):
        return cut_part(store.lazy("neighbors"), block, steps)
    return Part(block, block, Neighbors(store.get("neighbors")))


def _begin_normals(store: FolderStore, config: PipelineConfig) -> None:
    num_points, kind = store.known("order")["num_points"], store.read("cloud").dtype
    for name, dtype in zip(_FIT, (kind, kind, np.bool_, kind, np.bool_), strict=True):
        store.create(name, dtype, (num_points, 3) if name == "normals" else (num_points,))


def _estimate(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    method = config.normals.method
    part = _around(store, block, STEPS[method])
    points = store.lazy("cloud")[part.rows]
    fit = ESTIMATORS[method](points, part.neighbors, config.normals, config.chunk_size)
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    for name, values in zip(_FIT, (*fit[:4], sharp), strict=True):
        store.write(name, block.start, values[part.own])


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


def _connect(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    part = _around(store, block, EDGE_STEPS)
    points, normals, curvature, valid, residual_rms = (
        store.lazy(name)[part.rows]
        for name in ("cloud", "normals", "curvature", "valid", "residual_rms")
    )
    cloud = checked_cloud(
        config.growing, points, normals, curvature, part.neighbors, valid, residual_rms
    )
    if cloud.reach is not None:
        store.write("reach", block.start, cloud.reach[part.own])
    found = find_growth_edges(
        cloud,
        config.growing,
        _order(store),
        chunk_size=config.chunk_size,
        whole=isinstance(store, MemoryStore),
    )
    if isinstance(store, MemoryStore):
        store.save("edges", found)
        return
    if found.claims is not None:
        store.write("claims", block.start, found.claims[part.own])
    if found.of_seeds is not None:
        condensed = condense(found.of_seeds, part)
        store.write("components", block.start, condensed.components)
        store.save(f"sources_{number}", condensed.sources)
        store.save(f"targets_{number}", condensed.targets)
    coded = _own_edges(found.coded, part)
    store.save(f"edges_{number}", coded.targets)
    store.write("counts", block.start, np.diff(coded.starts))


def _own_edges(edges: EdgeLists, part: Part) -> EdgeLists:
    """Return the coded edges of the points of the tile, with targets in the whole cloud."""
    starts = edges.starts[part.own.start : part.own.stop + 1]
    targets = edges.targets[starts[0] : starts[-1]]
    rows = part.numbers.astype(np.int32)
    return EdgeLists(starts - starts[0], rows[targets >> 1] * 2 + (targets & 1))


BLOCK_STAGES = {
    "neighbors": Stage(_begin_neighbors, _search),
    "normals": Stage(_begin_normals, _estimate),
    "edges": Stage(_begin_edges, _connect),
}
"""The stages that run block by block."""


def _growing_points(store: Store) -> Tensor:
    """Return which points may join a region."""
    finite = store.get("curvature").isfinite() & store.get("normals").isfinite().all(dim=1)
    return finite & store.get("valid")


def sort_by_curvature(store: Store, config: PipelineConfig) -> None:
    """Sort the points by curvature, and find its limit: of the whole cloud."""
    order = growth_order(store.get("curvature"), _growing_points(store), config.growing)
    store.save("seeds", order.rows)
    store.note("curvature", limit=float(order.limit), num_seeds=order.num_seeds)


def _order(store: Store) -> GrowthOrder:
    """Return in which order regions begin."""
    found, curvature = store.known("curvature"), store.lazy("curvature")
    limit = torch.tensor(found["limit"], dtype=curvature.dtype, device=curvature.device)
    return GrowthOrder(np.asarray(store.get("seeds")), found["num_seeds"], limit)


def grow_regions(store: Store, config: PipelineConfig) -> None:
    """Grow the regions of the whole cloud along the edges of its points."""
    order = _order(store)
    if isinstance(store, FolderStore):
        roots = _grow_on_disk(store, order, config)
    else:
        lists = store.get("neighbors").cpu().numpy()
        roots = grow_along(store.get("edges"), order, lists, config.growing)
    store.save("roots", torch.from_numpy(roots).to(store.lazy("curvature").device))
    store.remove("edges")
    store.note("growth")


def _grow_on_disk(
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


def finish_regions(store: Store, config: PipelineConfig) -> None:
    """Label the points of the regions that have grown."""
    cloud = GrowingCloud(
        by_column(store.get("cloud")),
        by_column(store.get("normals")),
        store.get("curvature"),
        Neighbors(store.lazy("neighbors")),
        _growing_points(store),
        reach=None if config.growing.plane_reach is None else store.get("reach"),
    )
    labels = label_regions(cloud, store.get("roots"), config.growing, config.chunk_size)
    store.save("labels", labels)
    store.note("regions")


def tabulate_planes(store: Store, config: PipelineConfig) -> None:
    """Write the table of planes."""
    planes = summarize_planes(
        store.get("cloud"),
        store.get("normals"),
        store.get("labels"),
        neighbors=Neighbors(store.lazy("neighbors")),
        up=config.planes.up,
        outline=config.planes.outline,
    )
    store.save_planes("planes", planes)
    store.note("planes")


def restore_results(store: Store, config: PipelineConfig, voxel: float | None) -> None:
    """Write what was found about each point in the order of the input; for voxels, of all points.

    The planes of voxels are described from all points then, and numbered by their number.
    """
    num_points, rows = len(store.lazy("points")), store.get("rows")
    for name in _RESULTS:
        values, fill = store.get(name), UNLABELED if name == "labels" else 0
        if voxel is None:
            values = restore_rows(values, rows, num_points, fill=fill)
        else:
            values = restore_points(values, store.get("inverse"), fill=fill)
        store.save(f"result_{name}", values)
    if voxel is not None:
        _describe_all_points(store, config)
    store.note("results")


def _describe_all_points(store: Store, config: PipelineConfig) -> None:
    """Number the planes of voxels by their numbers of points, and describe them from all these."""
    found = store.load_planes("planes")
    labels = store.get("result_labels")
    counts = torch.bincount(labels + 1, minlength=len(found.count) + 1)[1:]
    place = counts.argsort(descending=True, stable=True).argsort()
    labels = torch.cat([place, place.new_tensor([UNLABELED])])[labels]
    store.save("result_labels", labels)
    points = store.get("points")
    rows = finite_rows(points)
    planes = summarize_planes(
        *(values[rows] for values in (points, store.get("result_normals"), labels)),
        up=config.planes.up,
        outline=config.planes.outline,
    )
    adjacency = _renumbered(found.adjacency, place)
    store.save_planes("result_planes", planes._replace(adjacency=adjacency))


def _renumbered(adjacency: PlaneAdjacency | None, place: Tensor) -> PlaneAdjacency | None:
    """Return which planes meet after the planes were given other numbers."""
    if adjacency is None:
        return None
    pairs = place[adjacency.pairs].sort(dim=-1).values
    order = (pairs[:, 0] * len(place) + pairs[:, 1]).argsort()
    return PlaneAdjacency(*(part[order] for part in (pairs, *adjacency[1:])))


def load_results(store: Store, voxel: float | None) -> Segmentation:
    """Return what was found; from a folder maps of files, of which rows are read when used."""
    planes = store.load_planes("planes" if voxel is None else "result_planes")
    results = {name: store.map(f"result_{name}") for name in _RESULTS}
    return Segmentation(**results, planes=planes, points=store.map("points"))
