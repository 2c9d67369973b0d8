"""The stages of the pipeline for clouds on disk: those of one tile, and those of the whole cloud.

Each reads the arrays of the stage before it and writes its own. A tile is worked on by functions
that serve clouds in memory too, on the tile with the points around it that these look at.
"""

import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._parallel import sequential_operations
from torchrg.config import PipelineConfig
from torchrg.errors import FormatError
from torchrg.neighbors import finite_rows, restore_rows
from torchrg.normals import ESTIMATORS, STEPS
from torchrg.regions import summarize_planes
from torchrg.regions.edges import EdgeLists, GrowingCloud, find_coded_edges, find_edges
from torchrg.regions.growth import (
    checked_cloud,
    grow_first_in_first_out,
    grow_rest,
    growing_order,
    leaves_enough,
    settle_regions,
    spreading,
)
from torchrg.structures import (
    UNLABELED,
    Cloud,
    Neighbors,
    PlaneAdjacency,
    Planes,
    origin_of_box,
)
from torchrg.tiling.boxes import Boxes, find_boxes
from torchrg.tiling.files import TileFiles, Written, reading, released
from torchrg.tiling.growth import Condensed, condense, join_condensed
from torchrg.tiling.neighbors import search_tile
from torchrg.tiling.parts import Part, cut_part

_GROWTH_STEPS = 2
"""Steps from neighbour to neighbour that decide an edge: the neighbours of both of its ends."""

_ROW_BYTES = 150
"""Of a point on disk beside its neighbours and edges: coordinates, normals, results."""

_FIT = ("normals", "curvature", "valid", "residual_rms", "sharp")
_RAW = "coordinates.raw"
_PLANES = "planes.pt"
_RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


def read_points(files: TileFiles, chunks: Iterable[Cloud]) -> None:
    """Write the points of a cloud that comes in chunks, about the origin that a whole one has."""
    low, high, num_points, narrow = np.full(3, np.inf), np.full(3, -np.inf), 0, True
    files.reserve(_RAW)
    with files.opened(_RAW) as stream:
        stream.truncate(0)
        for chunk in chunks:
            coordinates = chunk.coordinates
            num_points += len(coordinates)
            narrow &= coordinates.dtype == np.float32
            stream.write(coordinates.astype(np.float64).tobytes())
            if chunk.finite.any():
                kept = coordinates[chunk.finite]
                low, high = np.minimum(low, kept.min(axis=0)), np.maximum(high, kept.max(axis=0))
    origin = origin_of_box(low, high)
    found = {"num_points": num_points, "origin": origin.tolist()}
    if files.facts("points") not in (None, found):
        raise FormatError(
            f"{files.path('points')}: is damaged, and the points that are given now are others; "
            f"give the same again, or remove {files.folder}."
        )
    files.create("points", np.float32, (num_points, 3))
    dtype = np.float32 if narrow else np.float64
    step = 2**20
    for start in range(0, num_points, step):
        count = min(step, num_points - start) * 3
        some = np.fromfile(files.folder / _RAW, np.float64, count, offset=start * 24)
        files.write("points", start, Cloud(some.reshape(-1, 3).astype(dtype)).about(origin))
    files.remove(_RAW)
    files.note("points", **found)


def sort_points(files: TileFiles, config: PipelineConfig, tile_size: int) -> None:
    """Sort the finite points, and choose the tiles: they end where boxes do."""
    points = files.load("points")
    rows = finite_rows(points)
    points = points[rows]
    k = max(min(config.normals.k, len(rows)), 1)
    edge_bytes = 0 if config.growing.is_order_free else 5 * k
    files.check_space(len(rows) * (_ROW_BYTES + 4 * k + edge_bytes))
    files.save("rows", rows)
    files.save("cloud", points)
    boxes = find_boxes(points.numpy())
    for name, values in boxes._asdict().items():
        files.save(f"boxes_{name}", values)
    wanted = np.arange(0, len(rows), max(tile_size, 1))
    ends = boxes.starts[np.searchsorted(boxes.starts, wanted)]
    bounds = np.unique(np.append(ends, len(rows))).tolist()
    # Tiles that are done stay, where the order alone is made again.
    earlier = files.facts("order") or {"bounds": bounds}
    files.note("order", num_points=len(rows), k=k, bounds=earlier["bounds"])


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
        files = TileFiles(self.folder)
        with sequential_operations(), torch.no_grad():
            TILE_STAGES[self.stage].work(files, slice(*self.rows), self.number, self.config)
        return files.written


