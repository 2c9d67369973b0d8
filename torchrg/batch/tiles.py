"""A cloud in tiles, as a command does it: within a limit of memory, alone in its directory."""

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch

from torchrg.batch.local import run_local
from torchrg.batch.lock import DirectoryLock
from torchrg.batch.memory import PROCESS_BYTES, memory_between_tiles, memory_of_tile
from torchrg.batch.records import describe_versions, hash_file
from torchrg.batch.task import Converted, Reports, Task, TaskReport, report_on
from torchrg.config import PipelineConfig
from torchrg.errors import ConfigError, FormatError
from torchrg.io.files import marked_parts, remove_leftovers
from torchrg.pipeline import segment_planes
from torchrg.store import TILE_SIZE, Written, make_folder, run_in_turn
from torchrg.structures import Cloud, Segmentation
from torchrg.tiles import BYTES_PER_TILE_POINT, TileStore, TileTask

_SMALLEST_TILE = 20_000
"""Least number of points of a tile. With fewer, most of the work is on the points around it."""
_LEAST_POINTS_A_WORKER = 2_000_000
"""Points of the whole cloud for each process. One takes two seconds to load torch in each stage,
which is as long as so many points take at a microsecond each."""


def choose_tile_size(num_points: int, memory_limit: int) -> int:
    """Return how many points a tile may have for a cloud to stay within a limit of memory, bytes.

    Raises:
        ConfigError: If the steps that look at the whole cloud take more than the limit.

    Example:
        >>> choose_tile_size(100_000, 800_000_000)
        150000
    """
    needed = max(memory_between_tiles(num_points), memory_of_tile(_SMALLEST_TILE))
    if needed > memory_limit:
        raise ConfigError(
            f"expected --limit-memory of at least {needed / 1e9:.2f} GB for about {num_points:,} "
            f"points, got {memory_limit / 1e9:.2f} GB; raise it, or split the cloud."
        )
    return min((memory_limit - PROCESS_BYTES) // BYTES_PER_TILE_POINT, TILE_SIZE)


def choose_workers(num_points: int, tile_size: int, memory_limit: int) -> int:
    """Return how many processes may work on tiles within a limit of memory, bytes, beside this one.

    With one, this process does the work itself, on its threads.

    Example:
        >>> choose_workers(50_000, 20_000, 2**40)
        1
    """
    room = (memory_limit - PROCESS_BYTES) // memory_of_tile(tile_size)
    return max(min(torch.get_num_threads(), room, num_points // _LEAST_POINTS_A_WORKER), 1)


def folder_of_work(target: Path, workdir: Path | None = None) -> Path:
    """Return the folder for the work on one result: in a directory for such folders, or beside it.

    It is the same for every command with this result, and no command with another one has it.

    Example:
        >>> folder_of_work(Path("out/room.npz")).as_posix()
        'out/.room.npz.tiles'
        >>> folder_of_work(Path("/out/room.npz"), Path("scratch")).as_posix()
        'scratch/room.npz.16b363c9.tiles'
    """
    if workdir is None:
        return target.with_name(f".{target.name}.tiles")
    place = hashlib.sha256(os.fsencode(os.path.realpath(target))).hexdigest()
    return workdir / f"{target.name}.{place[:8]}.tiles"


@contextlib.contextmanager
def segmented_in_tiles(
    sources: Sequence[Path],
    chunks: Iterable[Cloud],
    folder: Path,
    settings: PipelineConfig,
    *,
    tile_size: int,
    target: Path | None = None,
    workers: int = 1,
    start: Callable[[Sequence[Task]], Reports] | None = None,
    on_stage: Callable[[str, int, int], None] | None = None,
    columns: str | None = None,
    voxel: float | None = None,
) -> Iterator[Segmentation]:
    """Segment files as one cloud, and remove the work when the result is used.

    Where the work or what is done with the result ends early, it stays, and the same call goes on
    from there.

    Args:
        sources: The files.
        chunks: Their points.
        folder: Folder for this work alone; see :class:`torchrg.store.FolderStore`. Another process
            that works there is refused.
        settings: Settings of the pipeline.
        tile_size: Points of a tile.
        target: The file that the caller writes the result to. What an earlier call was writing when
            it was killed is removed.
        workers: Processes of one thread that work on tiles side by side, as many as there is memory
            for; with one, this process works on tile after tile, on its threads.
        start: Starts another engine on the tasks of a stage.
        on_stage: See :class:`torchrg.store.FolderStore`.
        columns: Names that were given for the columns of the files.
        voxel: See :func:`torchrg.segment_planes`.

    Yields:
        The segmentation.

    Raises:
        ConfigError: If the folder holds one of the files.
        FormatError: If the folder holds something else, another process works there, or a tile
            failed.
    """
    _check_outside(folder, sources if target is None else [*sources, target])
    inputs = [{"name": path.name, "sha256": hash_file(path)} for path in sources]
    named = {} if columns is None else {"columns": columns}
    make_folder(folder)
    with DirectoryLock(folder) as lock, marked_parts(lock.mark):
        if target is not None:
            remove_leftovers(target.resolve().parent, lock.mark)
        if start is None and workers > 1:
            start = partial(run_local, workers=workers, lock=lock)
        try:
            store = TileStore(
                folder,
                {"inputs": inputs, "versions": describe_versions(), **named},
                tile_size=tile_size,
                run=run_in_turn if start is None else partial(_run_tiles, start=start),
                on_progress=on_stage,
            )
            yield segment_planes(chunks, settings, voxel=voxel, store=store)
        except BaseException:
            if not TileStore(folder).is_begun:
                _remove_work(folder, lock)
            raise
        _remove_work(folder, lock)


def _check_outside(folder: Path, files: Sequence[Path]) -> None:
    """Refuse files of the user in the folder of the work."""
    for file in files:
        if folder.resolve() in file.resolve().parents:
            raise ConfigError(
                f"{file}: expected a file outside of {folder}, which is for the work on it alone; "
                "move it, or choose another directory for the work."
            )


def _remove_work(folder: Path, lock: DirectoryLock) -> None:
    """Remove what the work has made, and its folder unless something else is in it."""
    lock.remove()
    TileStore(folder).remove_all()


@dataclass(frozen=True)
class TileReport(TaskReport):
    """What became of a tile, and what has been written for it."""

    written: tuple[Written, ...] = ()


@dataclass(frozen=True)
class TileWork:
    """One stage of one tile, as engines take it."""

    tile: TileTask
    inputs: ClassVar[tuple[Path, ...]] = ()

    @property
    def name(self) -> str:
        """Stage and tile."""
        return self.tile.name

    @property
    def memory(self) -> int:
        """What the tile takes with the points around it."""
        return memory_of_tile(self.tile.num_points)

    def run(self) -> TileReport:
        """Work on the tile; what goes wrong is in the report."""
        written: list[Written] = []

        def work(begin: Callable[[str], None]) -> Converted:
            begin(self.tile.stage)
            written.extend(self.tile.run())
            return Converted(self.tile.num_points, 0, ())

        return TileReport(**vars(report_on(self.name, work)), written=tuple(written))

    def clean(self) -> None:
        """Do nothing: a tile is written where it belongs."""


def _run_tiles(
    tiles: Sequence[TileTask], start: Callable[[Sequence[Task]], Reports]
) -> Iterator[tuple[TileTask, Sequence[Written]]]:
    """Run tiles on an engine, and yield each that is done; raise FormatError for one that fails."""
    by_name = {tile.name: tile for tile in tiles}
    if not tiles:
        return
    with contextlib.closing(start([TileWork(tile) for tile in tiles])) as reports:
        for report in reports:
            if report is None:
                continue
            if not isinstance(report, TileReport) or report.status == "failed":
                raise FormatError(f"{report.name}: {report.reason}")
            yield by_name[report.name], report.written
