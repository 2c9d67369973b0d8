"""The files that ``segment_planes`` runs through, in the order in which it first enters them.

    python scripts/trace_path.py consensus
    python scripts/trace_path.py consensus --brief

The map to read the code by: each file with the functions by which other files enter it. What runs
only at import does not count, nor what a decorator wraps around a function.
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
"""Enough for neighbours by cells, several chunks and every kind of surface."""

WIDTH = 118
"""Characters of a line of text."""

LONGEST = {"classic": 23, "paper": 31, "consensus": 32}
"""Most files on the path of a preset: a test keeps it."""


def trace(preset: str) -> dict[str, list[str]]:
    """Return the files on the path of a preset, and the functions by which they are entered."""
    room = torchrg.scenes.make_room(num_points=NUM_POINTS, noise=0.003, seed=0)
    config = torchrg.load_config(preset)
    torchrg.segment_planes(room.points[: NUM_POINTS // 8], config)  # Loads all the code.
    entered: dict[str, dict[str, None]] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        code, caller = frame.f_code, frame.f_back
        path = Path(code.co_filename)
        is_wrapper = re.search(r"<locals>\.call", code.co_qualname)
        if event != "call" or PACKAGE not in path.parents or is_wrapper:
            return
        doors = entered.setdefault(path.relative_to(PACKAGE).as_posix(), {})
        name, _, inner = code.co_qualname.partition(".")
        is_door = not name.startswith(("_", "<")) and not inner.startswith("<locals>")
        if is_door and caller and caller.f_code.co_filename != code.co_filename:
            doors.setdefault(name)

    profile, num_threads = sys.getprofile(), torch.get_num_threads()
    torch.set_num_threads(1)
    sys.setprofile(note)
    try:
        torchrg.segment_planes(room.points, config)
    finally:
        sys.setprofile(profile)
        torch.set_num_threads(num_threads)
    return {file: list(doors) for file, doors in entered.items()}


def as_lines(path: dict[str, list[str]]) -> list[str]:
    """Return a path as text: a line for each file, and their number."""
    width = max(map(len, path))
    lines = [f"{file:{width}}  {', '.join(doors)}".rstrip() for file, doors in path.items()]
    return [*lines, f"{len(path)} files"]


def as_paragraph(path: dict[str, list[str]]) -> list[str]:
    """Return the files of a path alone, in lines of text."""
    return textwrap.wrap(" > ".join(path), WIDTH, break_on_hyphens=False)


def main() -> None:
    """Print the path of a preset."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("preset", nargs="?", default="consensus", choices=preset_names())
    parser.add_argument("--brief", action="store_true", help="file names alone")
    arguments = parser.parse_args()
    path = trace(arguments.preset)
    print(*(as_paragraph(path) if arguments.brief else as_lines(path)), sep="\n")


if __name__ == "__main__":
    main()