@dataclass(frozen=True)
class TileStage:
    """A stage that runs tile by tile: the arrays it needs before, and its work on a tile.

    Arrays that are there already, of a run that ended early, keep their rows.
    """

    begin: Callable[[TileFiles, PipelineConfig], None]
    work: Callable[[TileFiles, slice, int, PipelineConfig], None]


def _begin_neighbors(files: TileFiles, config: PipelineConfig) -> None:
    order = files.known("order")
    files.create("neighbors", np.int32, (order["num_points"], order["k"]))


def _search(files: TileFiles, tile: slice, number: int, config: PipelineConfig) -> None:
    boxes = Boxes(*(files.load(f"boxes_{name}").numpy() for name in Boxes._fields))
    points = files.map("cloud").numpy()
    found = search_tile(points, boxes, tile, files.known("order")["k"])
    files.write("neighbors", tile.start, found)


def _begin_normals(files: TileFiles, config: PipelineConfig) -> None:
    num_points = files.known("order")["num_points"]
    dtypes = (np.float32, np.float32, np.bool_, np.float32, np.bool_)
    for name, dtype in zip(_FIT, dtypes, strict=True):
        files.create(name, dtype, (num_points, 3) if name == "normals" else (num_points,))


def _estimate(files: TileFiles, tile: slice, number: int, config: PipelineConfig) -> None:
    method = config.normals.method
    part = cut_part(files.map("neighbors"), tile, STEPS[method])
    points = files.map("cloud")[part.rows]
    fit = ESTIMATORS[method](points, part.neighbors, config.normals, config.chunk_size)
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    for name, values in zip(_FIT, (*fit[:4], sharp), strict=True):
        files.write(name, tile.start, values[part.own])


def _begin_edges(files: TileFiles, config: PipelineConfig) -> None:
    num_points, bounds = (files.known("order")[name] for name in ("num_points", "bounds"))
    lists = ("edges", "sources", "targets") if config.growing.is_order_free else ("edges",)
    tiles = range(len(bounds) - 1)
    files.reserve(*(files.path(f"{name}_{number}").name for name in lists for number in tiles))
    files.create("counts", np.int32, (num_points,))
    files.create("components", np.int32, (num_points,))
    files.create("reach", np.float32, (num_points,))
    if config.growing.promotes_late:
        files.create("claims", np.bool_, (num_points, files.known("order")["k"]))
    _, limit = _growing_order(files, config)
    files.note("limit", value=float(limit))


def _growing_order(files: TileFiles, config: PipelineConfig) -> tuple[NDArray[np.int32], Tensor]:
    """Return the points that may join a region by ascending curvature, and its limit."""
    return growing_order(files.load("curvature"), _growing_points(files), config.growing)


def _growing_points(files: TileFiles) -> Tensor:
    """Return which points may join a region."""
    finite = files.load("curvature").isfinite() & files.map("normals").isfinite().all(dim=1)
    return finite & files.load("valid")


def _connect(files: TileFiles, tile: slice, number: int, config: PipelineConfig) -> None:
    part = cut_part(files.map("neighbors"), tile, _GROWTH_STEPS)
    points, normals, curvature, valid, residual_rms = (
        files.map(name)[part.rows]
        for name in ("cloud", "normals", "curvature", "valid", "residual_rms")
    )
    cloud = checked_cloud(
        config.growing, points, normals, curvature, part.neighbors, valid, None, residual_rms
    )
    if cloud.reach is not None:
        files.write("reach", tile.start, cloud.reach[part.own])
    limit = torch.tensor(files.known("limit")["value"], dtype=cloud.curvature.dtype)
    if not config.growing.is_order_free:
        coded, claims = find_coded_edges(cloud, config.growing, limit, chunk_size=config.chunk_size)
        if claims is not None:
            files.write("claims", tile.start, claims[part.own])
        edges = _own_edges(coded, part)
        files.save(f"edges_{number}", edges.targets)
        files.write("counts", tile.start, np.diff(edges.starts))
        return
    found, others = find_edges(cloud, config.growing, limit, spare=0, chunk_size=config.chunk_size)
    condensed = condense(found, part)
    files.write("components", tile.start, condensed.components)
    files.save(f"sources_{number}", condensed.sources)
    files.save(f"targets_{number}", condensed.targets)
    others = _own_edges(others, part)
    files.save(f"edges_{number}", others.targets)
    files.write("counts", tile.start, np.diff(others.starts))


def _own_edges(edges: EdgeLists, part: Part) -> EdgeLists:
    """Return the coded edges of the points of the tile, with targets in the whole cloud."""
    starts = edges.starts[part.own.start : part.own.stop + 1]
    targets = edges.targets[starts[0] : starts[-1]]
    rows = part.rows.numpy().astype(np.int32)
    return EdgeLists(starts - starts[0], rows[targets >> 1] * 2 + (targets & 1))


