"""What commands over several inputs share: places of results, the loop, progress, and exit code."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from threading import RLock
from typing import Any, NoReturn

from tqdm import tqdm

from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.cli.ending import SOME_FAILED, fail, printable, warn
from torchrg.errors import FormatError
from torchrg.io import FORMATS, RESULT_FIELDS, check_output
from torchrg.io.fields import notes_on_results
from torchrg.io.files import check_place, folded_name, make_folder
from torchrg.io.npy import KEPT_FIELDS
from torchrg.render.page import check_library
from torchrg.structures import Cloud

# Tqdm's own lock starts a process in Python 3.14, which would import from the folder of a command.
tqdm.set_lock(RLock())

DRAWINGS = (".png", ".html")
"""Suffixes of pictures and pages."""
STAGES = ("neighbors", "normals", "regions", "planes", "orientation")
"""Stages of the segmentation of a cloud, which progress bars show."""


def output_paths(inputs: Sequence[Path], out: Path, *, suffix: str = ".npz") -> list[Path]:
    """Return where the result of each input goes.

    One input goes to the file ``out``, a cloud or of the given suffix, or under its own name into
    an existing directory; several need a directory, which is made. With an empty suffix each result
    is a directory.

    Raises:
        FormatError: If there is no input, two results would share a name, or one cannot be
            written.
    """
    if not inputs:
        raise FormatError("expected at least one input file, got none.")
    ending = out.suffix.lower()
    if suffix and len(inputs) == 1 and not out.is_dir():
        check_place(out) if ending == suffix else check_output(out)
        return [out]
    if ending and ending in (suffix, *FORMATS) and not out.is_dir():
        raise FormatError(
            f"{out}: expected a directory for {len(inputs)} inputs, got a file name; "
            "name a directory."
        )
    results = [out / f"{path.stem}{suffix}" for path in inputs]
    first: dict[str, Path] = {}
    for result, source in zip(results, inputs, strict=True):
        other = first.setdefault(folded_name(result.name), source)
        if other is not source:
            raise FormatError(
                f"{source}: another input has the same name, {other}, and {out / result.name} is "
                "one place; give them different directories."
            )
    make_folder(out)
    for result in results if suffix else []:
        check_place(result)
    return results


def check_apart(results: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise FormatError if a result would take the place of an input or of another result."""
    taken = {str(path.resolve()) for path in inputs}
    files = {_file_number(path) for path in inputs} - {None}
    for path in results:
        place = str(path.resolve())
        if not taken.isdisjoint((place, folded_name(place))) or _file_number(path) in files:
            raise FormatError(
                f"{path}: expected a place of its own for each result, got one of an input or of "
                "another result; choose another."
            )
        taken.add(folded_name(place))


