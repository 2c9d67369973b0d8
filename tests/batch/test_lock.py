"""One writer in a directory, and no lock outlives its holders."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchrg.batch.lock import DirectoryLock
from torchrg.errors import FormatError

HOLD = """
import sys, time
from pathlib import Path
from torchrg.batch.lock import DirectoryLock
with DirectoryLock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_second_is_refused_and_told_who_is_first(tmp_path):
    message = rf"another .* \(process {os.getpid()} on .*wait for it"
    with DirectoryLock(tmp_path), pytest.raises(FormatError, match=message):
        DirectoryLock(tmp_path, patience=0)
    with DirectoryLock(tmp_path, patience=0):
        pass


def test_a_mark_stays_and_a_file_of_others_does_too(tmp_path):
    with DirectoryLock(tmp_path) as lock:
        mark = lock.mark
    with DirectoryLock(tmp_path) as lock:
        assert lock.mark == mark
    assert re.fullmatch("[0-9a-f]{16}", mark)
    (tmp_path / ".torchrg.lock").write_text("process 7 on a host")  # Of a version without marks.
    with DirectoryLock(tmp_path) as lock:
        assert lock.mark != mark
    (tmp_path / "theirs").write_text("theirs")
    for name in ("theirs", "nothing"):
        (tmp_path / ".torchrg.lock").unlink()
        (tmp_path / ".torchrg.lock").symlink_to(tmp_path / name)
        with pytest.raises(FormatError, match=r"\.torchrg\.lock: cannot be written"):
            DirectoryLock(tmp_path)
    (tmp_path / "theirs").replace(tmp_path / ".torchrg.lock")
    with pytest.raises(FormatError, match=r"\.torchrg\.lock: is in the way, it is no lock"):
        DirectoryLock(tmp_path)
    assert (tmp_path / ".torchrg.lock").read_text() == "theirs"


def test_who_waited_for_a_lock_that_was_removed_has_one_that_others_see(tmp_path):
    with DirectoryLock(tmp_path) as first:
        waiting = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        while str(tmp_path) not in opened_by(waiting.pid):
            time.sleep(0.01)
        first.remove()
    with waiting:
        assert waiting.stdout.readline() == "held\n"
        with pytest.raises(FormatError, match=f"process {waiting.pid} "):
            DirectoryLock(tmp_path, patience=0)
        waiting.kill()


def opened_by(process):
    """Return the paths of the files that a process has open, a line each."""
    links = Path(f"/proc/{process}/fd").iterdir()
    return "\n".join(str(link.readlink()) for link in links if link.is_symlink())


def test_a_holder_that_is_killed_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(FormatError, match=f"process {holder.pid} "):
            DirectoryLock(tmp_path, patience=0)
        holder.send_signal(signal.SIGKILL)
    with DirectoryLock(tmp_path):
        pass


def test_a_worker_holds_the_lock_on_and_ends_with_its_parent(tmp_path, faults):
    script = f"""
import sys
sys.path.insert(0, {str(Path(faults.__file__).parent)!r})
import faults
from pathlib import Path
from torchrg.batch.local import run_local
from torchrg.batch.lock import DirectoryLock
if __name__ == "__main__":
    place = Path(sys.argv[1])
    jobs = faults.make_jobs(place, {{"1_a": "slow writing"}})
    with DirectoryLock(place) as lock:
        for report in run_local(jobs, workers=1, memory_limit=10**12, lock=lock):
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
        with pytest.raises(FormatError, match="writes here"):
            DirectoryLock(tmp_path, patience=0.2)
        os.kill(worker, signal.SIGCONT)
        parent.stdout.read()
    begin = time.monotonic()
    with DirectoryLock(tmp_path):
        assert time.monotonic() - begin < 5
