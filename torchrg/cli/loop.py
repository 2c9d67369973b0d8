"""The loop of every command over several inputs: progress, what failed, and the exit code."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from tqdm import tqdm

from torchrg.batch.run import BatchReport, Plan, run_plan, run_tasks
from torchrg.batch.task import Begin, Reports, TaskReport, report_on
from torchrg.cli.ending import INTERRUPTED, SOME_FAILED, fail


def run_each(
    write: Callable[..., None],
    arguments: Any,  # noqa: ANN401
    names: Sequence[str],
    *columns: Sequence[Any],
) -> int:
    """Call ``write`` with the arguments and the values of each input; return the exit code.

    One that fails stops no other and is told in one line; where it is the only one, its error is
    that of the command.
    """
    rows = list(zip(*columns, strict=True))
    if len(rows) == 1:
        write(arguments, *rows[0])
        return 0

    def reports() -> Reports:
        for name, row in zip(names, rows, strict=True):

            def work(begin: Begin, name: str = name, row: Sequence[Any] = row) -> TaskReport:
                write(arguments, *row)
                return TaskReport(name, "converted")

            yield report_on(name, work)

    report = run_tasks(names, reports(), on_report=tell_failure)
    if report.interrupted:
        raise KeyboardInterrupt
    return finish(report, arguments.out, again="The same command begins anew.")


def run_with_bar(
    plan: Plan, reports: Reports, *, engine: str, workers: int | None, unit: str
) -> BatchReport:
    """Convert the scans of a plan, with a progress bar on a terminal; ``unit`` is what one is."""
    by_frames = unit == "frame"
    sizes = {job.name: 1 if by_frames else job.scan.num_points for job in plan.to_convert}
    bar_unit, total = "frame" if by_frames else "pt", sum(sizes.values())
    # The mean of the whole run: scans end rarely, and a recent rate would jump with each.
    with tqdm(total=total, unit=bar_unit, unit_scale=True, smoothing=0, disable=None) as bar:
        shown = Progress(bar, sizes, unit=unit)
        return run_plan(plan, reports, engine=engine, workers=workers, on_report=shown)


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


def tell_failure(report: TaskReport | None) -> None:
    """Print why a task failed, if it did."""
    if report is not None and report.status == "failed":
        fail(f"{report.name}: {report.reason.removeprefix(f'{report.name}: ')}")


def finish(
    report: BatchReport,
    out: Path,
    *,
    unit: str = "input",
    failed: str = "",
    again: str = "The same command goes on from here.",
) -> int:
    """Say what is left to do where not all is complete, and return the exit code.

    ``failed`` replaces what is said where some failed, and ``again`` how to go on.
    """
    num_done, num_tasks = len(report.complete), len(report.scans)
    state = f"{num_done:,} of {num_tasks:,} {unit}s are complete"
    if report.disk_full:
        return fail(f"{out}: the disk is full; {state}. Make room. {again}", code=SOME_FAILED)
    if report.interrupted:
        return fail(f"interrupted; {state}. {again}", code=INTERRUPTED)
    if num_done < num_tasks:
        others = f"{num_tasks - num_done} of {num_tasks} inputs failed, the others are written."
        return fail(failed or others, code=SOME_FAILED)
    return 0
