"""Files executed by ``segment_planes``, in order of their first call.

    python scripts/trace_path.py consensus
    python scripts/trace_path.py consensus --brief

A map for reading the code: each file with the functions that other files call. Code that only runs
at import and decorator wrappers are ignored.
"""

import argparse
import re
import sys
import textwrap
from pathlib import Path
from types import FrameType

import torch

import torchrg
from torchrg.config import preset_names

PACKAGE = Path(torchrg.__file__).parent
NUM_POINTS = 8_000
"""Number of points; enough for the cell search, several chunks and all surface types."""

WIDTH = 118
"""Line width in characters."""

MAX_FILES = {"classic": 24, "paper": 34, "consensus": 34}
"""Maximum number of files per preset, enforced by a test."""


def trace(preset: str) -> dict[str, list[str]]:
    """Return the files executed by a preset, and the functions called from other files."""
    room = torchrg.scenes.make_room(num_points=NUM_POINTS, noise=0.003, seed=0)
    config = torchrg.load_config(preset)
    torchrg.segment_planes(room.points[: NUM_POINTS // 8], config)  # Imports all modules.
    entered: dict[str, dict[str, None]] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        code, caller = frame.f_code, frame.f_back
        path = Path(code.co_filename)
        is_wrapper = re.search(r"<locals>\.call", code.co_qualname)
        if event != "call" or PACKAGE not in path.parents or is_wrapper:
            return
        entries = entered.setdefault(path.relative_to(PACKAGE).as_posix(), {})
        name, _, inner = code.co_qualname.partition(".")
        is_entry = not name.startswith(("_", "<")) and not inner.startswith("<locals>")
        if is_entry and caller and caller.f_code.co_filename != code.co_filename:
            entries.setdefault(name)

    profile, num_threads = sys.getprofile(), torch.get_num_threads()
    torch.set_num_threads(1)
    sys.setprofile(note)
    try:
        torchrg.segment_planes(room.points, config)
    finally:
        sys.setprofile(profile)
        torch.set_num_threads(num_threads)
    return {file: list(entries) for file, entries in entered.items()}


def as_lines(path: dict[str, list[str]]) -> list[str]:
    """Return a path as text, one line per file, and the number of files."""
    width = max(map(len, path))
    lines = [f"{file:{width}}  {', '.join(entries)}".rstrip() for file, entries in path.items()]
    return [*lines, f"{len(path)} files"]


def as_paragraph(path: dict[str, list[str]]) -> list[str]:
    """Return only the files of a path, as wrapped text."""
    return textwrap.wrap(" > ".join(path), WIDTH, break_on_hyphens=False)


def main() -> None:
    """Print the path of a preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("preset", nargs="?", default="consensus", choices=preset_names())
    parser.add_argument("--brief", action="store_true", help="only file names")
    arguments = parser.parse_args()
    path = trace(arguments.preset)
    print(*(as_paragraph(path) if arguments.brief else as_lines(path)), sep="\n")


if __name__ == "__main__":
    main()
