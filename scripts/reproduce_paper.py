"""Reproduce the tables and figures of the paper with every method of torchrg.

    python scripts/reproduce_paper.py --out DIR                 # everything
    python scripts/reproduce_paper.py --out DIR --quick         # small clouds, minutes
    python scripts/reproduce_paper.py --out DIR normals times   # some parts

Open DIR/report.html. Results are stored under DIR and not computed again by the same commit, so an
interrupted run resumes; delete DIR/cells to measure again. A full run needs a clean working tree,
because a report describes one commit. Quick results are in DIR/quick. Synthetic clouds with
ground truth replace the paper's clouds that are not passed.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the scenes of tests.made

from reproduction import method, normals, segmentation, study, times
from reproduction.clouds import TITLES, Run
from reproduction.records import Folder, Record, is_committed, made_with
from reproduction.report import keep, write_report

PARTS: dict[str, tuple[Callable[[Run], Record], str]] = {
    "method": (method.reproduce, "Figures 1, 2, 5 and 6: the method and its indices"),
    "normals": (normals.reproduce, "Table 1, Figures 3 and 4: errors and times of normals"),
    "study": (study.reproduce, "section II.B: limits of angle and curvature"),
    "segmentation": (segmentation.reproduce, "Table 2, Figures 7 to 9"),
    "times": (times.reproduce, "Table 3: times"),
}
"""Function and description of each part."""


def main() -> None:
    """Make the requested parts, and the report of all parts in the folder."""
    arguments = _parse()
    mpl.use("agg")
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    commit = made_with()["commit"]
    if not arguments.quick and not is_committed(commit):
        sys.exit(
            "reproduce_paper.py: expected committed code for a report at full size, got commit "
            f"{commit}; commit the changes, or pass --quick."
        )
    path = arguments.out / "quick" if arguments.quick else arguments.out
    folder = Folder(path)
    paths = {key: getattr(arguments, key) for key in TITLES}
    run = Run(folder, arguments.quick, paths, arguments.estimator)
    for name in arguments.parts or PARTS:
        begin = time.perf_counter()
        print(f"== {name}: {PARTS[name][1]}", flush=True)
        part = PARTS[name][0](run)
        folder.write(f"parts/{name}.json", json.dumps(part, indent=1))
        print(f"== {name}: {time.perf_counter() - begin:.0f} s", flush=True)
    report = write_report(folder, list(PARTS), quick=arguments.quick)
    print(f"Wrote {folder.path / 'report.html'} and report.json")
    if arguments.keep:
        try:
            keep(report)
        except ValueError as error:
            sys.exit(f"reproduce_paper.py: {error}")


def _parse() -> argparse.Namespace:
    """Parse the command line."""
    listed = "; ".join(f"{name}: {what}" for name, (_, what) in PARTS.items())
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", choices=[*PARTS, []], metavar="part", help=f"{listed}. Default: all"
    )
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--quick", action="store_true", help="use small clouds (a few minutes)")
    parser.add_argument(
        "--threads", type=int, help="number of torch threads; default: chosen by torch"
    )
    parser.add_argument(
        "--keep", action="store_true", help="replace the results shown in the documentation"
    )
    parser.add_argument(
        "--estimator",
        metavar="MODULE:FUNCTION",
        help="also evaluate a function from points to normals and curvature (part normals)",
    )
    for key, title in TITLES.items():
        words = f"the paper's {title}; its labels and normals are the ground truth"
        parser.add_argument(f"--{key}", type=Path, metavar="PATH", help=words)
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Interrupted; run the same command to resume.")
