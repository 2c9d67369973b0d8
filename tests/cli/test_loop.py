"""Results that have no place are refused before the work, by every command that writes."""

import ctypes
import json
import os
import subprocess
import sys

import numpy as np
import pytest

CAMERA = ["--intrinsics", "50,50,39.5,29.5", "--depth-scale", "1000"]
# prctl(PR_CAPBSET_DROP, ...) of CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH, by which the superuser
# writes where no one may.
_PR_CAPBSET_DROP, _CAPABILITIES = 24, (1, 2)


def obey_permissions():
    """Let what is run next be a user like others; called between fork and exec."""
    if os.geteuid() == 0:
        for capability in _CAPABILITIES:
            ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)


SERVER = """
import contextlib, io, json, os, sys
from torchrg.cli import main
for line in sys.stdin:
    arguments, folder = json.loads(line)
    os.chdir(folder)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        with contextlib.redirect_stderr(io.StringIO()) as err:
            code = main(arguments)
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""


@pytest.fixture(scope="module")
def server():
    """A process that is subject to permissions and runs commands in sequence."""
    with subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=obey_permissions,
    ) as process:
        yield process
        process.stdin.close()


@pytest.fixture
def there(server, place):
    """Run a command there, in the folder of the test; return its code, output and errors."""

    def call(*arguments):
        print(json.dumps([arguments, str(place)]), file=server.stdin, flush=True)
        return json.loads(server.stdout.readline())

    return call


@pytest.fixture
def place(tmp_path):
    """Two rooms, a depth image, a folder that no one may write into, and files no one may change.

    A command that begins its work would fail with another message: all inputs are damaged.
    """
    for number in (1, 2):
        (tmp_path / f"room{number}.npz").write_bytes(b"PK\x03\x04 no cloud")
        (tmp_path / f"{number}.png").write_bytes(b"\x89PNG no image")
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "room.npz").write_bytes(b"PK\x03\x04 no cloud")
    for name in ("shut", "open", "partly", "indexed"):
        (tmp_path / name).mkdir()
    (tmp_path / "shut" / "out").mkdir()
    for name in ("kept.npz", "kept.png", "kept.html", "kept.csv"):
        (tmp_path / "open" / name).write_bytes(b"kept")
        (tmp_path / "open" / name).chmod(0o444)
    for name in ("room2.npz", "room2.png", "2/planes.json", "report.json"):
        (tmp_path / "partly" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "partly" / name).write_bytes(b"kept")
        (tmp_path / "partly" / name).chmod(0o444)
    (tmp_path / "indexed" / "index.html").write_bytes(b"kept")
    (tmp_path / "indexed" / "index.html").chmod(0o444)
    (tmp_path / "shut" / "out").chmod(0o555)
    (tmp_path / "shut").chmod(0o555)
    yield tmp_path
    for folder in ("shut", "shut/out"):
        (tmp_path / folder).chmod(0o755)


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.is_file() and path.read_bytes()
        for path in sorted(folder.rglob("*"))
    }


COMMANDS = [
    "segment room1.npz --out {}.npz",
    "segment room1.npz --out open/x.npz --picture {}.png",
    "segment room1.npz --out open/x.npz --picture {}.html",
    "normals room1.npz --out {}.npz",
    "sample {}.npz --num-points 100000000",
    "depth 1.png --out {}.png",
    "depth 1.png --out open/x.png --picture {}.png",
    "view room1.npz --out {}.png",
    "view room1.npz --out {}.html",
]
FOLDERS = [
    ("segment room1.npz room2.npz --out {}", "partly/room2.npz"),
    ("segment room1.npz room2.npz --out open --picture {}", "partly/room2.png"),
    ("segment room1.npz room2.npz --out open --pages --picture {}", "indexed/index.html"),
    ("normals room1.npz room2.npz --out {}", "partly/room2.npz"),
    ("depth 1.png 2.png --out {}", "partly/2/planes.json"),
    ("depth 2.png --out {}", "partly/2/planes.json"),
    ("convert folder scans {}", "partly/report.json"),
    ("convert folder scans open --pages {}", "indexed/index.html"),
]


def words_of(command):
    return [*command.split(), *(CAMERA if command.startswith("depth") else [])]


def check_refused(place, there, command, target):
    before = contents(place)
    code, out, err = there(*words_of(command))
    assert (code, err.count("\n"), out) == (2, 1, ""), err
    assert f"{target}: cannot be written: " in err
    assert "is read-only; make it writable, or use another." in err
    assert contents(place) == before


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("target", ["shut/x", "open/kept"])
def test_a_file_that_cannot_be_written_is_told_before_the_work(place, there, command, target):
    suffix = command.split("{}")[1].split()[0]
    check_refused(place, there, command.format(target), f"{target}{suffix}")


@pytest.mark.parametrize(("command", "kept"), FOLDERS)
def test_a_directory_with_a_file_that_cannot_be_written_is_told_too(place, there, command, kept):
    check_refused(place, there, command.format(kept.split("/")[0]), kept)


@pytest.mark.parametrize("command", [command for command, _ in FOLDERS])
def test_a_directory_that_takes_no_files_is_told_before_the_work(place, there, command):
    for target, message in (("shut/out", "is read-only"), ("shut/new", "cannot be created")):
        if target == "shut/new" and command.startswith("depth 2.png --out"):
            continue  # One image goes to a file.
        code, _, err = there(*words_of(command.format(target)))
        assert (code, err.count("\n")) == (2, 1), err
        assert message in err
    assert not list(place.joinpath("shut", "out").iterdir())


def test_a_device_is_no_place(tmp_path, run):
    os.mkfifo(tmp_path / "pipe.png")
    np.savez(tmp_path / "a.npz", points=np.eye(3), labels=np.arange(3))
    done = run("view", tmp_path / "a.npz", "--out", tmp_path / "pipe.png")
    assert "expected a file to write, got a device" in done.error


@pytest.mark.parametrize("command", ["segment", "normals"])
def test_inputs_whose_results_would_share_a_file_are_both_named(tmp_path, run, command):
    inputs = [tmp_path / name for name in ("a/x.npz", "b/X.pcd")]
    for path in inputs:
        path.parent.mkdir()
        path.touch()
    line = run(command, *inputs, "--out", tmp_path / "out").error
    assert all(str(name) in line for name in (*inputs, "use different output directories"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["index", "INDEX"])
def test_no_page_takes_the_place_of_the_index(tmp_path, run, name):
    pytest.importorskip("pydeck", reason="needs the extra view")
    inputs, pages = tmp_path / "in", tmp_path / "pages"
    inputs.mkdir()
    pages.mkdir()
    (inputs / f"{name}.npy").touch()
    for command in (
        ("segment", inputs / f"{name}.npy", "--out", tmp_path, "--pages", "--picture", pages),
        ("convert", "folder", inputs, tmp_path / "out", "--pages", pages),
    ):
        assert f"the viewer of {name} would overwrite the index" in run(*command).error
    assert not list(pages.iterdir())
