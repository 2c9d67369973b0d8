"""One writer in a directory, and no lock outlives its holder."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrg.batch import run
from torchrg.batch.run import LOCK, lock_folder
from torchrg.errors import FormatError

HOLD = """
import sys, time
from pathlib import Path
from torchrg.batch.run import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
UNLOCKABLE = r": cannot be locked: .*; use another disk"


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    """Do not wait for a lock."""
    monkeypatch.setattr(run, "LOCK_TIMEOUT_SECONDS", 0)


def check_refused(folder):
    with pytest.raises(FormatError, match="locked by another torchrg process; wait") as error:
        lock_folder(folder).__enter__()
    assert str(error.value).startswith(f"{folder}: ")


def test_the_second_is_refused_until_the_first_has_ended(tmp_path):
    with lock_folder(tmp_path):
        check_refused(tmp_path)
    with lock_folder(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] in ([], [LOCK])


def test_a_file_of_others_in_the_place_of_the_lock_is_told_and_stays(tmp_path):
    (tmp_path / "theirs").write_text("theirs")
    (tmp_path / LOCK).symlink_to("theirs")
    with pytest.raises(FormatError, match=UNLOCKABLE):
        lock_folder(tmp_path).__enter__()
    (tmp_path / LOCK).unlink()
    (tmp_path / LOCK).mkdir()
    with pytest.raises(FormatError, match=UNLOCKABLE):
        lock_folder(tmp_path).__enter__()
    assert (tmp_path / "theirs").read_text() == "theirs"


def test_a_holder_that_is_killed_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        check_refused(tmp_path)
        holder.send_signal(signal.SIGKILL)
    with lock_folder(tmp_path):
        pass


def test_a_worker_ends_with_its_parent_whatever_it_does(tmp_path, faults):
    fcntl = pytest.importorskip("fcntl")
    script = f"""
import torchrg.__main__
import fcntl, sys
sys.path.insert(0, {str(Path(faults.__file__).parent)!r})
import faults
from pathlib import Path
from torchrg.batch.local import run_local
if __name__ == "__main__":
    place = Path(sys.argv[1])
    jobs = faults.make_jobs(place, {{"1_a": "slow writing"}})
    held = (place / "held").open("w")
    fcntl.flock(held, fcntl.LOCK_EX)
    for report in run_local(jobs, workers=1, memory_limit=10**12):
        if any((place / "out").rglob(".result.*")):
            print("writing", flush=True)
"""
    (tmp_path / "run.py").write_text(script)
    command = [sys.executable, str(tmp_path / "run.py"), str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline() == "writing\n"
        worker = int((tmp_path / "log").read_text().split()[1])
        os.kill(worker, signal.SIGSTOP)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        # A worker that has not ended yet does not hold the locks of its parent.
        with (tmp_path / "held").open("w") as held:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.kill(worker, signal.SIGCONT)
        parent.stdout.read()  # Until the worker has ended, too, which has the same stream.
    assert "done" not in (tmp_path / "log").read_text()
