"""Commands with several inputs: output paths, loop, progress and exit code."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from threading import RLock
from typing import Any, NoReturn

from tqdm import tqdm

from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.cli.ending import SOME_FAILED, fail, print_lines, printable, warn
from torchrg.errors import FormatError
from torchrg.io import FORMATS, RESULT_FIELDS, check_output
from torchrg.io.dxf import check_dxf
from torchrg.io.fields import describe_renamed_fields
from torchrg.io.files import check_writable, create_folder, list_some, normalize_file_name
from torchrg.io.npy import DISPLAYED_FIELDS
from torchrg.io.result import PAGE_SUFFIXES
from torchrg.render.page import read_library
from torchrg.structures import Cloud, Segmentation

# In Python 3.14 the default lock of tqdm starts a process that imports from the working directory.
tqdm.set_lock(RLock())
# Its thread would keep workers from being forked. Bars of long steps refresh without it.
tqdm.monitor_interval = 0

STAGES = ("neighbors", "normals", "regions", "planes", "orientation")
"""Stages of the segmentation of a cloud, as in progress bars."""


def output_paths(inputs: Sequence[Path], out: Path, *, suffix: str = ".npz") -> list[Path]:
    """Return the output path of each input.

    A single input is written to ``out``, a cloud or a file with the extension ``suffix``, or under
    its own name into an existing directory. Several inputs need a directory, which is created. If
    ``suffix`` is empty, each result is a directory.

    Raises:
        FormatError: If there is no input, two results share a name, or one cannot be written.
    """
    if not inputs:
        raise FormatError("expected at least one input file, got none.")
    ending = out.suffix.lower()
    if suffix and len(inputs) == 1 and not out.is_dir():
        check_output(out, other=suffix)
        return [out]
    for path in inputs:  # A word after a switch is taken for an input.
        if not path.exists():
            raise FormatError(f"{path}: file not found; check the path.")
    if ending and ending in (suffix, *FORMATS) and not out.is_dir():
        raise FormatError(
            f"{out}: expected a directory for {len(inputs)} inputs, got a file; pass a directory."
        )
    results = [out / f"{path.stem}{suffix}" for path in inputs]
    first: dict[str, Path] = {}
    for result, source in zip(results, inputs, strict=True):
        other = first.setdefault(normalize_file_name(result.name), source)
        if other is not source:
            raise FormatError(
                f"{source}: has the same name as {other}, so that both would be written to "
                f"{out / result.name}; use different output directories."
            )
    create_folder(out)
    for result in results if suffix else []:
        check_writable(result)
    return results


def check_distinct(results: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise FormatError if a result would overwrite an input or another result."""
    taken = {str(path.resolve()) for path in inputs}
    files = {_file_id(path) for path in inputs} - {None}
    for path in results:
        output = str(path.resolve())
        if not taken.isdisjoint((output, normalize_file_name(output))) or _file_id(path) in files:
            raise FormatError(f"{path}: would overwrite an input or a result; choose another.")
        taken.add(normalize_file_name(output))


