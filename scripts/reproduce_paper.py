"""Make the tables and figures of the paper again, with every method of torchrg.

    python scripts/reproduce_paper.py --out DIR                 # everything
    python scripts/reproduce_paper.py --out DIR --quick         # the same, small, in minutes
    python scripts/reproduce_paper.py --out DIR normals times   # some parts

Open DIR/report.html. Each result is kept in a file of its own under DIR; what the same commit made
is not computed again, so a run that was interrupted goes on where it stopped; delete DIR/cells to
measure once more. At full size the tree
must be clean: a report is of one commit. Quick results are apart, in DIR/quick. Clouds of the paper
that are not given are replaced by made ones with known truth.
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
"""Parts by name: what makes them, and what they are."""


def main() -> None:
    """Make the parts that are asked for, and the report of all parts that are there."""
    arguments = _parse()
    mpl.use("agg")
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    commit = made_with()["commit"]
    if not arguments.quick and not is_committed(commit):
        sys.exit(
            "reproduce_paper.py: expected committed code for a report at full size, got commit "
            f"{commit}; commit the changes, or take --quick."
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
    print(f"Look at {folder.path / 'report.html'} (also .json)")
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
    parser.add_argument("--threads", type=int, help="threads of torch; default: as torch decides")
    parser.add_argument(
        "--keep", action="store_true", help="keep the main numbers for the documentation"
    )
    for key, title in TITLES.items():
        words = f"the paper's {title}; labels and normals in the file are its truth"
        parser.add_argument(f"--{key}", type=Path, metavar="PATH", help=words)
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Interrupted; the same command goes on from here.")
