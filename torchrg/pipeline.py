"""From points to planes, and to superpoints: each in one function.

The steps of :func:`segment_planes` read arrays by name from a store and write their own. Some work
on a block of rows, with the points around it that decide what is found there: as many steps from
neighbour to neighbour away as is said beside the functions that they call. In memory the block is
the cloud; in a folder it is a tile.
"""

import dataclasses
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrg._checks import (
    as_tensor,
    check_chunks,
    check_floating,
    check_points,
    check_shapes,
    of_clouds,
)
from torchrg._compile import compiled, prepare
from torchrg._parallel import sequential_operations
from torchrg.config import (
    GrowingConfig,
    NormalsConfig,
    PipelineConfig,
    SuperpointsConfig,
    settings_of,
)
from torchrg.errors import ShapeError
from torchrg.neighbors import (
    canonical_order,
    finite_rows,
    restore_points,
    restore_rows,
    sample_voxels,
    search_knn,
)
from torchrg.neighbors.tiles import Part
from torchrg.normals import ESTIMATORS, STEPS
from torchrg.normals.consensus.constants import REGIONAL_STEPS
from torchrg.precision import warn_of_steps
from torchrg.regions import partition_points, summarize_planes
from torchrg.regions.edges import EDGE_STEPS, GrowingCloud
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
from torchrg.structures import (
    UNLABELED,
    Cloud,
    Neighbors,
    PlaneAdjacency,
    Segmentation,
    Superpoints,
)
from torchrg.tiles import FIT, TileStore, Work

BYTES_PER_POINT = 1_100
"""Memory that a point adds at the peak of :func:`segment_planes` with any preset, or a pixel at
that of :func:`torchrg.depth.segment_depth`, which takes half of it."""

_STRENGTH_OF_K = 200.0
"""Strength of superpoints for a threshold of 1 of ScanNet's Segmentator. At 0.01, which programs
ask for, they were 0.99 to 1.5 times as many as its own in three depth frames with noise, meshed,
and 1.5 to 2.5 times in exact ones, where there are 6 to 19."""
_RESULTS = ("labels", "normals", "curvature", "sharp", "valid")


class MemoryStore:
    """The arrays of one run in memory, as they were given: on any device, of any dtype."""

    def __init__(self) -> None:
        self._values: dict[str, Any] = {}

    def begin(self, **identity: Any) -> None:  # noqa: ANN401
        """Do nothing: the work of no other run can be there."""

    def once(self, step: str, work: Callable[[], None]) -> None:
        """Do a step on the whole cloud."""
        work()

    def note(self, step: str, **found: Any) -> None:  # noqa: ANN401
        """Keep what a step has found."""
        self._values[f"{step} found"] = found

    def known(self, step: str) -> dict[str, Any]:
        """Return what a step that is done found."""
        found: dict[str, Any] = self._values[f"{step} found"]
        return found

    def write(self, name: str, start: int, values: Any) -> None:  # noqa: ANN401
        """Keep the rows of an array, which are all."""
        self._values[name] = values

    def save(self, name: str, values: Any) -> None:  # noqa: ANN401
        """Keep a whole array."""
        self._values[name] = values

    def get(self, name: str) -> Any:  # noqa: ANN401
        """Return an array."""
        return self._values[name]

    # What a folder reads in parts, maps or decodes is here already.
    lazy = map = load_planes = get
    save_planes = save

    def save_points(self, points: Tensor | Iterable[Cloud]) -> None:
        """Keep points, those of chunks about the origin that the whole cloud has."""
        if not isinstance(points, Tensor):
            chunks = [chunk.coordinates for chunk in points] or [np.empty((0, 3), np.float32)]
            points = Cloud(np.concatenate(chunks)).points
        self._values["points"] = points

    def remove(self, *names: str) -> None:
        """Forget arrays that no other step reads."""
        for name in names:
            del self._values[name]

    # The cloud is one block, as it is one of many tiles of a folder.
    in_one_block = True

    def run_blocks(self, name: str, work: Work, config: PipelineConfig) -> None:
        """Run a step on the cloud."""
        work(self, slice(0, self.known("order")["num_points"]), 0, config)

    def choose_blocks(self, points: Tensor, k: int, config: PipelineConfig) -> list[int]:
        """Return where blocks end: the only one at the end of the cloud."""
        return [0, len(points)]

    def search_neighbors(self, block: slice, k: int) -> None:
        """Search the nearest neighbours of all points."""
        points = self.get("cloud")
        found = torch.empty(0, 1, dtype=torch.int32, device=points.device)
        if len(points):
            found = search_knn(points, k, canonical=True).indices
        self.save("neighbors", found)

    def widen_neighbors(self, config: PipelineConfig) -> None:
        """Do nothing: the estimator sees the whole cloud, and measures its noise itself."""

    def neighbors_for_normals(self, config: NormalsConfig) -> tuple[str, NormalsConfig]:
        """Return the array of the neighbours that normals are estimated from, and settings."""
        return "neighbors", config

    def around(self, block: slice, steps: int, lists: str = "neighbors") -> Part:
        """Return the cloud, around which there is nothing."""
        return Part(block, block, Neighbors(self.get(lists)))

    def keep_edges(self, found: GrowthEdges, part: Part, block: slice, number: int) -> None:
        """Keep the edges of all points."""
        self.save("edges", found)

    def grow(self, order: GrowthOrder, config: GrowingConfig) -> NDArray[np.int32]:
        """Grow along the edges of all points."""
        lists = self.get("neighbors").cpu().numpy()
        return grow_along(self.get("edges"), order, lists, config)


