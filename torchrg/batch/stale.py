"""Stale results: results of renamed or removed scans.

Otherwise a ScanNet scan that moves from ``train`` to ``val`` would stay in ``train`` as well. An
output directory may contain results of several data sets, so it lists the scan names of each.
"""

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from torchrg.batch.records import (
    RECORD,
    Record,
    is_unchanged,
    read_record,
    resolve_output,
)
from torchrg.batch.run import DATA_SETS, LOCK, REPORT
from torchrg.batch.scans import Job
from torchrg.datasets.folder import natural_key
from torchrg.datasets.pointcept import written_files
from torchrg.errors import FormatError
from torchrg.io import atomic_path
from torchrg.io.files import (
    PARSE_ERRORS,
    find_leftovers,
    marked_parts,
    remove_leftovers,
    run_mark,
    sync_folder,
)
from torchrg.result import PLANES_FILE

__all__ = ["StaleResult", "check_stale", "find_stale", "remove_stale"]
__dir__ = __all__.copy

DataSet = dict[str, str]
"""First input file of each scan of a data set, by scan name."""
_MAX_NAMED = 3
"""Maximum number of results named in an error, so that it stays one line."""


class StaleResult(NamedTuple):
    """Earlier result without a scan of that name in the data set.

    Attributes:
        out: The output directory.
        name: Name of the result, its folder below the output directory.
        scan: Current name of the scan, None if it was removed from the data set.
        files: Fingerprints of its files by path relative to the folder; None for the files of a
            killed conversion, which has no record.
    """

    out: Path
    name: str
    scan: str | None
    files: dict[str, Record | None]

    @property
    def folder(self) -> Path:
        """Folder of the result."""
        return self.out / self.name

    @property
    def paths(self) -> dict[Path, Record | None]:
        """Files by absolute path, without files outside the output directory."""
        found = {resolve_output(self.out, self.folder, n): data for n, data in self.files.items()}
        return {path: data for path, data in found.items() if path is not None}

    @property
    def reason(self) -> str:
        """Why the result is stale, for messages."""
        state = "is no longer in the data set" if self.scan is None else f"is {self.scan} now"
        return f"its scan {state}"


def find_stale(jobs: Sequence[Job]) -> list[StaleResult]:
    """Return the stale results of a data set in an output directory, in natural order.

    Results of unselected scans are not stale, nor results of other data sets, which have no scan
    in common with this one.

    Args:
        jobs: All scans of the data set.
    """
    out, source = jobs[0].out, jobs[0].source
    names, data_sets = {job.name for job in jobs}, _read_data_sets(out)
    inputs = {name: first for scans in data_sets for name, first in scans.items()}
    folders = {str(path.parent) for job in jobs for path in job.scan.files}
    found = {*_find_records(out, folders)}
    candidates = [name for name in inputs.keys() | found if name not in names]
    if not candidates:
        return []
    kind = source.describe().get("kind")
    scans = {os.path.realpath(job.scan.files[0]): job.name for job in jobs if job.scan.files}
    renamed: dict[str, str] = {}
    missing = []
    for name in candidates:
        folder = resolve_output(out, out, name)
        if folder in (None, out) or not folder.is_dir():
            continue
        if first := inputs.get(name) or _first_input(folder, kind):
            path = os.path.realpath(source.root / first)
            if path in scans:
                renamed[name] = scans[path]
            elif not Path(path).exists():
                missing.append(name)
    current = names | renamed.keys()
    groups = [*map(set, data_sets), found - inputs.keys()]
    same = set().union(*(group for group in groups if not group.isdisjoint(current)))
    stale = sorted([*renamed, *same.intersection(missing)], key=natural_key)
    return [StaleResult(out, name, renamed.get(name), _result_files(out / name)) for name in stale]


def check_stale(results: Sequence[StaleResult], root: Path, *, prune: bool) -> None:
    """Raise FormatError if stale results of the data set in ``root`` cannot be removed.

    Results of removed scans require ``prune``. Files that were changed since torchrg wrote them, or
    that it did not write, are never removed.
    """
    missing = [result for result in results if result.scan is None and result.files]
    if missing and not prune:
        first, num_more = missing[:_MAX_NAMED], len(missing) - _MAX_NAMED
        folders = ", ".join(str(result.folder) for result in first)
        more = f" and {num_more:,} more" if num_more > 0 else ""
        raise FormatError(
            f"{folders}{more}: no scan in {root} belongs to these results; remove them with "
            "--prune, or keep them with --only '*'."
        )
    for result in results:
        if (path := _changed_file(result)) is not None:
            raise FormatError(
                f"{path}: was changed or not written by torchrg, and {result.reason}; move it."
            )


