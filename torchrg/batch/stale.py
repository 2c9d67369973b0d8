"""Stale results: results of scans that have another name now, or are not in the data set any more.

A scan of ScanNet that moves from ``train`` to ``val`` would stay in ``train`` as well. An output
directory may hold results of several data sets, so it lists the scans of each by name.
"""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from torchrg.batch.records import (
    RECORD,
    Record,
    file_of_record,
    is_unchanged,
    read_record,
)
from torchrg.batch.run import DATA_SETS, LOCK, REPORT
from torchrg.batch.scans import Job
from torchrg.datasets.folder import natural_key
from torchrg.datasets.pointcept import written_files
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import (
    DAMAGES,
    find_leftovers,
    mark_of,
    marked_parts,
    remove_leftovers,
    sync_folder,
)
from torchrg.result import PLANES_FILE

DataSet = dict[str, str]
"""First input file of each scan of a data set, by the name of the scan."""
_MAX_NAMED = 3
"""Results that an error names, so that it stays one line."""


class StaleResult(NamedTuple):
    """An earlier result whose name no scan of the data set has.

    Attributes:
        out: The output directory.
        name: Name of the result, which is its folder below the output directory.
        scan: Name of the scan now, None if the data set does not have it any more.
        files: Fingerprints of its files by their paths from the folder. They are None for the files
            of a conversion that was killed, which has no record.
    """

    out: Path
    name: str
    scan: str | None
    files: dict[str, Record | None]

    @property
    def folder(self) -> Path:
        """The folder of the result."""
        return self.out / self.name

    @property
    def paths(self) -> dict[Path, Record | None]:
        """The files by their whole paths, without files outside the output directory."""
        found = {file_of_record(self.out, self.folder, n): noted for n, noted in self.files.items()}
        return {path: noted for path, noted in found.items() if path is not None}

    @property
    def reason(self) -> str:
        """Why the result is stale, in words."""
        where = "is not in the data set any more" if self.scan is None else f"is {self.scan} now"
        return f"its scan {where}"


def find_stale(jobs: Sequence[Job]) -> list[StaleResult]:
    """Return the stale results in the output directory of a data set, in natural order.

    A result is not stale if its scan is in the data set but was not asked for, or if it is of
    another data set: one that has no scan in common with this one.

    Args:
        jobs: All scans of the data set.
    """
    out, source = jobs[0].out, jobs[0].source
    names, data_sets = {job.name for job in jobs}, _read_data_sets(out)
    inputs = {name: first for scans in data_sets for name, first in scans.items()}
    folders = {str(path.parent) for job in jobs for path in job.scan.files}
    found = {*_find_records(out, folders)}
    earlier = [name for name in inputs.keys() | found if name not in names]
    if not earlier:
        return []
    kind = source.describe().get("kind")
    scans = {os.path.realpath(job.scan.files[0]): job.name for job in jobs if job.scan.files}
    renamed: dict[str, str] = {}
    missing = []
    for name in earlier:
        folder = file_of_record(out, out, name)
        if folder in (None, out) or not folder.is_dir():
            continue
        if first := inputs.get(name) or _first_input(folder, kind):
            path = os.path.realpath(source.root / first)
            if path in scans:
                renamed[name] = scans[path]
            elif not Path(path).exists():
                missing.append(name)
    own = names | renamed.keys()
    groups = [*map(set, data_sets), found - inputs.keys()]
    same = set().union(*(group for group in groups if not group.isdisjoint(own)))
    stale = sorted([*renamed, *same.intersection(missing)], key=natural_key)
    return [StaleResult(out, name, renamed.get(name), _files_of(out / name)) for name in stale]


def check_stale(results: Sequence[StaleResult], root: Path, *, prune: bool) -> None:
    """Raise FormatError if stale results of the data set in ``root`` cannot be removed.

    Results whose scan is not in the data set any more need ``prune``. A file that was changed since
    torchrg wrote it, or that it did not write, is never removed.
    """
    missing = [result for result in results if result.scan is None and result.files]
    if missing and not prune:
        first, num_more = missing[:_MAX_NAMED], len(missing) - _MAX_NAMED
        folders = ", ".join(str(result.folder) for result in first)
        more = f" and {num_more:,} more" if num_more > 0 else ""
        raise FormatError(
            f"{folders}{more}: expected the scan of each result in {root}, got none; remove such "
            "results with --prune, or keep them with --only '*'."
        )
    for result in results:
        if (path := _changed_file(result)) is not None:
            raise FormatError(
                f"{path}: expected a file as torchrg wrote it, got another or a changed one, and "
                f"{result.reason}; move it away."
            )


