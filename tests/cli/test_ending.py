"""Ctrl-C and SIGTERM end a command with one line and 130, whatever the process is doing."""

import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from torchrg.cli.ending import printable

LINE = "torchrg: interrupted; every file written is complete.\n"
RUN = """
import os, runpy, signal, sys
moment, number, *sys.argv[1:] = sys.argv[1:]

class Moments:
    # Asked before each module is loaded, from the first line of the command on.
    loaded = 0

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        cls.loaded += cls.loaded > 0 or name == "torchrg.cli"
        global moment
        if moment == name:
            moment = ""
            os.kill(os.getpid(), int(number))

sys.meta_path.insert(0, Moments)
try:
    runpy.run_module("torchrg", run_name="__main__", alter_sys=True)
finally:
    print(f"{Moments.loaded} loaded")
"""
"""Arguments: a module at which the process gets a signal; the signal; then those of the command."""


def start(*command):
    """Start a process that hears interrupts, which the background of a shell does not."""
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL) and None,
    )


def check_interrupted(process, message):
    assert (process.returncode, message) == (130, LINE)


@pytest.fixture(scope="module")
def room(folder_of_clouds):
    return folder_of_clouds("room.npz", num_points=3000) / "room.npz"


@pytest.mark.parametrize(
    ("module", "number"),
    [
        ("torchrg.cli", signal.SIGINT),
        ("torchrg.errors", signal.SIGINT),
        ("torchrg.cli.segment", signal.SIGTERM),
        ("numpy", signal.SIGINT),
        ("torch", signal.SIGINT),
        ("torch", signal.SIGTERM),
        ("torch._C", signal.SIGINT),
    ],
)
def test_a_signal_while_modules_load_is_one_line(tmp_path, room, module, number):
    process = start("-c", RUN, module, int(number), "segment", room, "--out", tmp_path / "x.npz")
    shown, message = process.communicate()
    check_interrupted(process, message)
    assert shown in ("", "1 loaded\n", "2 loaded\n", "3 loaded\n")
    assert not list(tmp_path.iterdir())


TWICE = """
import os, signal, sys
import torchrg.__main__ as process

def interrupted(*_, **__):
    os.kill(os.getpid(), signal.SIGINT)

process.handle_interrupts = lambda handler: signal.signal(signal.SIGINT, signal.default_int_handler)
process.cli._run = process.cli.fail = interrupted
sys.exit(process.main())
"""


def test_a_second_signal_while_the_first_is_told_adds_no_stack():
    process = start("-c", TWICE)
    _, message = process.communicate()
    check_interrupted(process, message)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_when_all_is_done_comes_too_late(number):
    ending = f"import atexit, os\natexit.register(lambda: os.kill(os.getpid(), {int(number)}))\n"
    process = start("-c", ending + RUN, "never", 0, "--version")
    shown, message = process.communicate()
    assert (process.returncode, message) == (0, "")
    assert shown.startswith("torchrg ")


def test_interrupts_that_the_shell_lets_ignore_stay_ignored():
    process = subprocess.Popen(
        [sys.executable, "-c", RUN, "torchrg.errors", str(int(signal.SIGINT)), "--version"],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN) and None,
    )
    shown, _ = process.communicate()
    assert (process.returncode, shown.split()[0]) == (0, "torchrg")


COMMANDS = {
    "segment": ["segment", "IN", "--out", "OUT/x.npz", "--preset", "classic"],
    "view": ["view", "IN", "--out", "OUT/x.png", "--width", "100"],
    "sample": ["sample", "OUT/x.ply", "--num-points", "3000"],
}


def words_of(name, room, out):
    return [word.replace("IN", str(room)).replace("OUT", str(out)) for word in COMMANDS[name]]


def check_whole(out, expected):
    """Check that every file there is that of an undisturbed run."""
    for path in out.iterdir():
        assert path.read_bytes() == expected[path.name], path


@pytest.fixture
def undisturbed(room, tmp_path, request):
    """Name and bytes of the results of a command, and its seconds."""
    out, begin = tmp_path / "undisturbed", time.monotonic()
    out.mkdir()
    process = start("-c", RUN, "never", 0, *words_of(request.param, room, out))
    _, message = process.communicate()
    assert (process.returncode, message) == (0, "")
    files = {path.name: path.read_bytes() for path in out.iterdir()}
    return request.param, files, time.monotonic() - begin


@pytest.mark.slow
@pytest.mark.parametrize("undisturbed", COMMANDS, indirect=True)
def test_a_signal_at_any_time_is_one_line_or_comes_too_late(room, tmp_path, undisturbed):
    name, files, seconds = undisturbed
    times = random.Random(0)
    codes = []
    for number in range(40):
        out = tmp_path / str(number)
        out.mkdir()
        # Before the command begins, Python itself tells of a signal, by a stack.
        process = start("-c", "print(flush=True)\n" + RUN, "never", 0, *words_of(name, room, out))
        process.stdout.readline()
        time.sleep(0.05 + times.uniform(0, seconds))
        process.send_signal(signal.SIGTERM if number % 2 else signal.SIGINT)
        _, message = process.communicate()
        codes.append(process.returncode)
        if process.returncode:
            check_interrupted(process, message)
        else:
            assert message == ""
            assert len(list(out.iterdir())) == len(files)
        check_whole(out, files)
    assert 130 in codes


def test_the_garbage_collector_runs_again_once_a_command_is_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.eye(3))
    code = (
        "import gc; from torchrg.__main__ import main; was_on = gc.isenabled(); main(); "
        "print(was_on, gc.isenabled(), gc.get_freeze_count() > 0)"
    )
    command = [sys.executable, "-c", code, "info", str(tmp_path / "a.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False True True"


def test_printable_by_example():
    assert printable("caf\u00e9 \x1b[31m\n\u202e\udce9") == "café \\x1b[31m\\n\\u202e\\udce9"
