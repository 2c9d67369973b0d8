"""The loop of every command over several inputs: progress, notes, failures, and the exit code."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from tqdm import tqdm

from torchrg.batch.task import Begin, TaskReport, report_on
from torchrg.cli.ending import SOME_FAILED, fail, printable, warn
from torchrg.cli.places import is_archive
from torchrg.io import RESULT_FIELDS
from torchrg.io.fields import notes_on_results
from torchrg.structures import Cloud


def run_each(
    write: Callable[..., None],
    arguments: Any,  # noqa: ANN401
    names: Sequence[str],
    *columns: Sequence[Any],
) -> int:
    """Call ``write`` with the arguments and the values of each input; return the exit code.

    One that fails stops no other and is told in one line; where it is the only one, its error is
    that of the command. A full disk ends the loop, as every further input would fail.
    """
    rows = list(zip(*columns, strict=True))
    if len(rows) == 1:
        write(arguments, *rows[0])
        return 0
    num_failed = 0
    for number, (name, row) in enumerate(zip(names, rows, strict=True)):

        def work(begin: Begin, name: str = name, row: Sequence[Any] = row) -> TaskReport:
            write(arguments, *row)
            return TaskReport(name, "converted")

        report = report_on(name, work)
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
    return f" (without its own {', '.join(fields)})" if fields and is_archive(target) else ""


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
