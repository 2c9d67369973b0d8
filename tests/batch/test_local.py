"""The local engine: every scan gets its report, whatever happens to the workers."""

import subprocess
import sys
from contextlib import closing
from multiprocessing import Pipe, get_context
from pathlib import Path

import pytest

from torchrg._limits import system_limit
from torchrg.batch.local import _convert_scans, run_local
from torchrg.batch.memory import scan_memory

PLENTY = 10**12


def run(jobs, *, workers=2, memory_limit=PLENTY):
    """Return the reports by name."""
    reports = [r for r in run_local(jobs, workers=workers, memory_limit=memory_limit) if r]
    assert len(reports) == len(jobs)
    return {report.name: report for report in reports}


def log_of(folder):
    """Return the lines that scans wrote: name and process when they began, name and done."""
    return [tuple(line.split()) for line in (folder / "log").read_text().splitlines()]


def test_failures_and_deaths_stop_no_other_scan(faults, tmp_path):
    jobs = faults.make_jobs(
        tmp_path,
        {
            "9_a": "kill once",
            "8_b": "corrupt",
            "7_c": "kill while writing",
            "6_d": "threads",
            "5_e": "sleep 0.2",
            "4_f": "exit",
        },
    )
    reports = run(jobs)
    failed = {name for name, report in reports.items() if report.status == "failed"}
    assert failed == {"8_b", "7_c", "4_f"}
    end = "twice (second attempt ran alone)"
    memory = "it may have run out of memory"
    assert reports["7_c"].reason == f"its process was killed by SIGKILL, {end}; {memory}"
    assert reports["4_f"].reason == f"its process ended with 7, {end}"
    assert [reports[name].attempts for name in ("9_a", "8_b", "7_c", "6_d")] == [2, 1, 2, 1]
    assert not list((tmp_path / "out" / "7_c").iterdir())
    # Scans that were lost come again after all others, one at a time.
    log = log_of(tmp_path)
    again = [name for name, what in log if what != "done"][len(jobs) :]
    assert sorted(again) == ["4_f", "7_c", "9_a"]
    assert log.index(("5_e", "done")) < log.index(("9_a", "done"))


def test_a_worker_ends_in_silence_when_nobody_takes_its_report(faults, tmp_path, set_threads):
    set_threads(1)
    (job,) = faults.make_jobs(tmp_path, {"9_a": "plain"})
    ours, theirs = Pipe()
    ours.send(job)
    ours.close()
    _convert_scans(theirs, None)
    assert log_of(tmp_path)[-1] == ("9_a", "done")


def test_a_worker_that_cannot_begin_is_told_by_its_cause(faults, tmp_path, capfd, monkeypatch):
    # A forked one has begun.
    monkeypatch.setattr("torchrg.batch.local._context", lambda: get_context("spawn"))
    jobs = faults.make_jobs(tmp_path, {"9_a": "plain"})
    # Workers do not find the module of their tasks.
    sys.path.remove(str(Path(faults.__file__).parent))
    assert run(jobs)["9_a"].reason == (
        "its process ended with 1, twice (second attempt ran alone): ModuleNotFoundError: No "
        "module named 'faults'"
    )
    assert capfd.readouterr().err == ""


def test_the_largest_begin_first_and_share_the_memory(faults, tmp_path):
    names = ["1000000_a", "3000000_b", "2000000_c", "900000_d"]
    jobs = faults.make_jobs(tmp_path, dict.fromkeys(names, "sleep 0.3"))
    # The largest leaves room for one of the small ones, never for the second.
    limit = scan_memory(3_000_000) + scan_memory(1_000_000)
    run(jobs, memory_limit=limit)
    log = log_of(tmp_path)
    # Two processes start side by side: which of them writes first is not said.
    assert log[0][0] in ("3000000_b", "1000000_a")
    running, most = set(), 0
    for name, what in log:
        running = running - {name} if what == "done" else running | {name}
        most = max(most, sum(scan_memory(int(n.split("_")[0])) for n in running))
    assert most <= limit


def test_a_scan_beyond_the_limit_runs_alone(faults, tmp_path):
    jobs = faults.make_jobs(tmp_path, {"9_a": "sleep 0.2", "8_b": "plain"})
    run(jobs, memory_limit=1)
    assert [name for name, _ in log_of(tmp_path)] == ["9_a", "9_a", "8_b", "8_b"]


def test_closing_stops_workers_and_removes_what_they_were_writing(faults, tmp_path):
    jobs = faults.make_jobs(tmp_path, {"9_a": "slow writing"})
    with closing(run_local(jobs, workers=1, memory_limit=PLENTY)) as reports:
        while not list((tmp_path / "out").rglob(".result.*")):
            assert next(reports) is None
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_no_jobs_start_no_worker():
    assert list(run_local([], workers=2, memory_limit=1)) == []


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_process_that_cannot_start_is_a_limit_of_the_system(
    faults, tmp_path, monkeypatch, method
):
    def start(self):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("torchrg.batch.local._context", lambda: get_context(method))
    monkeypatch.setattr(get_context(method).Process, "start", start)
    with pytest.raises(RuntimeError, match="can't start new process") as error:
        run(faults.make_jobs(tmp_path, {"9_a": "plain"}))
    assert "raise the limit of processes" in system_limit(error.value)


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only")
def test_only_a_process_of_one_thread_forks():
    script = """
import time
import torchrg.__main__
from threading import Event, Thread
from torchrg.batch.local import _context
print(_context().get_start_method())
done = Event()
Thread(target=done.wait).start()
print(_context().get_start_method())
done.set()
Thread(target=time.sleep, args=(0.02,)).start()
print(_context().get_start_method())
"""
    printed = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert printed.stdout.decode().split() == ["fork", "spawn", "fork"]
