"""From points to planes, and to superpoints: each in one function."""

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchrg import stages
from torchrg._checks import as_tensor, check_floating, check_shapes
from torchrg._parallel import sequential_operations
from torchrg.config import PipelineConfig, SuperpointsConfig, load_config
from torchrg.errors import ShapeError
from torchrg.neighbors import restore_points, sample_voxels
from torchrg.regions import partition_points
from torchrg.stages import Store
from torchrg.store import MemoryStore
from torchrg.structures import UNLABELED, Cloud, Segmentation, Superpoints

BYTES_PER_POINT = 1_100
"""Memory that a point adds at the peak of :func:`segment_planes` with any preset, or a pixel at
that of :func:`torchrg.depth.segment_depth`, which takes half of it."""


@sequential_operations()
def segment_planes(
    points: Tensor | NDArray[np.floating] | Iterable[Cloud],
    config: PipelineConfig | None = None,
    *,
    voxel: float | None = None,
    store: Store | None = None,
    on_stage: Callable[[str], None] | None = None,
) -> Segmentation:
    """Segment a cloud into planes: neighbours, normals, regions, plane table.

    A cloud that does not fit into memory is segmented tile by tile, with its arrays in files of a
    :class:`torchrg.store.FolderStore`. Neighbours and edges, by far the most, stay on disk; the
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
        config: Settings. Default: the preset ``consensus``.
        voxel: Side of voxels, in the unit of the cloud: one point of each is segmented, and every
            point has the result of its voxel. Sizes of regions are counted in voxels then; planes
            are described from all points and numbered by their number, and which of them meet is
            found on the voxels. Default: all points are segmented.
        store: Where arrays are kept: a new :class:`torchrg.store.MemoryStore` by default.
        on_stage: Called with the name of each stage when it starts, and with ``"done"``.

    Returns:
        Labels, normals, curvature and masks in the order of the points, and the table of planes. A
        point with NaN or Inf is not ``valid``: label :data:`torchrg.UNLABELED`, normal zero. A
        cloud with fewer points than ``k`` uses those it has; fewer than three points give no plane.
        From a folder the tensors are maps of files: slices of rows are read when they are used.

    Raises:
        ShapeError: If ``points`` has another shape or dtype.
        ConfigError: If ``voxel`` is not positive, or the settings ask for ``adaptive_k``, which
            looks at the whole cloud, in tiles.
        FormatError: If the folder holds the work of another run or something else, or the disk is
            full.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1))
        >>> seg = segment_planes(grid, load_config("classic"))
        >>> seg.planes.count.tolist(), seg.planes.normal.abs().tolist()
        ([400], [[0.0, 0.0, 1.0]])
        >>> segment_planes(grid, load_config("classic"), voxel=2.0).planes.count.tolist()
        [400]
        >>> import tempfile
        >>> from torchrg.store import FolderStore
        >>> chunks = (Cloud(some.numpy()) for some in grid.split(150))
        >>> with tempfile.TemporaryDirectory() as work:
        ...     store = FolderStore(work, tile_size=100)
        ...     segment_planes(chunks, load_config("classic"), store=store).planes.count.tolist()
        [400]
    """
    if isinstance(points, Tensor | np.ndarray):
        points = as_tensor("segment_planes", "points", points)
        check_shapes("segment_planes", points=(points, "N 3"))
        check_floating("segment_planes", points=points)
    config = load_config() if config is None else config
    store = MemoryStore() if store is None else store
    begin = on_stage or (lambda stage: None)
    stages.begin(store, config, voxel)

    def whole(step: str, work: Callable[[], None]) -> None:
        stages.run_once(store, step, work)

    def in_blocks(step: str) -> None:
        stages.run_blocks(store, step, config)

    begin("neighbors")
    whole("points", lambda: store.save_points(points))
    whole("order", lambda: stages.sort_points(store, config, voxel))
    in_blocks("neighbors")

    begin("normals")
    in_blocks("normals")

    begin("regions")
    whole("curvature", lambda: stages.sort_by_curvature(store, config))
    in_blocks("edges")
    whole("growth", lambda: stages.grow_regions(store, config))
    whole("regions", lambda: stages.finish_regions(store, config))

    begin("planes")
    whole("planes", lambda: stages.tabulate_planes(store, config))
    whole("results", lambda: stages.restore_results(store, config, voxel))
    begin("done")
    return stages.load_results(store, voxel)


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
    tensor = as_tensor("make_superpoints", "points", points)
    check_shapes("make_superpoints", points=(tensor, "N 3"))
    check_floating("make_superpoints", points=tensor)
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
