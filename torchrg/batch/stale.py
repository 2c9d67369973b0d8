"""Stale results: results of renamed or removed scans.

Otherwise a ScanNet scan that moves from ``train`` to ``val`` would stay in ``train`` as well. An
output directory contains one data set in one layout, and its records are the index: a result is of
the scan of its name, else of the scan with its first input file, by path or by content.
"""

import os
import secrets
import shutil
from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from torchrg.batch.run import LOCK, read_report
from torchrg.batch.scans import Job
from torchrg.datasets.folder import natural_key
from torchrg.datasets.provenance import Record, check_source, read_record, recorded_paths
from torchrg.errors import FormatError
from torchrg.io.files import (
    OUTPUT_MARK,
    find_leftovers,
    hash_file,
    is_unchanged,
    list_some,
    remove_leftovers,
    sync_folder,
)
from torchrg.io.result import PAGE_SUFFIXES, RECORD

__all__ = ["StaleResult", "check_stale", "find_stale", "remove_stale"]
__dir__ = __all__.copy

_MAX_NAMED = 3
"""Maximum number of results named in an error, so that it stays one line."""


class StaleResult(NamedTuple):
    """Earlier result without a scan of that name in the data set.

    Attributes:
        out: The output directory.
        name: Name of the result, its folder below the output directory.
        scan: Current name of the scan, None if it was removed from the data set.
        paths: Fingerprints of its files and pages; None for any content.
        page_folders: Folders that contain its pages, and an index of pages.
    """

    out: Path
    name: str
    scan: str | None
    paths: dict[Path, Record | None]
    page_folders: set[Path]

    @property
    def folder(self) -> Path:
        """Folder of the result."""
        return self.out / self.name

    @property
    def reason(self) -> str:
        """Why the result is stale, for messages."""
        state = "is no longer in the data set" if self.scan is None else f"is {self.scan} now"
        return f"its scan {state}"


def find_stale(jobs: Sequence[Job]) -> list[StaleResult]:
    """Return the stale results of a data set in an output directory, in natural order.

    Results of unselected scans, whose input is still there, are not stale.

    Args:
        jobs: All scans of the data set.

    Raises:
        FormatError: If there is another data set, kind or layout, or a corrupt record.
    """
    out, source = jobs[0].out, jobs[0].source
    names, records, described = {job.name for job in jobs}, find_records(out), source.describe()
    for name, record in records.items():
        check_source(out / name, record, described)
    inputs = {name: _first_input(record) for name, record in records.items()}
    paths = {n: Path(os.path.realpath(source.root / first)) for n, (first, _) in inputs.items()}
    files = {job.name: job.scan.files[0] for job in jobs if job.scan.files}
    by_path = {Path(os.path.realpath(path)): name for name, path in files.items()}
    scans = {name: by_path.get(path) for name, path in paths.items() if name not in names}
    missing = [n for n in scans if scans[n] is None and not (inputs[n][0] and paths[n].exists())]
    scans |= (renamed := _find_renamed(files, inputs, missing))
    is_same = not records or renamed or str(source.root) in (str(out), read_report(out).get("root"))
    if not is_same and not any(is_unchanged(paths[name], inputs[name][1]) for name in records):
        raise FormatError(
            f"{out}: expected results of {source.root}, got another data set "
            f"({list_some(missing or [*records], _MAX_NAMED)}); choose another directory, or "
            "remove them."
        )
    stale = (name for name, scan in scans.items() if scan is not None or name in missing)
    return [_describe_stale(out, name, scans[name], records[name]) for name in stale]


def find_records(out: Path) -> dict[str, Record]:
    """Return the records of the results in an output directory, by name, in natural order.

    Copied records and single results without a source are skipped. Links are followed, but no
    folder is entered twice, nor other output directories.

    Raises:
        FormatError: If a record is corrupt.
    """
    records, seen = {}, set[str]()
    for folder, folders, files in os.walk(out, followlinks=True):
        path, real, is_top = Path(folder), os.path.realpath(folder), folder == str(out)
        record = read_record(path, strict=True) if RECORD in files and not is_top else None
        name = path.relative_to(out).as_posix()
        if record and record.get("name", name) == name and isinstance(record.get("source"), dict):
            records[name] = record
        is_left = real in seen or (LOCK in files and not is_top)
        folders[:] = [] if is_left else [child for child in folders if child[0] != "."]
        seen.add(real)
    return dict(sorted(records.items(), key=lambda item: natural_key(item[0])))