REHEARSED_POINTS, REHEARSED_NOISE = 4000, 0.003
"""Points of a room, and metres, that all kernels are needed for."""

Store = MemoryStore | TileStore
"""Where the arrays of a run are."""


@of_clouds
@sequential_operations()
def segment_planes(
    points: Tensor | NDArray[np.floating] | Iterable[Cloud],
    config: PipelineConfig | str | None = None,
    *,
    voxel: float | None = None,
    store: Store | None = None,
    on_stage: Callable[[str], None] | None = None,
    compile: bool | None = None,  # noqa: A002 - torch's word
) -> Segmentation:
    """Segment a cloud into planes: neighbours, normals, regions, plane table.

    A cloud that does not fit into memory is segmented tile by tile, with its arrays in files of a
    :class:`torchrg.tiles.TileStore`. Neighbours and edges, by far the most, stay on disk; the
    rest takes about 100 bytes of memory a point, and each tile 2 kB a point of its own. Called
    again with the same folder it goes on from the last tile that was done, however the last call
    ended, be it with the power: what the disk has lost is made again.

    Convention:
        The result does not depend on the order of the points, on chunk size, on the number of
        threads or on the size of tiles; only exact duplicates may swap. Lengths are in the unit of
        the cloud.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64. Clouds far from the origin should be
            float64, or moved to it first, as :func:`torchrg.read_cloud` does. Or a cloud in chunks,
            which stands for the ``Cloud.points`` of the whole, and is read only if the store does
            not have them.
        config: Settings, or the name of a preset. Default: that of :func:`torchrg.load_config`.
        voxel: Side of voxels, in the unit of the cloud: one point of each is segmented, and every
            point has the result of its voxel. Sizes of regions are counted in voxels then; planes
            are described from all points and numbered by their number, and which of them meet is
            found on the voxels. Default: all points are segmented.
        store: Where arrays are kept: a new :class:`MemoryStore` by default.
        on_stage: Called with the name of each stage when it starts, and with ``"done"``.
        compile: Whether to run kernels compiled; see :func:`prepare_kernels`. Default: what
            ``config`` says.

    Returns:
        Labels, normals, curvature and masks in the order of the points, and the table of planes. A
        point with NaN or Inf is not ``valid``: label :data:`torchrg.UNLABELED`, normal zero. A
        cloud with fewer points than ``k`` uses those it has; fewer than three points give no plane.
        From a folder the tensors are maps of files: slices of rows are read when they are used.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.
        ConfigError: If ``voxel`` is not positive.
        FormatError: If the folder holds the work of another run or something else, or the disk is
            full.

    Warns:
        PrecisionWarning: If the steps of float32 are more than a tenth of the spacing of the
            points, as they are far from the origin.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> seg = segment_planes(grid, "classic")
        >>> seg.planes.count.tolist(), seg.planes.normal.abs().tolist()
        ([400], [[0.0, 0.0, 1.0]])
        >>> segment_planes(grid, "classic", voxel=2.0).planes.count.tolist()
        [400]
        >>> import tempfile
        >>> from torchrg.tiles import TileStore
        >>> chunks = (Cloud(some.numpy()) for some in grid.split(150))
        >>> with tempfile.TemporaryDirectory() as work:
        ...     store = TileStore(work, tile_size=100)
        ...     segment_planes(chunks, "classic", store=store).planes.count.tolist()
        [400]
    """
    if isinstance(points, Tensor | np.ndarray):
        points = as_tensor("segment_planes", "points", points).detach()
        check_points("segment_planes", points)
        warn_of_steps("segment_planes", points, stacklevel=4)
    else:
        check_chunks("segment_planes", points)
    if not isinstance(config, PipelineConfig):
        config = settings_of("segment_planes", PipelineConfig, config)
    if compile is not None:
        config = dataclasses.replace(config, compile=compile)
    config = prepare_kernels(config, getattr(points, "dtype", torch.float32))
    with compiled() if config.compile else nullcontext():
        return _segment(points, config, voxel, MemoryStore() if store is None else store, on_stage)


