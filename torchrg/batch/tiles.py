"""A cloud in tiles, as a command does it: within a limit of memory, alone in its directory."""

import contextlib
import hashlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from torchrg.batch.convert import ScanReport, report_on
from torchrg.batch.local import run_local
from torchrg.batch.memory import SCAN_BYTES_PER_POINT
from torchrg.batch.records import describe_versions, hash_file
from torchrg.batch.run import LOCK, DirectoryLock, Reports
from torchrg.batch.scans import Converted, Scan
from torchrg.config import PipelineConfig
from torchrg.errors import ConfigError, FormatError
from torchrg.io.files import marked_parts, remove_leftovers
from torchrg.pipeline import segment_planes
from torchrg.stages import TileTask
from torchrg.store import TILE_SIZE, FolderStore, Written, make_folder, run_in_turn
from torchrg.structures import Cloud, Segmentation

_BASE_BYTES = 500_000_000
"""Of a process before the first point: Python, torch, scipy."""
_BYTES_PER_POINT = 100
"""What the steps on the whole cloud take for each of its points: the regions of ``consensus``, or
the table of planes, 55, with 150 for each point of the largest region, up to a third of all."""
_BYTES_AT_ONCE, _POINTS_AT_ONCE = 250, 1_500_000
"""And for each point up to so many: regions that are measured together, and those pages of the
neighbours' file that were just read."""
_BYTES_PER_TILE_POINT = 2_000
"""What a tile takes for each of its own, with those around it."""
_SMALLEST_TILE = 20_000
"""Points. Smaller ones are mostly what is around them."""
_LEAST_POINTS_A_WORKER = 2_000_000
"""Of the whole cloud: a process takes two seconds to load torch, in each stage, and one of these
points a microsecond at least."""


def choose_tile_size(num_points: int, memory_limit: int) -> int:
    """Return how many points a tile may have for a cloud to stay within a limit of memory, bytes.

    Raises:
        ConfigError: If the steps that look at the whole cloud take more than the limit.

    Example:
        >>> choose_tile_size(100_000, 800_000_000)
        150000
    """
    most = (memory_limit - _BASE_BYTES) // _BYTES_PER_TILE_POINT
    whole = _BYTES_PER_POINT * num_points + _BYTES_AT_ONCE * min(num_points, _POINTS_AT_ONCE)
    needed = _BASE_BYTES + max(whole, _BYTES_PER_TILE_POINT * _SMALLEST_TILE)
    if needed > memory_limit:
        raise ConfigError(
            f"expected --limit-memory of at least {needed / 1e9:.2f} GB for about {num_points:,} "
            f"points, got {memory_limit / 1e9:.2f} GB; raise it, or split the cloud."
        )
    return min(most, TILE_SIZE)


def choose_workers(num_points: int, tile_size: int, memory_limit: int) -> int:
    """Return how many processes may work on tiles within a limit of memory, bytes, beside this one.

    With one, this process does the work itself, on its threads.

    Example:
        >>> choose_workers(50_000, 20_000, 2**40)
        1
    """
    room = (memory_limit - _BASE_BYTES) // (_BASE_BYTES + _BYTES_PER_TILE_POINT * tile_size)
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
    start: Callable[[Sequence["TileJob"]], Reports] | None = None,
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
        folder: Of the work alone; see :class:`torchrg.store.FolderStore`. Another process that
            works there is refused.
        settings: Of the pipeline.
        tile_size: Points of a tile.
        target: The file that the caller writes the result to. What an earlier call was writing when
            it was killed is removed.
        workers: Processes of one thread that work on tiles side by side, as many as there is memory
            for; with one, this process works on tile after tile, on its threads.
        start: Starts another engine on the jobs of a stage.
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
            start = partial(
                run_local, workers=workers, memory_limit=sys.maxsize, lock=lock, work=work_on_tile
            )
        try:
            store = FolderStore(
                folder,
                {"inputs": inputs, "versions": describe_versions(), **named},
                tile_size=tile_size,
                run=run_in_turn if start is None else partial(_run_jobs, start=start),
                on_progress=on_stage,
            )
            yield segment_planes(chunks, settings, voxel=voxel, store=store)
        except BaseException:
            if not FolderStore(folder).is_begun:
                _remove_work(folder)
            raise
        _remove_work(folder)


def _check_outside(folder: Path, files: Sequence[Path]) -> None:
    """Refuse files of the user in the folder of the work."""
    for file in files:
        if folder.resolve() in file.resolve().parents:
            raise ConfigError(
                f"{file}: expected a file outside of {folder}, which is for the work on it alone; "
                "move it, or choose another directory for the work."
            )


def _remove_work(folder: Path) -> None:
    """Remove what the work has made, and its folder unless something else is in it."""
    (folder / LOCK).unlink(missing_ok=True)
    FolderStore(folder).remove_all()


@dataclass(frozen=True)
class TileJob:
    """The work on a tile, as engines take it."""

    task: TileTask

    @property
    def scan(self) -> Scan:
        """The tile under the name of its stage; its size is one of memory."""
        num_bytes = self.task.num_points * _BYTES_PER_TILE_POINT
        return Scan(self.task.name, (), num_bytes // SCAN_BYTES_PER_POINT)

    def remove_leftovers(self) -> None:
        """Do nothing: a tile is written where it belongs."""


@dataclass(frozen=True)
class TileReport(ScanReport):
    """What became of a tile, and what has been written for it."""

    written: tuple[Written, ...] = ()


def work_on_tile(job: TileJob) -> TileReport:
    """Work on a tile; what goes wrong is in the report."""
    written: list[Written] = []

    def work(begin: Callable[[str], None]) -> Converted:
        begin(job.task.stage)
        written.extend(job.task.run())
        return Converted(job.task.num_points, 0, ())

    report = report_on(job.task.name, work)
    return TileReport(**vars(report), written=tuple(written))


def _run_jobs(
    tasks: Sequence[TileTask], start: Callable[[Sequence[TileJob]], Reports]
) -> Iterator[tuple[TileTask, Sequence[Written]]]:
    """Run tasks on an engine, and yield each that is done; raise FormatError for one that fails."""
    by_name = {task.name: task for task in tasks}
    if not tasks:
        return
    with contextlib.closing(start([TileJob(task) for task in tasks])) as reports:
        for report in reports:
            if report is None:
                continue
            if not isinstance(report, TileReport) or report.status == "failed":
                raise FormatError(f"{report.name}: {report.reason}")
            yield by_name[report.name], report.written
