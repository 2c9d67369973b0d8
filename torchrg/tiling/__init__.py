"""Clouds larger than memory: the stages of the pipeline, tile by tile, with arrays on disk.

A tile is a range of rows in canonical order. What a stage finds at a point depends on points few
steps from neighbour to neighbour away; with these around it, a tile gives what the whole cloud
would, to the last bit. What looks at the whole cloud (the limit of curvature, who reaches whom, the
planes of regions) runs on arrays of a few bytes a point, while neighbours stay on disk.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrg._parallel import return_freed_memory, sequential_operations
from torchrg.config import PipelineConfig, load_config
from torchrg.errors import ConfigError
from torchrg.structures import Cloud, Segmentation
from torchrg.tiling.files import TileFiles, Written, make_folder
from torchrg.tiling.stages import (
    TILE_STAGES,
    TileTask,
    finish_regions,
    grow_regions,
    load_planes,
    read_points,
    restore_results,
    sort_points,
    tabulate_planes,
)

__all__ = [
    "STAGES",
    "TILE_SIZE",
    "Done",
    "TileFiles",
    "TileTask",
    "Written",
    "make_folder",
    "run_in_turn",
    "segment_tiles",
]

STAGES = ("points", "order", *TILE_STAGES, "growth", "regions", "planes", "results")
"""Names of the stages in their order."""

TILE_SIZE = 300_000
"""Points of a tile unless the caller says. With 150,000 ``classic`` takes 0.05 less time and
``consensus``, which looks farther, 0.15 more; larger ones leave the cache of freed memory."""

Done = tuple[TileTask, Sequence[Written]]
"""A task that is done, and what it has written."""
Engine = Callable[[Sequence[TileTask]], Iterable[Done]]
"""Runs tasks, in any order and anywhere, and yields each when it is done."""


def run_in_turn(tasks: Sequence[TileTask]) -> Iterator[Done]:
    """Run tasks one after the other, each on as many threads as torch may use."""
    for task in tasks:
        yield task, task.run()


@sequential_operations()
def segment_tiles(
    chunks: Iterable[Cloud],
    folder: str | Path,
    config: PipelineConfig | None = None,
    *,
    tile_size: int = TILE_SIZE,
    identity: Mapping[str, Any] | None = None,
    run: Engine = run_in_turn,
    on_stage: Callable[[str, int, int], None] | None = None,
) -> Segmentation:
    """Segment a cloud that does not fit into memory, with its arrays in files.

    The result is that of :func:`torchrg.segment_planes` for ``Cloud.points`` of the whole cloud, to
    the last bit, whatever the size of the tiles. Neighbours and edges, by far the most, stay on
    disk; the rest takes about 100 bytes of memory a point, and each tile 2 kB a point of its own.

    Called again with the same folder it goes on from the last tile that was done, however the last
    call ended, be it with the power: what the disk has lost is made again. A folder with all done
    gives the result as soon as it is read.

    Args:
        chunks: The cloud, in chunks; read only as long as its points are not all in the folder.
        folder: Where the arrays go, about 500 bytes a point, ten neighbours less or more 40; made
            if it does not exist, else empty but for hidden files. The result lies there:
            :meth:`TileFiles.remove_all` removes what this function has made, and nothing else.
        config: Settings. Default: the preset ``consensus``.
        tile_size: Points of a tile.
        identity: What else decides the result, ready for JSON: of which files the chunks are.
        run: Runs the tasks of a stage, in other processes perhaps.
        on_stage: Called with the name of each stage, how many of its tiles are done, and of how
            many; with 0 and 1 for stages of the whole cloud.

    Returns:
        The segmentation, in the order of the chunks. Its tensors are maps of files: slices of rows
        are read when they are used.

    Raises:
        ConfigError: If the settings ask for ``adaptive_k``, which looks at the whole cloud.
        FormatError: If the folder holds the work of another run or something else, or the disk is
            full.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> grid = np.stack(np.mgrid[:20, :20, :1], axis=-1).reshape(-1, 3).astype(np.float32)
        >>> chunks = (Cloud(some) for some in np.array_split(grid, 3))
        >>> with tempfile.TemporaryDirectory() as work:
        ...     seg = segment_tiles(chunks, work, load_config("classic"), tile_size=100)
        ...     seg.planes.count.tolist(), seg.labels[:3].tolist()
        ([400], [0, 0, 0])
    """
    config = load_config() if config is None else config
    if config.normals.adaptive_k is not None:
        raise ConfigError(
            "segment_tiles: expected normals.adaptive_k of none, got "
            f"{config.normals.adaptive_k}; choose k, or give the cloud memory."
        )
    if tile_size < 1:
        raise ConfigError(f"segment_tiles: expected tile_size >= 1, got {tile_size}.")
    files = TileFiles(Path(folder), {"config": _describe(config), **(identity or {})})
    begin = on_stage or (lambda stage, done, number: None)

    def once(stage: str, step: Callable[[], None]) -> None:
        begin(stage, 0, 1)
        if not files.is_done(stage):
            # Beside the arrays of the whole cloud, what tiles have freed would be too much.
            return_freed_memory()
            step()

    once("points", lambda: read_points(files, chunks))
    once("order", lambda: sort_points(files, config, tile_size))
    tiles = list(itertools.pairwise(files.known("order")["bounds"]))
    for stage, work in TILE_STAGES.items():
        tasks = [
            TileTask(files.folder, stage, number, config, rows) for number, rows in enumerate(tiles)
        ]
        left = [task for task in tasks if not files.is_done(task.name)]
        begin(stage, len(tiles) - len(left), len(tiles))
        if left or not tiles:
            work.begin(files, config)
        for done, (task, written) in enumerate(run(left), len(tiles) - len(left) + 1):
            files.note(task.name, written)
            begin(stage, done, len(tiles))
    once("growth", lambda: grow_regions(files, config))
    once("regions", lambda: finish_regions(files, config))
    once("planes", lambda: tabulate_planes(files, config))
    once("results", lambda: restore_results(files))
    labels, normals, curvature, sharp, valid = (
        files.map(f"result_{name}") for name in ("labels", "normals", "curvature", "sharp", "valid")
    )
    points = files.map("points")
    return Segmentation(labels, normals, curvature, sharp, valid, load_planes(files), points)


def _describe(config: PipelineConfig) -> dict[str, Any]:
    """Return the settings that decide the result."""
    settings = dataclasses.asdict(config)
    del settings["chunk_size"]
    return settings