def prepare_kernels(
    config: PipelineConfig,
    dtype: torch.dtype = torch.float32,
    announce: Callable[[str], None] = lambda text: None,
) -> PipelineConfig:
    """Compile the kernels that clouds of a dtype need, if the settings ask for it.

    That takes three minutes on two cores, and half a gigabyte of memory for each of up to four
    compilers, the first time on a machine. They are kept in the folder ``$TORCHRG_CACHE_DIR``, by
    default ``~/.cache/torchrg``, which machines of one kind may share, but no users: a folder that
    others own or can write to is not used. Results differ from those without them by rounding, and
    are the same for any order of the points, chunk size, number of threads and size of tiles.

    Args:
        config: Settings.
        dtype: That of the points.
        announce: Called with a line of text where there is something to compile.

    Returns:
        The settings, with ``compile`` False after a warning if there is no compiler.
    """
    if not config.compile:
        return config
    settings = dataclasses.replace(config, compile=False, chunk_size=PipelineConfig.chunk_size)

    def rehearse() -> None:
        from torchrg.scenes import make_room

        segment_planes(make_room(REHEARSED_POINTS, REHEARSED_NOISE).points.to(dtype), settings)

    is_ready = prepare(repr((settings, dtype)), rehearse, announce)
    return config if is_ready else dataclasses.replace(config, compile=False)


def _segment(
    points: Tensor | Iterable[Cloud],
    config: PipelineConfig,
    voxel: float | None,
    store: Store,
    on_stage: Callable[[str], None] | None,
) -> Segmentation:
    """Do what :func:`segment_planes` says: the steps, in their order."""
    begin = on_stage or (lambda stage: None)
    store.begin(config={**dataclasses.asdict(config), "chunk_size": None}, voxel=voxel)

    begin("neighbors")
    store.once("points", lambda: store.save_points(points))
    store.once("order", lambda: sort_points(store, config, voxel))
    store.run_blocks("neighbors", search_neighbors, config)

    begin("normals")
    store.widen_neighbors(config)
    store.run_blocks("normals", estimate_normals, config)

    begin("regions")
    store.once("curvature", lambda: sort_by_curvature(store, config))
    store.run_blocks("edges", find_edges, config)
    store.once("growth", lambda: grow_regions(store, config))
    store.once("regions", lambda: finish_regions(store, config))

    begin("planes")
    store.once("planes", lambda: tabulate_planes(store, config))
    store.once("results", lambda: restore_results(store, config, voxel))
    begin("done")
    return load_results(store, voxel)