def _file_id(path: Path) -> tuple[int, int] | None:
    """Return the device and inode of a file, which ignore case; None if it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def sidecar_paths(
    results: Sequence[Path], output: Path | None, *, suffixes: Sequence[str] = PAGE_SUFFIXES
) -> Sequence[Path | None]:
    """Return the path of the image or table of each result, like :func:`output_paths`.

    Files in a directory get the first of the extensions.
    """
    if output is None:
        return [None] * len(results)
    if not output.is_dir():
        if len(results) == 1 and output.suffix:
            check_sidecar(output, suffixes=suffixes)
            return [output]
        if output.suffix.lower() in suffixes:
            raise FormatError(f"{output}: expected a directory for several files, got a file.")
    create_folder(output)
    paths = [output / f"{path.stem}{suffixes[0]}" for path in results]
    for path in paths:
        check_writable(path)
    return paths


def check_sidecar(path: Path, *, suffixes: Sequence[str] = PAGE_SUFFIXES) -> None:
    """Raise if an image, viewer or table cannot be written; call before long computations."""
    if path.suffix.lower() not in suffixes:
        endings = " or ".join(suffixes)
        raise FormatError(
            f"{path}: expected a file ending in {endings}, got {path.suffix!r}; write one."
        )
    check_writable(path)
    if has_suffix(path, ".html"):
        read_library()
    if has_suffix(path, ".dxf"):
        check_dxf()


def has_suffix(path: Path, suffix: str) -> bool:
    """Return whether a file has an extension, which is in lower case here."""
    return path.suffix.lower() == suffix


def display_name(source: Path | Sequence[Path]) -> str:
    """Return the name of an input in messages: a file, or several merged files."""
    return list_some([*map(str, [source] if isinstance(source, Path) else source)], max_names=1)


def run_each(
    write: Callable[..., None],
    arguments: Any,  # noqa: ANN401
    inputs: Sequence[Path | Sequence[Path]],
    *columns: Sequence[Any],
) -> int:
    """Call ``write`` with the arguments and the values of each input; return the exit code.

    A failure is printed on one line and the remaining inputs continue; the error of a single input
    is raised. A full disk ends the loop.
    """
    rows = list(zip(inputs, *columns, strict=True))
    if len(rows) == 1:
        write(arguments, *rows[0])
        return 0
    num_failed = 0
    for number, row in enumerate(rows):

        def work(begin: Begin, row: Sequence[Any] = row) -> TaskReport:
            write(arguments, *row)
            return TaskReport(display_name(row[0]), "converted")

        report = report_on(display_name(row[0]), work)
        print_failure(report)
        num_failed += report.status == "failed"
        if report.disk_full:
            state = f"{number + 1 - num_failed:,} of {len(rows):,} inputs are complete"
            message = f"the disk is full; {state}. Free space and rerun the command."
            return fail(f"{arguments.out}: {message}", code=SOME_FAILED)
    if num_failed:
        message = f"{num_failed} of {len(rows)} inputs failed, the remaining ones are written."
        return fail(message, code=SOME_FAILED)
    return 0


def print_failure(report: TaskReport) -> None:
    """Print the reason of a failed task."""
    if report.status == "failed":
        fail(f"{report.name}: {report.reason.removeprefix(f'{report.name}: ')}")


def note_input(
    source: str, cloud: Cloud, target: Path, results: Collection[str] = RESULT_FIELDS
) -> None:
    """Warn about assumptions made while reading, and about fields that results replace.

    An ``.npz`` file does not have the fields of the cloud.
    """
    replaced = () if has_suffix(target, ".npz") else describe_renamed_fields(cloud.fields, results)
    for note in (*cloud.notes, *replaced):
        warn(f"{source}: {note}.")


def dropped_fields_note(target: Path, fields: Collection[str]) -> str:
    """Describe the fields of a cloud that its result omits."""
    kept = (*DISPLAYED_FIELDS, *RESULT_FIELDS)  # Results replace earlier results.
    names = [name for name in fields if name not in kept and has_suffix(target, ".npz")]
    return f" (without the input fields {', '.join(names)})" if names else ""


def report_planes(
    source: str, seg: Segmentation, num_points: int, reason: str, written: str
) -> None:
    """Print the planes of a result and where they were written; warn if there are none.

    ``num_points`` is the number that counts as all points, ``reason`` why there is no plane.
    """
    if len(seg.planes) == 0:
        warn(f"{source}: no plane found: {reason}.")
    number, colon, kinds = str(seg.planes).partition(": ")
    percent = 100 * int((seg.labels >= 0).sum()) / max(num_points, 1)
    print_lines(f"{source}: {number}, {percent:.1f} % labeled{colon}{kinds}; {written}")


@contextlib.contextmanager
def stage_bar(name: str, stages: Sequence[str]) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on a terminal; call the yielded function at the start of each stage."""
    with tqdm(
        total=len(stages), desc=printable(name), unit="stage", leave=False, disable=None
    ) as bar:

        def advance(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update(stage != stages[0])

        yield advance


class Progress:
    """Progress bar that counts scans, weighted by their points (or frames)."""

    def __init__(self, bar: "tqdm[NoReturn]", sizes: Mapping[str, int], *, unit: str) -> None:
        self.bar, self.sizes, self.unit = bar, sizes, unit
        self.num_done = self.num_failed = 0

    def __call__(self, report: TaskReport | None) -> None:
        """Count a report, or only refresh the bar."""
        if report is not None:
            self.num_done += 1
            self.num_failed += report.status == "failed"
            self.bar.update(self.sizes[report.name])
        failed = f", {self.num_failed} failed" if self.num_failed else ""
        self.bar.set_description_str(f"{self.num_done}/{len(self.sizes)} {self.unit}s{failed}")