TILE_STAGES = {
    "neighbors": TileStage(_begin_neighbors, _search),
    "normals": TileStage(_begin_normals, _estimate),
    "edges": TileStage(_begin_edges, _connect),
}
"""The stages that run tile by tile, in their order."""


def grow_regions(files: TileFiles, config: PipelineConfig) -> None:
    """Grow the regions of the whole cloud along the edges of its tiles."""
    grow = _grow_in_any_order if config.growing.is_order_free else _grow
    files.save("heads", grow(files, config))
    files.remove(files.path("edges").name)
    files.note("growth")


def finish_regions(files: TileFiles, config: PipelineConfig) -> None:
    """Label the points of the regions that have grown."""
    with released(files.path("neighbors")) as indices:
        cloud = GrowingCloud(
            files.load("cloud"),
            files.load("normals"),
            files.load("curvature"),
            Neighbors(indices),
            _growing_points(files),
            reach=None if config.growing.plane_reach is None else files.load("reach"),
        )
        labels = settle_regions(cloud, files.load("heads"), config.growing, config.chunk_size)
    files.save("labels", labels)
    files.note("regions")


def _grow(files: TileFiles, config: PipelineConfig) -> NDArray[np.int32]:
    """Grow regions one after the other along the edges on disk."""
    order, _ = _growing_order(files, config)
    valid = np.zeros(files.known("order")["num_points"], dtype=bool)
    valid[order] = True
    starts = _join_edges(files)
    with released(files.path("edges")) as targets:
        edges = EdgeLists(starts, targets.numpy())
        if not config.growing.promotes_late:
            return grow_first_in_first_out(edges, order, valid)
        with (
            released(files.path("claims")) as claims,
            released(files.path("neighbors")) as neighbors,
        ):
            return grow_first_in_first_out(edges, order, valid, claims.numpy(), neighbors.numpy())


def _grow_in_any_order(files: TileFiles, config: PipelineConfig) -> NDArray[np.int32]:
    """Give each point to the first seed that reaches it, and let others claim what is left."""
    order, limit = _growing_order(files, config)
    bounds = files.known("order")["bounds"]
    components = files.load("components").numpy()
    parts = [
        Condensed(
            components[bounds[number] : bounds[number + 1]],
            files.load(f"sources_{number}").numpy(),
            files.load(f"targets_{number}").numpy(),
        )
        for number in range(len(bounds) - 1)
    ]
    heads = join_condensed(parts, spreading(order, files.load("curvature"), limit))
    if leaves_enough(files.known("order")["k"], config.growing):
        starts = _join_edges(files)
        heads = grow_rest(heads, EdgeLists(starts, files.load("edges").numpy()), order)
    return heads


def _join_edges(files: TileFiles) -> NDArray[np.int64]:
    """Put the edges of all tiles into one file; return where those of each point start."""
    counts = files.load("counts").numpy()
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=starts[1:])
    bounds = files.known("order")["bounds"]
    files.create("edges", np.int32, (int(starts[-1]),))
    for number, start in enumerate(bounds[:-1]):
        files.write("edges", int(starts[start]), files.load(f"edges_{number}"))
    return starts


def tabulate_planes(files: TileFiles, config: PipelineConfig) -> None:
    """Write the table of planes."""
    with released(files.path("neighbors")) as indices:
        planes = summarize_planes(
            files.load("cloud"),
            files.load("normals"),
            files.load("labels"),
            neighbors=Neighbors(indices),
            up=config.planes.up_direction,
            outline=config.planes.outline,
        )
    adjacency = None if planes.adjacency is None else tuple(planes.adjacency)
    content = io.BytesIO()
    torch.save({**planes._asdict(), "adjacency": adjacency}, content)
    files.save_bytes(_PLANES, content.getvalue())
    files.note("planes")


def load_planes(files: TileFiles) -> Planes:
    """Return the table of planes."""
    path = files.folder / _PLANES
    with reading(path):
        values = torch.load(path, weights_only=True)
    adjacency = values.pop("adjacency")
    return Planes(**values, adjacency=None if adjacency is None else PlaneAdjacency(*adjacency))


def restore_results(files: TileFiles) -> None:
    """Write what was found about each point in the order of the input."""
    num_points, rows = files.known("points")["num_points"], files.load("rows")
    for name in _RESULTS:
        fill = UNLABELED if name == "labels" else 0
        files.save(f"result_{name}", restore_rows(files.load(name), rows, num_points, fill=fill))
    files.note("results")