@of_clouds
@sequential_operations()
def make_superpoints(
    points: Tensor | NDArray[np.floating],
    seg: Segmentation | None = None,
    config: SuperpointsConfig | None = None,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
    voxel: float | None = None,
) -> Superpoints:
    """Partition a cloud into superpoints: every finite point in exactly one, in nested levels.

    Superpoints are connected (of a chain of points between any two, each is one of the 8 nearest
    neighbours of the one before or after it), of one orientation, and keep to the borders of
    objects. Planes come first: their compact pieces, or whole planes, are regions from the start.
    Regions merge while that costs an energy like that of cut pursuit [1] at most the strength of
    the level; see :func:`torchrg.regions.superpoints.partition_points` for it and its sources.

    Convention:
        The result does not depend on the order of the points or on the number of threads. Exact
        duplicates are in one superpoint. Sizes are counted in distinct points. Neither a voxel grid
        nor weights by local density made partitions of clouds of varying density better, so each
        point counts once.

    Args:
        points: Points, shape ``(N, 3)``, float32 or float64.
        seg: What :func:`segment_planes` said about them. Default: it is asked, with the preset
            ``consensus``.
        config: Settings.
        colors: Colours, shape ``(N, 3)``, integers up to the largest of their type, or floating in
            [0, 1]. Default: they play no part.
        voxel: Side of voxels, in the unit of the cloud: the points that stand for voxels are
            partitioned, and every point is in the superpoint of its voxel. Sizes are counted in
            voxels then, and superpoints numbered by their number. Default: all points are.

    Returns:
        The partition of the first strength, and those of the others. A superpoint smaller than
        ``min_size`` has no neighbour to join, or only beyond ``max_extent``.

    Raises:
        ShapeError: If a shape or dtype is wrong, or ``seg`` is of another number of points.

    References:
        [1] L. Landrieu, G. Obozinski. Cut pursuit: fast algorithms to learn piecewise constant
        functions on general weighted graphs. SIAM J. Imaging Sciences, 2017.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> step = torch.stack([x, y, 10 * (x > 9)], dim=1)
        >>> found = make_superpoints(step)
        >>> found.labels.unique(return_counts=True)[1].tolist(), found.plane.tolist()
        ([200, 200], [0, 1])
    """
    tensor = as_tensor("make_superpoints", "points", points).detach()
    check_points("make_superpoints", tensor)
    shades = None if colors is None else as_tensor("make_superpoints", "colors", colors)
    check_shapes("make_superpoints", points=(tensor, "N 3"), colors=(shades, "N 3"))
    seg = segment_planes(tensor, voxel=voxel) if seg is None else seg
    if len(seg.labels) != len(tensor):
        raise ShapeError(
            f"make_superpoints: expected seg of {len(tensor):,} points, got {len(seg.labels):,}; "
            "pass the segmentation of these points."
        )
    config = SuperpointsConfig() if config is None else config
    if voxel is None:
        return partition_points(tensor, seg.normals, seg.labels, config, shades)
    rows, inverse = sample_voxels(tensor, voxel)
    shades = None if shades is None else shades[rows]
    found = partition_points(tensor[rows], seg.normals[rows], seg.labels[rows], config, shades)
    labels, *levels = (
        restore_points(level, inverse, fill=UNLABELED) for level in (found.labels, *found.levels)
    )
    return Superpoints(labels, found.plane, tuple(levels))