def _file_number(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from others, whatever the case of its name; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def paths_beside(
    results: Sequence[Path], place: Path | None, *, suffixes: Sequence[str] = DRAWINGS
) -> Sequence[Path | None]:
    """Return where the picture or table of each result goes, as :func:`output_paths` does.

    In a directory they end in the first of the suffixes.
    """
    if place is None:
        return [None] * len(results)
    if not place.is_dir():
        if len(results) == 1 and place.suffix:
            check_beside(place, suffixes=suffixes)
            return [place]
        if place.suffix.lower() in suffixes:
            raise FormatError(
                f"{place}: expected a directory for {len(results)} files, got a file name."
            )
    make_folder(place)
    paths = [place / f"{path.stem}{suffixes[0]}" for path in results]
    for path in paths:
        check_place(path)
    return paths


def check_beside(path: Path, *, suffixes: Sequence[str] = DRAWINGS) -> None:
    """Raise before long work if a picture, page or table has no place, or cannot be made."""
    if path.suffix.lower() not in suffixes:
        endings = " or ".join(suffixes)
        raise FormatError(
            f"{path}: expected a file that ends in {endings}, got {path.suffix!r}; name it so."
        )
    check_place(path)
    if is_page(path):
        check_library()


def is_page(path: Path) -> bool:
    """Return whether a drawing is a page."""
    return path.suffix.lower() == ".html"


def is_archive(path: Path) -> bool:
    """Return whether a result goes to the format that holds it alone, without a cloud's fields."""
    return path.suffix.lower() == ".npz"


def name_of(source: Path | Sequence[Path]) -> str:
    """Return what an input is called in messages: a file, or files that are one cloud."""
    first, *others = [source] if isinstance(source, Path) else source
    return f"{first} and {len(others)} more" if others else f"{first}"


def run_each(
    write: Callable[..., None],
    arguments: Any,  # noqa: ANN401
    inputs: Sequence[Path | Sequence[Path]],
    *columns: Sequence[Any],
) -> int:
    """Call ``write`` with the arguments and the values of each input; return the exit code.

    One that fails stops no other and is told in one line; where it is the only one, its error is
    that of the command. A full disk ends the loop, as every further input would fail.
    """
    rows = list(zip(inputs, *columns, strict=True))
    if len(rows) == 1:
        write(arguments, *rows[0])
        return 0
    num_failed = 0
    for number, row in enumerate(rows):

        def work(begin: Begin, row: Sequence[Any] = row) -> TaskReport:
            write(arguments, *row)
            return TaskReport(name_of(row[0]), "converted")

        report = report_on(name_of(row[0]), work)
        tell_failure(report)
        num_failed += report.status == "failed"
        if report.disk_full:
            state = f"{number + 1 - num_failed:,} of {len(rows):,} inputs are complete"
            told = f"the disk is full; {state}. Make room. The same command begins anew."
            return fail(f"{arguments.out}: {told}", code=SOME_FAILED)
    if num_failed:
        told = f"{num_failed} of {len(rows)} inputs failed, the others are written."
        return fail(told, code=SOME_FAILED)
    return 0


def tell_failure(report: TaskReport) -> None:
    """Print why a task failed, if it did."""
    if report.status == "failed":
        fail(f"{report.name}: {report.reason.removeprefix(f'{report.name}: ')}")


def note_input(
    source: str, cloud: Cloud, target: Path, results: Collection[str] = RESULT_FIELDS
) -> None:
    """Warn of what reading took for granted, and of fields of a cloud whose names results take."""
    replaced = () if is_archive(target) else notes_on_results(cloud.fields, results)
    for note in (*cloud.notes, *replaced):
        warn(f"{source}: {note}.")


def left_out(target: Path, fields: Collection[str]) -> str:
    """Return the words for a report on which fields of a cloud its result does not hold."""
    names = [name for name in fields if name not in KEPT_FIELDS and is_archive(target)]
    return f" (without its own {', '.join(names)})" if names else ""


@contextlib.contextmanager
def stage_bar(name: str, stages: Sequence[str]) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on a terminal; what is yielded is called as each stage begins."""
    with tqdm(
        total=len(stages), desc=printable(name), unit="stage", leave=False, disable=None
    ) as bar:

        def advance(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update(stage != stages[0])

        yield advance


class Progress:
    """A progress bar that counts scans and moves by points, or by frames where those are scans."""

    def __init__(self, bar: "tqdm[NoReturn]", sizes: Mapping[str, int], *, unit: str) -> None:
        self.bar, self.sizes, self.unit = bar, sizes, unit
        self.num_done = self.num_failed = 0

    def __call__(self, report: TaskReport | None) -> None:
        """Take a report, or only show that time passes."""
        if report is not None:
            self.num_done += 1
            self.num_failed += report.status == "failed"
            self.bar.update(self.sizes[report.name])
        failed = f", {self.num_failed} failed" if self.num_failed else ""
        self.bar.set_description_str(f"{self.num_done}/{len(self.sizes)} {self.unit}s{failed}")
