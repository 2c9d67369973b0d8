"""Reproduce the tables and figures of the paper with every method of torchrg.

    python scripts/reproduce_paper.py --out DIR                 # everything
    python scripts/reproduce_paper.py --out DIR --quick         # small clouds, in minutes
    python scripts/reproduce_paper.py --out DIR normals times   # selected parts

Open DIR/report.html. Each result is stored in a separate file under DIR and reused by the same
commit, so rerunning the command resumes an interrupted run; delete DIR/cells to measure again. A
full report needs a clean working tree, because it documents one commit. Quick results go to
DIR/quick. Missing clouds of the paper are replaced by synthetic ones with known ground truth.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # The scenes of tests.made.

from reproduction import method, normals, segmentation, study, summary, times
from reproduction.cells import Folder, Record, is_committed, made_with
from reproduction.clouds import TITLES
from reproduction.report import write_report
from reproduction.runs import Run

PARTS: dict[str, tuple[Callable[[Run], Record], str]] = {
    "method": (method.reproduce, "Figures 1, 2, 5 and 6: the method and its indices"),
    "normals": (normals.reproduce, "Table 1, Figures 3 and 4: errors and times of normals"),
    "study": (study.reproduce, "section II.B: limits of angle and curvature"),
    "segmentation": (segmentation.reproduce, "Table 2, Figures 7 to 9"),
    "times": (times.reproduce, "Table 3: times"),
}
"""Parts by name: function and description."""


def main() -> None:
    """Compute the selected parts and write the report of all available parts."""
    arguments = _parse()
    mpl.use("agg")
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    commit = made_with()["commit"]
    if not arguments.quick and not is_committed(commit):
        sys.exit(
            "reproduce_paper.py: expected committed code for a full report, got commit "
            f"{commit}; commit the changes, or use --quick."
        )
    path = arguments.out / "quick" if arguments.quick else arguments.out
    folder = Folder(path)
    run = Run(folder, arguments.quick, {key: getattr(arguments, key) for key in TITLES})
    for name in arguments.parts or PARTS:
        begin = time.perf_counter()
        print(f"== {name}: {PARTS[name][1]}", flush=True)
        part = PARTS[name][0](run)
        folder.write(f"parts/{name}.json", json.dumps(part, indent=1))
        print(f"== {name}: {time.perf_counter() - begin:.0f} s", flush=True)
    report = write_report(folder, list(PARTS), quick=arguments.quick)
    print(f"Report: {folder.path / 'report.html'} (also .json)")
    if arguments.keep:
        try:
            summary.keep(report)
        except ValueError as error:
            sys.exit(f"reproduce_paper.py: {error}")


def _parse() -> argparse.Namespace:
    """Return the arguments."""
    listed = "; ".join(f"{name}: {what}" for name, (_, what) in PARTS.items())
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", choices=[*PARTS, []], metavar="part", help=f"{listed}. Default: all"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the report")
    parser.add_argument("--quick", action="store_true", help="small clouds, a few minutes")
    parser.add_argument("--threads", type=int, help="torch threads; default: chosen by torch")
    parser.add_argument(
        "--keep", action="store_true", help="store the main results for the documentation"
    )
    for key, title in TITLES.items():
        words = f"the paper's {title}; its labels and normals are the ground truth"
        parser.add_argument(f"--{key}", type=Path, metavar="PATH", help=words)
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Interrupted; rerun the same command to resume.")