@of_clouds
def segment_mesh(
    vertices: Tensor | NDArray[np.floating],
    faces: Tensor | NDArray[np.integer] | None = None,
    k_thresh: float = 0.01,
    seg_min_verts: int = 20,
    *,
    colors: Tensor | NDArray[np.generic] | None = None,
    config: PipelineConfig | str = "scannet",
) -> Tensor:
    """Return superpoints of the vertices of a mesh, in the shape of ScanNet's Segmentator.

    Programs that call ``segmentator.segment_mesh(vertices, faces)`` change their import to ``import
    torchrg as segmentator``, and have those of :func:`make_superpoints` then.

    Args:
        vertices: Shape ``(V, 3)``, floating.
        faces: Rows of the corners of triangles, shape ``(F, 3)``. Superpoints are connected along
            their edges. Default: along neighbours, for points without a mesh.
        k_thresh: As of Segmentator, in proportion: 0.01 is a strength of 2 in
            :class:`torchrg.config.SuperpointsConfig`, with which superpoints of depth frames with
            noise were as many as Segmentator's.
        seg_min_verts: Smaller superpoints join a neighbour, in vertices.
        colors: As of :func:`make_superpoints`; Segmentator knows none.
        config: How planes are found, settings or the name of a preset.

    Returns:
        Superpoint of each vertex, shape ``(V,)``, int64, consecutive from 0 on by descending size;
        -1 for vertices that are not finite.

    Raises:
        ShapeError: If a shape or dtype is wrong, or a face has a corner that is no vertex.

    Example:
        >>> x, y = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0)).unbind(1)
        >>> fold = torch.stack([x, y, 2 * (x - 9.5).clamp(min=0)], dim=1)
        >>> first = torch.tensor([row for row in range(380) if row % 20 < 19])[:, None]
        >>> faces = torch.cat([first + torch.tensor([0, 1, 20]), first + torch.tensor([1, 21, 20])])
        >>> segment_mesh(fold, faces).unique(return_counts=True)[1].tolist()
        [200, 200]
    """
    tensor = as_tensor("segment_mesh", "vertices", vertices).detach()
    check_shapes("segment_mesh", vertices=(tensor, "V 3"))
    check_floating("segment_mesh", vertices=tensor)
    corners = None if faces is None else as_tensor("segment_mesh", "faces", faces)
    check_shapes("segment_mesh", faces=(corners, "F 3"))
    if corners is not None and len(corners):
        low, high = int(corners.min()), int(corners.max())
        if not 0 <= low <= high < len(tensor):
            raise ShapeError(
                f"segment_mesh: expected faces of rows of {len(tensor):,} vertices, got {low:,} to "
                f"{high:,}; number them from 0."
            )
    shades = None if colors is None else as_tensor("segment_mesh", "colors", colors)
    check_shapes("segment_mesh", vertices=(tensor, "V 3"), colors=(shades, "V 3"))
    seg = segment_planes(tensor, config)
    parts = SuperpointsConfig(strengths=(_STRENGTH_OF_K * k_thresh,), min_size=seg_min_verts)
    return partition_points(tensor, seg.normals, seg.labels, parts, shades, corners).labels


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
    bounds = store.choose_blocks(points[rows], k, config)
    store.save("rows", rows)
    store.save("cloud", points[rows])
    store.note("order", num_points=num_points, k=k, bounds=bounds)


def search_neighbors(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    """Search the nearest neighbours of the points of a block."""
    store.search_neighbors(block, store.known("order")["k"])


def estimate_normals(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    """Estimate normals and curvature of the points of a block."""
    lists, settings = store.neighbors_for_normals(config.normals)
    steps = STEPS[settings.method] + REGIONAL_STEPS * (settings.noise_scope == "regional")
    part = store.around(block, steps, lists)
    points = store.lazy("cloud")[part.rows]
    fit = ESTIMATORS[settings.method](points, part.neighbors, settings, config.chunk_size)
    sharp = torch.zeros_like(fit.valid) if fit.sharp is None else fit.sharp
    for name, values in zip(FIT, (*fit[:4], sharp), strict=True):
        store.write(name, block.start, values[part.own])


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


def find_edges(store: Store, block: slice, number: int, config: PipelineConfig) -> None:
    """Find the edges that regions grow along from the points of a block."""
    part = store.around(block, EDGE_STEPS)
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
        whole=store.in_one_block,
    )
    store.keep_edges(found, part, block, number)


def grow_regions(store: Store, config: PipelineConfig) -> None:
    """Grow the regions of the whole cloud along the edges of its points."""
    order = _order(store)
    roots = store.grow(order, config.growing)
    store.save("roots", torch.from_numpy(roots).to(store.lazy("curvature").device))
    store.remove("edges")
    store.note("growth")


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