def check_stale(results: Sequence[StaleResult], root: Path, *, prune: bool) -> None:
    """Raise FormatError if stale results of the data set in ``root`` cannot be removed.

    Results of removed scans require ``prune``. Files that were changed since torchrg wrote them, or
    that it did not write, are never removed.
    """
    missing = [str(result.folder) for result in results if result.scan is None and result.paths]
    if missing and not prune:
        raise FormatError(
            f"{list_some(missing, _MAX_NAMED)}: no scan in {root} belongs to these results; remove "
            "them with --prune, or keep them with --only '*'."
        )
    for result in results:
        if (path := _changed_file(result)) is not None:
            raise FormatError(
                f"{path}: was changed or not written by torchrg, and {result.reason}; move it."
            )


def remove_stale(result: StaleResult) -> None:
    """Remove a result with its pages, its record last, and then empty folders.

    If the command is killed meanwhile, the next one finds the record and removes the remainder.
    """
    remove_leftovers(result.folder)
    for path in result.paths:
        path.unlink(missing_ok=True)
    for parent in {path.parent for path in result.paths}:
        sync_folder(parent)
        remove_empty(parent, {result.out, *result.page_folders})
    _remove_record(result.folder, result.out)


def _first_input(record: Record) -> tuple[str, Record]:
    """Return the name and the fingerprint of the first input in a record, or an empty name."""
    inputs = record.get("inputs")
    first = inputs[0] if isinstance(inputs, list) and inputs else None
    if not isinstance(first, dict):
        return "", {}
    return str(first.get("name", "")), {key: first.get(key) for key in ("bytes", "sha256")}


def _find_renamed(
    files: dict[str, Path], inputs: dict[str, tuple[str, Record]], missing: Sequence[str]
) -> dict[str, str]:
    """Return the current names of missing scans whose first input has another name now."""
    sizes = [inputs[name][1].get("bytes") for name in missing]
    by_content = defaultdict[str, list[str]](list)
    for name, path in files.items() if missing else ():
        if path.is_file() and path.stat().st_size in sizes:
            by_content[hash_file(path)].append(name)
    contents = {name: str(stored.get("sha256")) for name, (_, stored) in inputs.items()}
    return {
        name: scan
        for name in missing
        for scan in by_content[contents[name]]
        if contents.get(scan) != contents[name]  # Else it is a copy.
    }


def _describe_stale(out: Path, name: str, scan: str | None, record: Record) -> StaleResult:
    """Return a stale result with the files of its record below ``out``, and its pages."""
    folders = {Path(os.path.normpath(out / str(folder))) for folder in record.get("pages", ())}
    paths = recorded_paths(out, out / name, record)
    paths |= {folder / f"{name}{suffix}": None for folder in folders for suffix in PAGE_SUFFIXES}
    return StaleResult(out, name, scan, paths, folders)


def _changed_file(result: StaleResult) -> Path | None:
    """Return a file or link that prevents removing a result, or None."""
    folder, paths = result.folder, result.paths
    if folder.is_symlink():
        return folder
    for path, stored in paths.items():
        if os.path.lexists(path) and not is_unchanged(path, stored):
            return path
    allowed = {*paths, folder / RECORD, *find_leftovers(folder)}
    entries = sorted(folder.iterdir())
    return next((path for path in entries if path not in allowed and not path.is_dir()), None)


def remove_empty(folder: Path, tops: Collection[Path]) -> None:
    """Remove a folder and its parents below one of ``tops``, as long as they are empty."""
    with suppress(OSError):
        while folder not in tops:
            if folder.exists():
                folder.rmdir()
            folder = folder.parent


def _remove_record(folder: Path, out: Path) -> None:
    """Remove the record in a folder and then empty folders, in one step for a killed process."""
    if [*folder.iterdir()] != [folder / RECORD]:
        (folder / RECORD).unlink(missing_ok=True)
        return
    while folder.parent != out and [*folder.parent.iterdir()] == [folder]:
        if folder.parent.is_symlink():
            break
        folder = folder.parent
    with suppress(OSError):  # A mounted folder stays where it is.
        folder = folder.rename(out / f".removed.{OUTPUT_MARK}{secrets.token_hex(4)}")
        sync_folder(out)
    shutil.rmtree(folder)