def remove_stale(result: StaleResult) -> None:
    """Remove a result, its record last, and then empty folders.

    If the command is killed meanwhile, the next one finds the record and removes the remainder.
    """
    folder = result.folder
    paths = sorted(result.paths, key=lambda path: path.name == PLANES_FILE)
    if not folder.is_symlink():
        remove_leftovers(folder, run_mark(result.name))
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
    """Add the scans of a data set to the list in its output directory.

    Earlier names stay listed while their result folder exists.
    """
    out, existing = jobs[0].out, _read_data_sets(jobs[0].out)
    scans = {job.name: job.input_name(job.scan.files[0]) if job.scan.files else "" for job in jobs}
    current = scans.keys() | {result.name for result in removed}
    unrelated = [data_set for data_set in existing if current.isdisjoint(data_set)]
    for data_set in existing:
        if not current.isdisjoint(data_set):
            scans = {n: i for n, i in data_set.items() if (out / n).is_dir()} | scans
    updated = sorted([*unrelated, dict(sorted(scans.items()))], key=min)
    if updated != existing:
        with marked_parts(run_mark(REPORT)), atomic_path(out / DATA_SETS) as temporary:
            temporary.write_text(json.dumps(updated, indent=0), encoding="utf-8")


def _read_data_sets(out: Path) -> list[DataSet]:
    """Return the data sets listed in an output directory; none if the list is damaged."""
    try:
        content = json.loads((out / DATA_SETS).read_bytes())
        data_sets = [{str(n): str(first) for n, first in scans.items()} for scans in content]
    except (OSError, *PARSE_ERRORS):
        return []
    return [scans for scans in data_sets if scans]


def _find_records(out: Path, input_folders: set[str]) -> Iterator[str]:
    """Yield the names of results in a directory, whose folders contain a record.

    Links are not followed; other output directories and input folders are not entered.
    """
    for folder, folders, files in os.walk(out):
        is_top = folder == str(out)
        if RECORD in files and not is_top:
            yield Path(folder).relative_to(out).as_posix()
        if folder in input_folders or (LOCK in files and not is_top):
            folders.clear()


def _first_input(folder: Path, kind: object) -> str:
    """Return the first input in the record of a scan of a source type, or ""."""
    record = read_record(folder) or {}
    source, inputs = record.get("source"), record.get("inputs")
    if not isinstance(source, dict) or source.get("kind") != kind:
        return ""
    first = inputs[0] if isinstance(inputs, list) and inputs else None
    return str(first.get("name", "")) if isinstance(first, dict) else ""


def _result_files(folder: Path) -> dict[str, Record | None]:
    """Return the files of a result with their fingerprints, None for files without a record."""
    names, record = written_files(folder), read_record(folder)
    if record is None:
        return dict.fromkeys(names)
    parts = (dict.fromkeys(names), record["outputs"], *record["other_layouts"].values())
    return {name: stored or {} for part in parts for name, stored in part.items()}


def _changed_file(result: StaleResult) -> Path | None:
    """Return a file or link that prevents removing a result, or None."""
    if not result.files:
        return None
    folder, paths = result.folder, result.paths
    if folder.is_symlink():
        return folder
    for path, stored in paths.items():
        is_unmodified = path.is_file() if stored is None else is_unchanged(path, stored)
        if os.path.lexists(path) and not is_unmodified:
            return path
    allowed = {*paths, *find_leftovers(folder, run_mark(result.name))}
    if read_record(folder) is not None:  # A damaged record does not reveal changes.
        allowed.add(folder / RECORD)
    entries = sorted(folder.iterdir())
    return next((path for path in entries if path not in allowed and not path.is_dir()), None)


def _remove_empty(folder: Path, out: Path) -> None:
    """Remove a folder and its parents in the output directory, as long as they are empty."""
    while folder != out and folder.is_relative_to(out):
        try:
            folder.rmdir()
        except OSError:
            return
        folder = folder.parent