def remove_stale(result: StaleResult) -> None:
    """Remove a result, its record last, and then the folders that are empty.

    A command that was killed meanwhile finds the record, and removes the rest the next time.
    """
    folder = result.folder
    paths = sorted(result.paths, key=lambda path: path.name == PLANES_FILE)
    if not folder.is_symlink():
        remove_leftovers(folder, mark_of(result.name))
    parents = {folder, *(path.parent for path in paths)}
    for path in paths:
        path.unlink(missing_ok=True)
    for parent in parents:
        sync_folder(parent)
    if result.files:
        (folder / RECORD).unlink(missing_ok=True)
    for parent in parents:
        _remove_empty(parent, result.out)


def note_data_set(jobs: Sequence[Job], removed: Sequence[StaleResult]) -> None:
    """Write the scans of a data set into the list of its output directory, if it is not there.

    Earlier names stay on the list as long as there is a folder of results.
    """
    out, before = jobs[0].out, _read_data_sets(jobs[0].out)
    scans = {job.name: job.input_name(job.scan.files[0]) if job.scan.files else "" for job in jobs}
    own = scans.keys() | {result.name for result in removed}
    others = [data_set for data_set in before if own.isdisjoint(data_set)]
    for data_set in before:
        if not own.isdisjoint(data_set):
            scans = {n: i for n, i in data_set.items() if (out / n).is_dir()} | scans
    after = sorted([*others, dict(sorted(scans.items()))], key=min)
    if after != before:
        with marked_parts(mark_of(REPORT)), atomic_path(out / DATA_SETS) as temporary:
            temporary.write_text(json.dumps(after, indent=0), encoding="utf-8")


def _read_data_sets(out: Path) -> list[DataSet]:
    """Return the data sets that are noted in an output directory, none where that is damaged."""
    try:
        content = json.loads((out / DATA_SETS).read_bytes())
        data_sets = [{str(n): str(first) for n, first in scans.items()} for scans in content]
    except (OSError, *DAMAGES):
        return []
    return [scans for scans in data_sets if scans]


def _find_records(out: Path, folders_of_inputs: set[str]) -> Iterator[str]:
    """Yield the names of the results in a directory, as their folders hold a record.

    Links are not followed, and other output directories and folders of inputs not entered.
    """
    for place, folders, files in os.walk(out):
        is_top = place == str(out)
        if RECORD in files and not is_top:
            yield Path(place).relative_to(out).as_posix()
        if place in folders_of_inputs or (LOCK in files and not is_top):
            folders.clear()


def _first_input(folder: Path, kind: object) -> str:
    """Return the first input that the record of a scan of a kind names, nothing without one."""
    record = read_record(folder) or {}
    source, inputs = record.get("source"), record.get("inputs")
    if not isinstance(source, dict) or source.get("kind") != kind:
        return ""
    first = inputs[0] if isinstance(inputs, list) and inputs else None
    return str(first.get("name", "")) if isinstance(first, dict) else ""


def _files_of(folder: Path) -> dict[str, Record | None]:
    """Return the files of a result with their fingerprints, None for those without a record."""
    names, record = written_files(folder), read_record(folder)
    if record is None:
        return dict.fromkeys(names)
    parts = (dict.fromkeys(names), record["outputs"], *record["other_layouts"].values())
    return {name: noted or {} for part in parts for name, noted in part.items()}


def _changed_file(result: StaleResult) -> Path | None:
    """Return a file or link in the way of removing a result, None if there is none."""
    if not result.files:
        return None
    folder, paths = result.folder, result.paths
    if folder.is_symlink():
        return folder
    for path, noted in paths.items():
        is_ours = path.is_file() if noted is None else is_unchanged(path, noted)
        if os.path.lexists(path) and not is_ours:
            return path
    known = {*paths, *find_leftovers(folder, mark_of(result.name))}
    if read_record(folder) is not None:  # A damaged record does not show what was changed.
        known.add(folder / RECORD)
    entries = sorted(folder.iterdir())
    return next((path for path in entries if path not in known and not path.is_dir()), None)


def _remove_empty(folder: Path, out: Path) -> None:
    """Remove a folder and those above it in the output directory, as long as they are empty."""
    while folder != out and folder.is_relative_to(out):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
