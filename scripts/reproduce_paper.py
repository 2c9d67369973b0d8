"""Make the figures and tables of the paper again, with every method of torchrg.

    python scripts/reproduce_paper.py normals          # Figures 3 and 4, Table 1
    python scripts/reproduce_paper.py normals --quick  # the same, small, in minutes

Each result is kept in a file of its own under --out; what is there is not computed again.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from reproduction import normals
from reproduction.cells import Folder

PARTS: dict[str, Callable[[Folder, bool], None]] = {"normals": normals.reproduce}
"""Parts by name: where results go, whether to be quick."""


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="+", choices=PARTS, help="what to make")
    parser.add_argument(
        "--out", type=Path, default=Path("reproduction"), help="default: %(default)s"
    )
    parser.add_argument("--quick", action="store_true", help="fewer and smaller clouds")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch; default: 1")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for part in arguments.parts:
        folder = Folder(arguments.out / (f"{part}-quick" if arguments.quick else part))
        PARTS[part](folder, arguments.quick)
        print(f"{part}: look at {folder.path}")


if __name__ == "__main__":
    main()
